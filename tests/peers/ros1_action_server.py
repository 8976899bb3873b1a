"""Runs an actionlib server. The number of the goal selects the reaction.

- -2: the goal is rejected.
- -1: the goal is aborted.
- 100 and more: the goal sends the number plus one as feedback and runs until it is cancelled.
- Others: the goal succeeds with twice the number.

With --simple no goal is rejected or aborted, and there is no feedback.
"""

import argparse

import actionlib
import rospy

import lifetime
from ros1_actions import TestAction, TestFeedback, TestResult, start


class Many:
    """Executes goals side by side, by ActionServer."""

    def __init__(self, name):
        self.held = {}
        self.server = actionlib.ActionServer(name, TestAction, self.goal, self.cancel, auto_start=False)

    def goal(self, handle):
        number = handle.get_goal().goal
        lifetime.say(goal=number, id=handle.get_goal_id().id)
        if number == -2:
            handle.set_rejected(TestResult(result=2), "no")
            return
        handle.set_accepted("on it")
        if number == -1:
            handle.set_aborted(TestResult(result=3), "failed")
        elif number >= 100:
            self.held[handle.get_goal_id().id] = handle
            handle.publish_feedback(TestFeedback(feedback=number + 1))
        else:
            handle.set_succeeded(TestResult(result=2 * number), "done")

    def cancel(self, handle):
        lifetime.say(cancel=handle.get_goal().goal)
        held = self.held.pop(handle.get_goal_id().id)
        held.set_canceled(TestResult(result=7), "stopped")


class Simple:
    """Replaces the older goal with a newer goal, by SimpleActionServer."""

    def __init__(self, name):
        self.server = actionlib.SimpleActionServer(name, TestAction, self.work, auto_start=False)

    def work(self, goal):
        lifetime.say(goal=goal.goal)
        while goal.goal >= 100 and not self.server.is_preempt_requested() and not rospy.is_shutdown():
            rospy.sleep(0.01)
        if goal.goal >= 100:
            self.server.set_preempted(TestResult(result=7), "stopped")
        else:
            self.server.set_succeeded(TestResult(result=2 * goal.goal), "done")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("--node", default="rospy_action_server")
    parser.add_argument("--simple", action="store_true")
    parser.add_argument("--clock-offset", type=float, default=0.0)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    start(args.node, args.clock_offset)
    serving = (Simple if args.simple else Many)(args.name)
    serving.server.start()
    lifetime.say(ready=args.name)
    rospy.spin()


main()
