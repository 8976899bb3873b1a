"""Provides action classes of ROS 1: installed classes, and classes made of definitions by genpy."""

import importlib

from pathlib import Path

import genpy
import genpy.dynamic

FIBONACCI = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence"
TOLERANCE = "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration"
TEXTS = {
    "test_msgs/Fibonacci": FIBONACCI,
    "actionlib_tutorials/Fibonacci": FIBONACCI,
    "control_msgs/FollowJointTrajectory": """trajectory_msgs/JointTrajectory trajectory
control_msgs/JointTolerance[] path_tolerance
control_msgs/JointTolerance[] goal_tolerance
duration goal_time_tolerance
---
int32 error_code
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error""",
}
MESSAGES = {
    "control_msgs/JointTolerance": TOLERANCE,
    "trajectory_msgs/JointTrajectory": "std_msgs/Header header\nstring[] joint_names\n"
    "trajectory_msgs/JointTrajectoryPoint[] points",
    "trajectory_msgs/JointTrajectoryPoint": "float64[] positions\nfloat64[] velocities\nfloat64[] accelerations\n"
    "float64[] effort\nduration time_from_start",
}
# The actions of skills, in the shipped definitions.
SKILLS = Path(__file__).resolve().parents[3] / "ros/ua_msgs/action"
TEXTS |= {f"ua_msgs/{file.stem}": file.read_text() for file in SKILLS.glob("*.action")}
BASIC = "bool byte char int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64 string time duration".split()


def parts(name, text):
    """Returns the messages of an action (http://wiki.ros.org/actionlib/DetailedDescription)."""
    goal, result, feedback = text.split("\n---\n")
    status = "std_msgs/Header header\nactionlib_msgs/GoalStatus status\n"
    return {
        f"{name}Goal": goal,
        f"{name}Result": result,
        f"{name}Feedback": feedback,
        f"{name}ActionGoal": f"std_msgs/Header header\nactionlib_msgs/GoalID goal_id\n{name}Goal goal",
        f"{name}ActionResult": f"{status}{name}Result result",
        f"{name}ActionFeedback": f"{status}{name}Feedback feedback",
        f"{name}Action": f"{name}ActionGoal action_goal\n{name}ActionResult action_result\n"
        f"{name}ActionFeedback action_feedback",
    }


def text_of(name, own):
    if name in own or name in MESSAGES:
        return own.get(name) or MESSAGES[name]
    package, short = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), short)._full_text.split("\n====")[0]


def needed(name, own, found):
    """Collects the texts of a message and of the messages that it needs, with full type names."""
    rows = []
    for row in text_of(name, own).splitlines():
        words = row.split("#")[0].split()
        if len(words) < 2 or "=" in row.split("#")[0]:
            rows.append(row)
            continue
        kind, _, length = words[0].partition("[")
        if kind not in BASIC:
            kind = "std_msgs/Header" if kind == "Header" else kind if "/" in kind else f"{name.split('/')[0]}/{kind}"
        rows.append(" ".join([kind + ("[" + length if length else "")] + words[1:]))
        if kind not in BASIC and kind not in found:
            found[kind] = None
            needed(kind, own, found)
    found[name] = "\n".join(rows)


def action_class(name):
    """Returns the class `XAction` of an action."""
    package, short = name.split("/")
    if name not in TEXTS:
        return getattr(importlib.import_module(f"{package}.msg"), f"{short}Action")
    whole, found = f"{name}Action", {}
    needed(whole, parts(name, TEXTS[name]), found)
    text = found.pop(whole) + "".join(f"\n{'=' * 80}\nMSG: {other}\n{text}" for other, text in found.items())
    return genpy.dynamic.generate_dynamic(whole, text)[whole]


def told(value):
    """Returns the JSON form of a message."""
    if isinstance(value, genpy.Message):
        return {slot: told(getattr(value, slot)) for slot in value.__slots__}
    if isinstance(value, genpy.rostime.TVal):
        return [value.secs, value.nsecs]
    if isinstance(value, (list, tuple)):
        return [told(each) for each in value]
    return value
