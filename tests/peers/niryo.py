"""Simulates the ROS graph of a Niryo Ned: topics, services and actions of ned_ros by name, with
little behavior.

The definitions are read from a folder at run time. Every call of a service is one JSON line on
standard output.
"""

import argparse
import math

import actionlib
import rospy

import lifetime
import ros1_definitions

JOINTS = [f"joint_{number}" for number in range(1, 7)]
SUCCESS = 1
NO_CONVEYOR_FOUND = -123
CONVEYOR_ID_INVALID = -124
INVALID_PARAMETERS = -52


class Niryo:
    def __init__(self, definitions, conveyor):
        self.definitions = definitions
        self.conveyor_id = conveyor
        self.attached = False
        self.running = False
        self.speed = 0
        self.direction = 1
        self.learning = False
        self.outputs = {"DO1": False, "DO2": False}
        self.publishers = {}

    def publisher(self, topic, kind, latch=False):
        kind = self.definitions.message(kind)
        publisher = rospy.Publisher(topic, kind, queue_size=10, latch=latch, tcp_nodelay=True)
        self.publishers[topic] = (publisher, kind)

    def publish(self, topic, **fields):
        publisher, kind = self.publishers[topic]
        message = kind(**fields)
        if hasattr(message, "header"):
            message.header.stamp = rospy.Time.now()
        publisher.publish(message)

    def service(self, name, kind, answer):
        service = self.definitions.service(kind)

        def called(request):
            fields = {slot: getattr(request, slot) for slot in request.__slots__}
            lifetime.say(service=name, request=fields)
            return service._response_class(**answer(request))

        rospy.Service(name, service, called)

    def start(self):
        self.publisher("/joint_states", "sensor_msgs/JointState")
        self.publisher("/niryo_robot/robot_state", "niryo_robot_msgs/RobotState")
        self.publisher(
            "/niryo_robot/conveyor/feedback", "conveyor_interface/ConveyorFeedbackArray", latch=True
        )
        self.publisher("/niryo_robot_rpi/digital_io_state", "niryo_robot_rpi/DigitalIOState")
        self.publisher("/niryo_robot_rpi/analog_io_state", "niryo_robot_rpi/AnalogIOState")
        self.publisher("/niryo_robot_hardware/tools/motor", "tools_interface/Tool", latch=True)
        self.publisher("/niryo_robot_tools_commander/current_id", "std_msgs/Int32", latch=True)
        self.publisher(
            "/niryo_robot_hardware_interface/hardware_status", "niryo_robot_msgs/HardwareStatus"
        )
        self.publisher(
            "/niryo_robot_status/robot_status", "niryo_robot_status/RobotStatus", latch=True
        )
        self.publisher("/niryo_robot/learning_mode/state", "std_msgs/Bool", latch=True)
        self.publisher("/niryo_robot/collision_detected", "std_msgs/Bool", latch=True)
        self.publisher("/niryo_robot_arm_commander/is_active", "std_msgs/Bool")
        conveyor = "/niryo_robot/conveyor/"
        self.service(
            conveyor + "ping_and_set_conveyor", "conveyor_interface/SetConveyor", self.set_conveyor
        )
        self.service(
            conveyor + "control_conveyor", "conveyor_interface/ControlConveyor", self.control
        )
        self.service(
            conveyor + "get_hardware_id", "conveyor_interface/GetHardwareId", self.hardware_id
        )
        self.service("/niryo_robot_rpi/set_digital_io", "niryo_robot_rpi/SetDigitalIO", self.set_io)
        self.service(
            "/niryo_robot/learning_mode/activate", "niryo_robot_msgs/SetBool", self.set_learning
        )
        self.service(
            "/niryo_robot/joints_interface/calibrate_motors", "niryo_robot_msgs/SetInt", self.done
        )
        self.service(
            "/niryo_robot_arm_commander/stop_command", "niryo_robot_msgs/Trigger", self.done
        )
        self.actions()
        self.states()
        rospy.Timer(rospy.Duration(1 / 50), lambda _: self.joints())
        rospy.Timer(rospy.Duration(1 / 10), lambda _: self.often())
        rospy.Timer(rospy.Duration(1 / 2), lambda _: self.states())

    def actions(self):
        self.servers = []
        for name, kind in (
            ("/niryo_robot_arm_commander/robot_action", "niryo_robot_arm_commander/RobotMove"),
            ("/niryo_robot_tools_commander/action_server", "niryo_robot_tools_commander/Tool"),
        ):
            action = self.definitions.action(kind)
            result = self.definitions.message(kind + "Result")

            def execute(goal, result=result, name=name):
                lifetime.say(action=name, cmd_type=goal.cmd.cmd_type)
                server = next(s for n, s in self.servers if n == name)
                server.set_succeeded(result(status=SUCCESS, message="done"))

            server = actionlib.SimpleActionServer(name, action, execute, auto_start=False)
            self.servers.append((name, server))
            server.start()

    # Services.

    def set_conveyor(self, request):
        if request.cmd == 1:
            self.attached = True
            self.states()
            return self.conveyor_answer(SUCCESS, id=self.conveyor_id)
        found = self.attached and request.id == self.conveyor_id
        self.attached = self.attached and not found
        self.states()
        return self.conveyor_answer(SUCCESS if found else NO_CONVEYOR_FOUND, id=request.id)

    def control(self, request):
        if not self.attached or request.id != self.conveyor_id:
            return {"status": CONVEYOR_ID_INVALID, "message": f"no conveyor {request.id}"}
        self.running = request.control_on
        self.speed = request.speed
        self.direction = request.direction
        self.states()
        return {"status": SUCCESS, "message": "running" if self.running else "stopped"}

    def hardware_id(self, request):
        if not self.attached:
            return self.conveyor_answer(NO_CONVEYOR_FOUND)
        return self.conveyor_answer(SUCCESS)

    def conveyor_answer(self, status, **more):
        return {"status": status, "message": "", "hardware_id": "NiryoSteppers", **more}

    def set_io(self, request):
        if request.name not in self.outputs:
            return {"status": INVALID_PARAMETERS, "message": f"no output {request.name}"}
        self.outputs[request.name] = request.value
        return {"status": SUCCESS, "message": ""}

    def set_learning(self, request):
        self.learning = request.value
        self.states()
        return {"status": SUCCESS, "message": ""}

    def done(self, _request):
        return {"status": SUCCESS, "message": ""}

    # Topics.

    def joints(self):
        angle = math.sin(rospy.get_time())
        positions = [angle * number / 10 for number in range(6)]
        self.publish(
            "/joint_states", name=JOINTS, position=positions, velocity=[], effort=[]
        )

    def often(self):
        io = self.definitions.message("niryo_robot_rpi/DigitalIO")
        self.publish(
            "/niryo_robot_rpi/digital_io_state",
            digital_inputs=[io(name="DI1", value=True)],
            digital_outputs=[io(name=name, value=value) for name, value in self.outputs.items()],
        )
        analog = self.definitions.message("niryo_robot_rpi/AnalogIO")
        self.publish(
            "/niryo_robot_rpi/analog_io_state",
            analog_inputs=[analog(name="AI1", value=2.5)],
            analog_outputs=[],
        )
        self.publish("/niryo_robot_arm_commander/is_active", data=self.running)
        state = self.definitions.message("niryo_robot_msgs/RobotState")()
        state.position.x = 0.25
        state.tcp_speed = 0.125
        fields = {slot: getattr(state, slot) for slot in state.__slots__}
        self.publish("/niryo_robot/robot_state", **fields)

    def states(self):
        feedback = self.definitions.message("conveyor_interface/ConveyorFeedback")
        conveyors = [
            feedback(
                conveyor_id=self.conveyor_id,
                connection_state=True,
                running=self.running,
                speed=self.speed,
                direction=self.direction,
            )
        ]
        self.publish(
            "/niryo_robot/conveyor/feedback", conveyors=conveyors if self.attached else []
        )
        self.publish(
            "/niryo_robot_hardware/tools/motor", id=11, motor_type=2, position=100, state=16
        )
        self.publish("/niryo_robot_tools_commander/current_id", data=11)
        self.publish(
            "/niryo_robot_hardware_interface/hardware_status",
            rpi_temperature=45,
            hardware_version="ned2",
            connection_up=True,
            motor_names=JOINTS,
            motor_types=["STEPPER"] * 3 + ["XL430"] * 3,
            temperatures=[30, 31, 32, 33, 34, 35],
            voltages=[12.0] * 6,
            hardware_errors=[0] * 6,
            hardware_errors_message=[""] * 6,
        )
        self.publish(
            "/niryo_robot_status/robot_status", robot_status=6, robot_status_str="STANDBY"
        )
        self.publish("/niryo_robot/learning_mode/state", data=self.learning)
        self.publish("/niryo_robot/collision_detected", data=False)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("definitions", help="folder with the packages of ned_ros")
    parser.add_argument("--conveyor", type=int, default=12)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node("niryo_ned", disable_rosout=True)
    robot = Niryo(ros1_definitions.Definitions(args.definitions), args.conveyor)
    robot.start()
    lifetime.say(ready="niryo_ned")
    rospy.spin()


main()
