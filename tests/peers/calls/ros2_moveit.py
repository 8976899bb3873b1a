"""Runs Cyclone DDS servers of `moveit_msgs/MoveGroup` and of `moveit_msgs/ExecuteTrajectory` (at
/execute_trajectory), as rmw_cyclonedds and rcl_action do, with the definitions of tests/data/moveit.
Nothing is planned.

The x of a goal's position, or the position of its first joint, selects the reaction: -1 is
rejected, -2 fails in planning (aborted, PLANNING_FAILED), -4 is preempted by another client
(cancelled, PREEMPTED), 7 succeeds with another code than SUCCESS, 100 and more runs until it is
cancelled.
"""

import argparse
import sys
import time
from pathlib import Path

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl.types import float32, float64, int8, int32, sequence, uint8

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
import ros2_action
import ros2_service_types as types
from ros2_types import Header, Time


def doubles(*names):
    return [(name, float64, 0.0) for name in names]


Point = types.struct("geometry_msgs/msg/Point", doubles("x", "y", "z"))
Point32 = types.struct("geometry_msgs/msg/Point32", [(axis, float32, 0.0) for axis in "xyz"])
Polygon = types.struct("geometry_msgs/msg/Polygon", [("points", sequence[Point32], list)])
Vector3 = types.struct("geometry_msgs/msg/Vector3", doubles("x", "y", "z"))
Quaternion = types.struct("geometry_msgs/msg/Quaternion", doubles("x", "y", "z", "w"))
Pose = types.struct("geometry_msgs/msg/Pose", [("position", Point, Point), ("orientation", Quaternion, Quaternion)])
Primitive = types.struct(
    "shape_msgs/msg/SolidPrimitive",
    [("type", uint8, 0), ("dimensions", sequence[float64, 3], list), ("polygon", Polygon, Polygon)],
)
Volume = types.struct(
    "moveit_msgs/msg/BoundingVolume",
    [("primitives", sequence[Primitive], list), ("primitive_poses", sequence[Pose], list)],
)
Joint = types.struct(
    "moveit_msgs/msg/JointConstraint",
    [("joint_name", str, "")] + doubles("position", "tolerance_above", "tolerance_below", "weight"),
)
Position = types.struct(
    "moveit_msgs/msg/PositionConstraint",
    [
        ("header", Header, Header),
        ("link_name", str, ""),
        ("target_point_offset", Vector3, Vector3),
        ("constraint_region", Volume, Volume),
    ]
    + doubles("weight"),
)
Orientation = types.struct(
    "moveit_msgs/msg/OrientationConstraint",
    [("header", Header, Header), ("orientation", Quaternion, Quaternion), ("link_name", str, "")]
    + doubles(*(f"absolute_{axis}_axis_tolerance" for axis in "xyz"))
    + [("parameterization", uint8, 0)]
    + doubles("weight"),
)
Constraints = types.struct(
    "moveit_msgs/msg/Constraints",
    [
        ("name", str, ""),
        ("joint_constraints", sequence[Joint], list),
        ("position_constraints", sequence[Position], list),
        ("orientation_constraints", sequence[Orientation], list),
    ],
)
State = types.struct("moveit_msgs/msg/RobotState", [("is_diff", bool, False)])
PlanRequest = types.struct(
    "moveit_msgs/msg/MotionPlanRequest",
    [("start_state", State, State), ("goal_constraints", sequence[Constraints], list)]
    + [(name, str, "") for name in ("pipeline_id", "planner_id", "group_name")]
    + [("num_planning_attempts", int32, 0)]
    + doubles("allowed_planning_time", "max_velocity_scaling_factor", "max_acceleration_scaling_factor"),
)
Scene = types.struct("moveit_msgs/msg/PlanningScene", [("robot_state", State, State), ("is_diff", bool, False)])
Options = types.struct(
    "moveit_msgs/msg/PlanningOptions", [("planning_scene_diff", Scene, Scene), ("plan_only", bool, False)]
)
Code = types.struct("moveit_msgs/msg/MoveItErrorCodes", [("val", int32, 0)])

TrajectoryPoint = types.struct(
    "trajectory_msgs/msg/JointTrajectoryPoint",
    [(name, sequence[float64], list) for name in ("positions", "velocities", "accelerations", "effort")]
    + [("time_from_start", Time, Time)],
)
JointTrajectory = types.struct(
    "trajectory_msgs/msg/JointTrajectory",
    [("header", Header, Header), ("joint_names", sequence[str], list), ("points", sequence[TrajectoryPoint], list)],
)
Trajectory = types.struct("moveit_msgs/msg/RobotTrajectory", [("joint_trajectory", JointTrajectory, JointTrajectory)])

ID = [("goal_id", types.UUID, types.UUID)]
NAME = "moveit_msgs/action/MoveGroup"
SEND = types.service(
    f"{NAME}_SendGoal",
    ID + [("request", PlanRequest, PlanRequest), ("planning_options", Options, Options)],
    [("accepted", bool, False), ("stamp", Time, Time)],
)
RESULT = types.service(f"{NAME}_GetResult", ID, [("status", int8, 0), ("error_code", Code, Code)])
Feedback = types.struct(f"{NAME}_FeedbackMessage", ID + [("state", str, "")])

EXECUTE = "moveit_msgs/action/ExecuteTrajectory"
SEND_TRAJECTORY = types.service(
    f"{EXECUTE}_SendGoal",
    ID + [("trajectory", Trajectory, Trajectory), ("controller_names", sequence[str], list)],
    [("accepted", bool, False), ("stamp", Time, Time)],
)
TRAJECTORY_RESULT = types.service(f"{EXECUTE}_GetResult", ID, [("status", int8, 0), ("error_code", Code, Code)])
TrajectoryFeedback = types.struct(f"{EXECUTE}_FeedbackMessage", ID + [("state", str, "")])

SUCCESS, PLANNING_FAILED, INVALID_MOTION_PLAN, PREEMPTED = 1, -1, -2, -7


def first(constraints):
    """Returns the number that selects the reaction."""
    if constraints.joint_constraints:
        return constraints.joint_constraints[0].position
    return constraints.position_constraints[0].constraint_region.primitive_poses[0].position.x


def told(request):
    """Returns the goal as JSON."""
    constraints = request.goal_constraints[0]
    said = {
        "group": request.group_name,
        "planner": [request.pipeline_id, request.planner_id],
        "scales": [request.max_velocity_scaling_factor, request.max_acceleration_scaling_factor],
        "is_diff": request.start_state.is_diff,
        "joints": [[joint.joint_name, joint.position, joint.weight] for joint in constraints.joint_constraints],
    }
    for position in constraints.position_constraints:
        region = position.constraint_region
        at = region.primitive_poses[0]
        said["position"] = [at.position.x, at.position.y, at.position.z, at.orientation.w]
        said["sphere"] = [region.primitives[0].type, list(region.primitives[0].dimensions)]
        said["frame"] = [position.header.frame_id, position.link_name, position.weight]
    for orientation in constraints.orientation_constraints:
        at = orientation.orientation
        said["orientation"] = [at.w, at.x, at.y, at.z]
        said["tolerance"] = orientation.absolute_z_axis_tolerance
    return said


class MoveGroup(ros2_action.ActionServer):
    KINDS = (SEND, RESULT, Feedback)

    def goal(self, request):
        request.order = int(first(request.request.goal_constraints[0]))
        scene = request.planning_options.planning_scene_diff
        lifetime.say(**told(request.request), scene=[scene.is_diff, scene.robot_state.is_diff])
        super().goal(request)

    def step(self, goal):
        goal.sequence.append(1)
        self.feedback.write(self.KINDS[2](goal_id=goal.id, state="PLANNING"))

    def work(self, goal):
        if goal.order == -4 and goal.status < ros2_action.SUCCEEDED:
            self.end(goal, ros2_action.CANCELED)
        else:
            super().work(goal)

    def answer(self, request, goal):
        code = {
            ros2_action.ABORTED: PLANNING_FAILED,
            ros2_action.CANCELED: PREEMPTED,
        }.get(goal.status, INVALID_MOTION_PLAN if goal.order == 7 else SUCCESS)
        self.result.answer(request, self.result.kind(status=goal.status, error_code=Code(val=code)))


class ExecuteTrajectory(MoveGroup):
    """Executes a trajectory: the last position of its first joint selects the reaction."""

    KINDS = (SEND_TRAJECTORY, TRAJECTORY_RESULT, TrajectoryFeedback)

    def goal(self, request):
        trajectory = request.trajectory.joint_trajectory
        request.order = int(trajectory.points[-1].positions[0])
        points = [[list(point.positions), point.time_from_start.sec] for point in trajectory.points]
        lifetime.say(trajectory=points, names=list(trajectory.joint_names))
        ros2_action.ActionServer.goal(self, request)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("action")
    parser.add_argument("--domain", type=int, default=2)
    parser.add_argument("--keep", type=float, default=30.0)
    parser.add_argument("--hasty", action="store_true")
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    participant = DomainParticipant(args.domain)
    of_trajectories = argparse.Namespace(**{**vars(args), "action": "/execute_trajectory"})
    servers = [MoveGroup(participant, args), ExecuteTrajectory(participant, of_trajectories)]
    lifetime.say(ready=args.action)
    while True:
        for server in servers:
            server.turn()
        time.sleep(0.002)


main()
