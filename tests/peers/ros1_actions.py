"""Provides the common parts of the actionlib peers: the action, and a clock that is wrong."""

import time

import rospy
import rospy.rostime
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult
from actionlib_msgs.msg import GoalStatus

__all__ = ["TestAction", "TestFeedback", "TestGoal", "TestResult", "status_name", "start"]


def status_name(code):
    return next((name for name, value in vars(GoalStatus).items() if name.isupper() and value == code), str(code))


def start(node, offset):
    """Starts the node; all its ROS times are `offset` seconds off."""

    class Shifted:
        def __getattr__(self, name):
            return getattr(time, name)

        @staticmethod
        def time():
            return time.time() + offset

    rospy.rostime.time = Shifted()
    rospy.init_node(node, disable_rosout=True)
