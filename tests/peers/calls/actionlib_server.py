"""Runs an actionlib server. A number in the goal selects the reaction.

- -1: the goal is rejected; with --simple it is aborted after some feedback.
- -2: the goal is aborted after some feedback.
- 100 and more: the goal sends feedback until it is cancelled.
- Others: the goal sends feedback and succeeds.
"""

import argparse
import sys
import threading
from pathlib import Path

import actionlib
import rospy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
from calls.actionlib_types import action_class, told


class Fibonacci:
    @staticmethod
    def number(goal):
        return goal.order

    @staticmethod
    def reports(goal, make):
        for count in range(1, (3 if goal.order >= 100 else max(goal.order, 0)) + 1):
            yield make(sequence=Fibonacci.numbers(count))

    @staticmethod
    def numbers(count):
        numbers = []
        for _ in range(count):
            numbers.append(sum(numbers[-2:]) if len(numbers) > 1 else 1)
        return numbers

    @staticmethod
    def result(goal, make):
        return make(sequence=Fibonacci.numbers(3 if goal.order >= 100 else max(goal.order, 0)))


class MoveBase:
    @staticmethod
    def number(goal):
        return int(goal.target_pose.pose.position.x)

    @staticmethod
    def reports(goal, make):
        yield make(base_position=goal.target_pose)

    @staticmethod
    def result(_goal, make):
        return make()


class FollowJointTrajectory:
    @staticmethod
    def number(goal):
        return int(goal.trajectory.points[0].positions[0])

    @staticmethod
    def reports(goal, make):
        yield make(joint_names=goal.trajectory.joint_names, desired=goal.trajectory.points[-1])

    @staticmethod
    def result(goal, make):
        return make(error_code=-len(goal.trajectory.points), error_string=goal.path_tolerance[0].name)


KINDS = {each.__name__: each for each in (Fibonacci, MoveBase, FollowJointTrajectory)}


class Common:
    def __init__(self, name, kind, work):
        made = kind()
        self.feedback = type(made.action_feedback.feedback)
        self.result = type(made.action_result.result)
        self.name, self.kind, self.does = name, kind, work

    def meet(self, goal):
        number = self.does.number(goal)
        lifetime.say(goal=number, body=told(goal))
        return number


class Many(Common):
    """Executes goals side by side, by ActionServer."""

    def __init__(self, name, kind, work):
        super().__init__(name, kind, work)
        self.held = {}
        self.server = actionlib.ActionServer(name, kind, self.take, self.cancel, auto_start=False)

    def take(self, handle):
        number = self.meet(handle.get_goal())
        if number == -1:
            handle.set_rejected(self.result(), "not that one")
            return
        handle.set_accepted("on it")
        self.held[handle.get_goal_id().id] = threading.Event()
        threading.Thread(target=self.work, args=(handle, number), daemon=True).start()

    def work(self, handle, number):
        goal = handle.get_goal()
        for report in self.does.reports(goal, self.feedback):
            handle.publish_feedback(report)
        result = self.does.result(goal, self.result)
        if number >= 100:
            self.held[handle.get_goal_id().id].wait()
            handle.set_canceled(result, "stopped")
        elif number == -2:
            handle.set_aborted(result, "it broke")
        else:
            handle.set_succeeded(result, "there")
        lifetime.say(done=number)

    def cancel(self, handle):
        lifetime.say(cancel=self.does.number(handle.get_goal()))
        self.held[handle.get_goal_id().id].set()


class Simple(Common):
    """Replaces the older goal with a newer goal, by SimpleActionServer."""

    def __init__(self, name, kind, work):
        super().__init__(name, kind, work)
        self.server = actionlib.SimpleActionServer(name, kind, self.work, auto_start=False)

    def work(self, goal):
        number = self.meet(goal)
        for report in self.does.reports(goal, self.feedback):
            self.server.publish_feedback(report)
        while number >= 100 and not self.server.is_preempt_requested() and not rospy.is_shutdown():
            rospy.sleep(0.01)
        result = self.does.result(goal, self.result)
        if number >= 100:
            lifetime.say(cancel=number)
            self.server.set_preempted(result, "stopped")
        elif number < 0:
            self.server.set_aborted(result, "it broke")
        else:
            self.server.set_succeeded(result, "there")
        lifetime.say(done=number)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("type")
    parser.add_argument("--node", default="actionlib_server")
    parser.add_argument("--simple", action="store_true")
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node(args.node, disable_rosout=True)
    work = KINDS[args.type.split("/")[1]]
    serving = (Simple if args.simple else Many)(args.name, action_class(args.type), work)
    serving.server.start()
    lifetime.say(ready=args.name)
    rospy.spin()


main()
