"""Defines the requests and responses in the tests of calls, for peers of ROS 1 and of ROS 2.

A case fills the request with a number, makes its response, and checks that a response belongs to
the number.
"""

BIG = 1_000_000


class Bundled:
    """A built-in type: std_srvs/SetBool."""

    type = "std_srvs/SetBool"
    takes = {"data": False}

    @staticmethod
    def ask(request, number):
        request.data = number % 2 == 1

    @staticmethod
    def key(request):
        return request.data

    @staticmethod
    def answer(request, response):
        response.success = request.data
        response.message = "odd" if request.data else "even"

    @staticmethod
    def right(response, number):
        odd = number % 2 == 1
        return response.success == odd and response.message == ("odd" if odd else "even")


class Files:
    """A type that only files define: test_msgs/BasicTypes."""

    type = "test_msgs/BasicTypes"
    takes = {
        "bool_value": False,
        "byte_value": 0,
        "char_value": 0,
        "float32_value": 0.0,
        "float64_value": 0.0,
        "int8_value": 0,
        "uint8_value": 0,
        "int16_value": 0,
        "uint16_value": 0,
        "int32_value": 0,
        "uint32_value": 0,
        "int64_value": 0,
        "uint64_value": 0,
        "string_value": "",
    }

    @staticmethod
    def ask(request, number):
        request.bool_value = True
        request.float64_value = number / 8
        request.int16_value = -number
        request.uint64_value = 2**63 + number
        request.string_value = f"é {number}"

    @staticmethod
    def key(request):
        return request.uint64_value - 2**63

    @staticmethod
    def answer(request, response):
        response.bool_value = not request.bool_value
        response.float64_value = request.float64_value * 2
        response.int16_value = request.int16_value
        response.uint64_value = request.uint64_value
        response.string_value = request.string_value * 2

    @staticmethod
    def right(response, number):
        return (
            not response.bool_value
            and response.float64_value == number / 4
            and response.int16_value == -number
            and response.uint64_value == 2**63 + number
            and response.string_value == f"é {number}" * 2
        )


class Empty:
    """A request without fields: std_srvs/Trigger."""

    type = "std_srvs/Trigger"
    takes = {}

    @staticmethod
    def ask(request, number):
        pass

    @staticmethod
    def key(request):
        return 0

    @staticmethod
    def answer(request, response):
        response.success = True
        response.message = "done"

    @staticmethod
    def right(response, number):
        return response.success and response.message == "done"


class Big(Empty):
    """A response of 1 MB: the message of std_srvs/Trigger."""

    @staticmethod
    def answer(request, response):
        response.success = True
        response.message = "0123456789" * (BIG // 10)

    @staticmethod
    def right(response, number):
        return response.success and response.message == "0123456789" * (BIG // 10)


class Messages(Empty):
    """An array of messages: lifecycle_msgs/GetAvailableStates."""

    type = "lifecycle_msgs/GetAvailableStates"
    state = None

    @classmethod
    def answer(cls, request, response):
        for number, label in enumerate(("one", "", "drei")):
            state = cls.state()
            state.id, state.label = number, label
            response.available_states.append(state)

    @staticmethod
    def right(response, number):
        return [(one.id, one.label) for one in response.available_states] == [(0, "one"), (1, ""), (2, "drei")]


class Switch(Bundled):
    """std_srvs/SetBool with a server that returns the value of the request."""

    @staticmethod
    def right(response, number):
        return response.success == (number % 2 == 1)


class Skill(Empty):
    """A Method of a component's skill, called when the state of the skill allows it."""

    @staticmethod
    def right(response, number):
        return bool(response.success)


class Grasp(Files):
    """The Start of a skill with a parameter; the mapping offers it with a type that only files
    define."""

    takes = {"Force": 0.0}

    @staticmethod
    def ask(request, number):
        force = "Force" if hasattr(request, "Force") else "float64_value"
        setattr(request, force, 10.0 + number)

    @staticmethod
    def right(response, number):
        return bool(response.success if hasattr(response, "success") else response.bool_value)


class Loggers(Empty):
    """A service of every node of roscpp: `~get_loggers`."""

    type = "roscpp/GetLoggers"

    @staticmethod
    def right(response, number):
        return any(one.name == "ros" for one in response.loggers)


class Level(Empty):
    """A service of every node of roscpp: `~set_logger_level`."""

    type = "roscpp/SetLoggerLevel"

    @staticmethod
    def ask(request, number):
        request.logger, request.level = "ros", "warn"

    @staticmethod
    def right(response, number):
        return True


CASES = {
    "bundled": Bundled,
    "files": Files,
    "empty": Empty,
    "megabyte": Big,
    "messages": Messages,
    "switch": Switch,
    "skill": Skill,
    "grasp": Grasp,
    "loggers": Loggers,
    "level": Level,
}
