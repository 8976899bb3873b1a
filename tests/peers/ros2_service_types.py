"""Defines the ROS 2 services and actions of the tests with the wire format of rmw_cyclonedds: each
request and reply begins with 8 bytes that name the client and a number that counts its requests."""

from dataclasses import dataclass, field
from types import new_class

from cyclonedds.core import Policy, Qos
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import (
    array,
    float32,
    float64,
    int8,
    int16,
    int32,
    int64,
    sequence,
    uint8,
    uint16,
    uint32,
    uint64,
)
from cyclonedds.util import duration

from ros2_types import Time


def struct(name, fields):
    """Returns a class for the ROS name `package/kind/Name` with (name, type, default) fields."""
    package, kind, short = name.split("/")

    def fill(namespace):
        namespace["__annotations__"] = {n: t for n, t, _ in fields}
        namespace["__module__"] = __name__
        for n, _, default in fields:
            namespace[n] = field(default_factory=default) if callable(default) else default

    made = new_class(short, (IdlStruct,), {"typename": f"{package}.{kind}.dds_.{short}_"}, fill)
    return final(dataclass(made))


HEADER = [("client", uint64, 0), ("count", int64, 0)]
NOTHING = [("structure_needs_at_least_one_member", uint8, 0)]


def service(name, request, reply):
    """Returns request and reply of `package/kind/Name`."""
    return (
        struct(f"{name}_Request", HEADER + (request or NOTHING)),
        struct(f"{name}_Response", HEADER + (reply or NOTHING)),
    )


UUID = struct("unique_identifier_msgs/msg/UUID", [("uuid", array[uint8, 16], lambda: [0] * 16)])
GoalInfo = struct("action_msgs/msg/GoalInfo", [("goal_id", UUID, UUID), ("stamp", Time, Time)])
GoalStatus = struct("action_msgs/msg/GoalStatus", [("goal_info", GoalInfo, GoalInfo), ("status", int8, 0)])
GoalStatusArray = struct("action_msgs/msg/GoalStatusArray", [("status_list", sequence[GoalStatus], list)])

ParameterValue = struct(
    "rcl_interfaces/msg/ParameterValue",
    [
        ("type", uint8, 0),
        ("bool_value", bool, False),
        ("integer_value", int64, 0),
        ("double_value", float64, 0.0),
        ("string_value", str, ""),
        ("byte_array_value", sequence[uint8], list),
        ("bool_array_value", sequence[bool], list),
        ("integer_array_value", sequence[int64], list),
        ("double_array_value", sequence[float64], list),
        ("string_array_value", sequence[str], list),
    ],
)
Parameter = struct("rcl_interfaces/msg/Parameter", [("name", str, ""), ("value", ParameterValue, ParameterValue)])
FloatingPointRange = struct(
    "rcl_interfaces/msg/FloatingPointRange",
    [("from_value", float64, 0.0), ("to_value", float64, 0.0), ("step", float64, 0.0)],
)
IntegerRange = struct(
    "rcl_interfaces/msg/IntegerRange", [("from_value", int64, 0), ("to_value", int64, 0), ("step", uint64, 0)]
)
ParameterDescriptor = struct(
    "rcl_interfaces/msg/ParameterDescriptor",
    [
        ("name", str, ""),
        ("type", uint8, 0),
        ("description", str, ""),
        ("additional_constraints", str, ""),
        ("read_only", bool, False),
        ("dynamic_typing", bool, False),
        ("floating_point_range", sequence[FloatingPointRange, 1], list),
        ("integer_range", sequence[IntegerRange, 1], list),
    ],
)
SetParametersResult = struct(
    "rcl_interfaces/msg/SetParametersResult", [("successful", bool, False), ("reason", str, "")]
)
ListParametersResult = struct(
    "rcl_interfaces/msg/ListParametersResult", [("names", sequence[str], list), ("prefixes", sequence[str], list)]
)
ParameterEvent = struct(
    "rcl_interfaces/msg/ParameterEvent",
    [
        ("stamp", Time, Time),
        ("node", str, ""),
        ("new_parameters", sequence[Parameter], list),
        ("changed_parameters", sequence[Parameter], list),
        ("deleted_parameters", sequence[Parameter], list),
    ],
)
# Messages that only the services of parameters cause.
MESSAGES = {"rcl_interfaces/ParameterEvent": ParameterEvent}

BASIC = [
    ("bool_value", bool, False),
    ("byte_value", uint8, 0),
    ("char_value", uint8, 0),
    ("float32_value", float32, 0.0),
    ("float64_value", float64, 0.0),
    ("int8_value", int8, 0),
    ("uint8_value", uint8, 0),
    ("int16_value", int16, 0),
    ("uint16_value", uint16, 0),
    ("int32_value", int32, 0),
    ("uint32_value", uint32, 0),
    ("int64_value", int64, 0),
    ("uint64_value", uint64, 0),
    ("string_value", str, ""),
]
State = struct("lifecycle_msgs/msg/State", [("id", uint8, 0), ("label", str, "")])

NAMES = [("names", sequence[str], list)]
PARAMETERS = [("parameters", sequence[Parameter], list)]

SERVICES = {
    "std_srvs/SetBool": service(
        "std_srvs/srv/SetBool", [("data", bool, False)], [("success", bool, False), ("message", str, "")]
    ),
    "std_srvs/Trigger": service("std_srvs/srv/Trigger", [], [("success", bool, False), ("message", str, "")]),
    "rcl_interfaces/DescribeParameters": service(
        "rcl_interfaces/srv/DescribeParameters", NAMES, [("descriptors", sequence[ParameterDescriptor], list)]
    ),
    "rcl_interfaces/GetParameterTypes": service(
        "rcl_interfaces/srv/GetParameterTypes", NAMES, [("types", sequence[uint8], list)]
    ),
    "rcl_interfaces/GetParameters": service(
        "rcl_interfaces/srv/GetParameters", NAMES, [("values", sequence[ParameterValue], list)]
    ),
    "rcl_interfaces/ListParameters": service(
        "rcl_interfaces/srv/ListParameters",
        [("prefixes", sequence[str], list), ("depth", uint64, 0)],
        [("result", ListParametersResult, ListParametersResult)],
    ),
    "rcl_interfaces/SetParameters": service(
        "rcl_interfaces/srv/SetParameters", PARAMETERS, [("results", sequence[SetParametersResult], list)]
    ),
    "rcl_interfaces/SetParametersAtomically": service(
        "rcl_interfaces/srv/SetParametersAtomically",
        PARAMETERS,
        [("result", SetParametersResult, SetParametersResult)],
    ),
    "action_msgs/CancelGoal": service(
        "action_msgs/srv/CancelGoal",
        [("goal_info", GoalInfo, GoalInfo)],
        [("return_code", int8, 0), ("goals_canceling", sequence[GoalInfo], list)],
    ),
    "test_msgs/BasicTypes": service("test_msgs/srv/BasicTypes", BASIC, BASIC),
    "lifecycle_msgs/GetAvailableStates": service(
        "lifecycle_msgs/srv/GetAvailableStates", [], [("available_states", sequence[State], list)]
    ),
    # The same definition as in tests/tests/shaped.rs.
    "robot_msgs/Move": service(
        "robot_msgs/srv/Move",
        [("speed", float32, 0.0), ("dry", bool, False), ("mode", str, "")],
        [("refused", bool, False), ("codes", sequence[int32], list), ("took", float64, 0.0)],
    ),
    # The Fibonacci action of the ROS tutorials, in its own package.
    "demo_msgs/Fibonacci_SendGoal": service(
        "demo_msgs/action/Fibonacci_SendGoal",
        [("goal_id", UUID, UUID), ("order", int32, 0)],
        [("accepted", bool, False), ("stamp", Time, Time)],
    ),
    "demo_msgs/Fibonacci_GetResult": service(
        "demo_msgs/action/Fibonacci_GetResult",
        [("goal_id", UUID, UUID)],
        [("status", int8, 0), ("sequence", sequence[int32], list)],
    ),
}
FibonacciFeedback = struct(
    "demo_msgs/action/Fibonacci_FeedbackMessage", [("goal_id", UUID, UUID), ("sequence", sequence[int32], list)]
)


def qos(durability=Policy.Durability.Volatile, depth=1000):
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=10)),
        durability,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
