"""Runs a Cyclone DDS server of `nav2_msgs/NavigateToPose`, as rmw_cyclonedds and rcl_action do.

The x of a goal's pose selects the reaction: -1 is rejected, -2 is aborted, 100 and more runs until
it is cancelled. Feedback has the goal's pose as the current pose, and the distance that is left.
"""

import argparse
import sys
import time
from pathlib import Path

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl.types import float32, float64, int8, int16, int32, uint16, uint32

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
import ros2_action
import ros2_service_types as types
from ros2_types import Header, Time

Point = types.struct("geometry_msgs/msg/Point", [(axis, float64, 0.0) for axis in "xyz"])
Quaternion = types.struct("geometry_msgs/msg/Quaternion", [(axis, float64, 0.0) for axis in "xyzw"])
Pose = types.struct("geometry_msgs/msg/Pose", [("position", Point, Point), ("orientation", Quaternion, Quaternion)])
PoseStamped = types.struct("geometry_msgs/msg/PoseStamped", [("header", Header, Header), ("pose", Pose, Pose)])
Duration = types.struct("builtin_interfaces/msg/Duration", [("sec", int32, 0), ("nanosec", uint32, 0)])
ID = [("goal_id", types.UUID, types.UUID)]
NAME = "nav2_msgs/action/NavigateToPose"
SEND = types.service(
    f"{NAME}_SendGoal",
    ID + [("pose", PoseStamped, PoseStamped), ("behavior_tree", str, "")],
    [("accepted", bool, False), ("stamp", Time, Time)],
)
RESULT = types.service(
    f"{NAME}_GetResult", ID, [("status", int8, 0), ("error_code", uint16, 0), ("error_msg", str, "")]
)
Feedback = types.struct(
    f"{NAME}_FeedbackMessage",
    ID
    + [
        ("current_pose", PoseStamped, PoseStamped),
        ("navigation_time", Duration, Duration),
        ("estimated_time_remaining", Duration, Duration),
        ("number_of_recoveries", int16, 0),
        ("distance_remaining", float32, 0.0),
    ],
)


class Navigator(ros2_action.ActionServer):
    KINDS = (SEND, RESULT, Feedback)

    def __init__(self, participant, args):
        super().__init__(participant, args)
        self.poses = {}

    def goal(self, request):
        request.order = int(request.pose.pose.position.x)
        at = request.pose.pose
        lifetime.say(
            position=[at.position.x, at.position.y, at.position.z],
            orientation=[at.orientation.x, at.orientation.y, at.orientation.z, at.orientation.w],
            frame=request.pose.header.frame_id,
            stamp=[request.pose.header.stamp.sec, request.pose.header.stamp.nanosec],
            tree=request.behavior_tree,
        )
        self.poses[bytes(request.goal_id.uuid)] = request.pose
        super().goal(request)

    def step(self, goal):
        goal.sequence.append(1)
        pose = self.poses[bytes(goal.id.uuid)]
        left = Feedback(goal_id=goal.id, current_pose=pose, number_of_recoveries=2, distance_remaining=0.5)
        self.feedback.write(left)

    def answer(self, request, goal):
        code = 9000 if goal.status == ros2_action.ABORTED else 0
        text = "no way there" if code else ""
        self.result.answer(request, self.result.kind(status=goal.status, error_code=code, error_msg=text))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("action")
    parser.add_argument("--domain", type=int, default=2)
    parser.add_argument("--keep", type=float, default=30.0)
    parser.add_argument("--hasty", action="store_true")
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    server = Navigator(DomainParticipant(args.domain), args)
    lifetime.say(ready=args.action)
    while True:
        server.turn()
        time.sleep(0.002)


main()
