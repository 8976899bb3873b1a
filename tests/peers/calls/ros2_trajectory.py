"""Runs a Cyclone DDS client of `control_msgs/FollowJointTrajectory`, as rmw_cyclonedds and
rcl_action of ROS 2 Humble do.

A line of standard input is the first position of a goal with two points, which selects the reaction
of the server (actionlib_server.py).
"""

import argparse
import sys
import time
import uuid
from pathlib import Path

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl.types import float64, int8, int32, sequence, uint32

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
import ros2_action
import ros2_service_types as types
from ros2_types import Header, Time

Duration = types.struct("builtin_interfaces/msg/Duration", [("sec", int32, 0), ("nanosec", uint32, 0)])
Vector3 = types.struct("geometry_msgs/msg/Vector3", [(axis, float64, 0.0) for axis in "xyz"])
Quaternion = types.struct("geometry_msgs/msg/Quaternion", [(axis, float64, 0.0) for axis in "xyzw"])
Transform = types.struct(
    "geometry_msgs/msg/Transform", [("translation", Vector3, Vector3), ("rotation", Quaternion, Quaternion)]
)
Twist = types.struct("geometry_msgs/msg/Twist", [("linear", Vector3, Vector3), ("angular", Vector3, Vector3)])
Point = types.struct(
    "trajectory_msgs/msg/JointTrajectoryPoint",
    [(name, sequence[float64], list) for name in ("positions", "velocities", "accelerations", "effort")]
    + [("time_from_start", Duration, Duration)],
)
Trajectory = types.struct(
    "trajectory_msgs/msg/JointTrajectory",
    [("header", Header, Header), ("joint_names", sequence[str], list), ("points", sequence[Point], list)],
)
ManyPoint = types.struct(
    "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint",
    [
        ("transforms", sequence[Transform], list),
        ("velocities", sequence[Twist], list),
        ("accelerations", sequence[Twist], list),
        ("time_from_start", Duration, Duration),
    ],
)
Many = types.struct(
    "trajectory_msgs/msg/MultiDOFJointTrajectory",
    [("header", Header, Header), ("joint_names", sequence[str], list), ("points", sequence[ManyPoint], list)],
)
LIMITS = [("position", float64, 0.0), ("velocity", float64, 0.0), ("acceleration", float64, 0.0)]
Tolerance = types.struct("control_msgs/msg/JointTolerance", [("name", str, "")] + LIMITS)
Component = types.struct("control_msgs/msg/JointComponentTolerance", [("joint_name", str, ""), ("component", int32, 0)] + LIMITS)

ID = [("goal_id", types.UUID, types.UUID)]
NAME = "control_msgs/action/FollowJointTrajectory"
SEND = types.service(
    f"{NAME}_SendGoal",
    ID
    + [
        ("trajectory", Trajectory, Trajectory),
        ("multi_dof_trajectory", Many, Many),
        ("path_tolerance", sequence[Tolerance], list),
        ("component_path_tolerance", sequence[Component], list),
        ("goal_tolerance", sequence[Tolerance], list),
        ("component_goal_tolerance", sequence[Component], list),
        ("goal_time_tolerance", Duration, Duration),
    ],
    [("accepted", bool, False), ("stamp", Time, Time)],
)
RESULT = types.service(f"{NAME}_GetResult", ID, [("status", int8, 0), ("error_code", int32, 0), ("error_string", str, "")])
Feedback = types.struct(
    f"{NAME}_FeedbackMessage",
    ID
    + [("header", Header, Header), ("joint_names", sequence[str], list)]
    + [(name, Point, Point) for name in ("desired", "actual", "error")]
    + [("multi_dof_joint_names", sequence[str], list)]
    + [(f"multi_dof_{name}", ManyPoint, ManyPoint) for name in ("desired", "actual", "error")],
)


class Arm(ros2_action.ActionClient):
    KINDS = (SEND, RESULT, Feedback)

    def run(self, words):
        goal_id = types.UUID(uuid=list(uuid.uuid4().bytes))
        self.goals.append(goal_id)
        points = [
            Point(positions=[float(words[0]), 0.25], time_from_start=Duration(sec=1, nanosec=500_000_000)),
            Point(positions=[0.5, -0.25], velocities=[1.0, 2.0], time_from_start=Duration(sec=3)),
        ]
        request = self.send.kind(
            goal_id=goal_id,
            trajectory=Trajectory(header=Header(frame_id="arm"), joint_names=["shoulder", "elbow"], points=points),
            path_tolerance=[Tolerance(name="elbow", position=0.125)],
            goal_time_tolerance=Duration(sec=2),
        )
        self.ask(self.send, request, "goal", len(self.goals) - 1)

    def answered(self, what, number, reply):
        if what == "goal":
            lifetime.say(goal=number, accepted=reply.accepted)
            self.ask_result(self.goals[number], number)
        else:
            status = ros2_action.NAMES[reply.status]
            lifetime.say(result=number, status=status, code=reply.error_code, text=reply.error_string)

    def reported(self, number, sample):
        lifetime.say(
            feedback=number,
            joints=list(sample.joint_names),
            desired=list(sample.desired.positions),
            at=[sample.desired.time_from_start.sec, sample.desired.time_from_start.nanosec],
            many=list(sample.multi_dof_joint_names),
        )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("action")
    parser.add_argument("--domain", type=int, default=2)
    parser.add_argument("--wait", type=float, default=60.0)
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    args.results = True
    lifetime.bound(args.limit)
    arm = Arm(DomainParticipant(args.domain), args)
    arm.wait(args.wait)
    lifetime.say(ready=args.action)
    told = ros2_action.lines()
    while True:
        arm.turn()
        if not told.empty():
            arm.run(told.get())
        time.sleep(0.002)


main()
