"""Runs an actionlib client, controlled by JSON lines on standard input.

- {"send": GOAL} sends a goal.
- {"cancel": N} cancels a goal, with N counting goals from 0.
- {"cancel_all": true} cancels all goals.
- {"accepts": N}, only with --plain, sends N empty goals, each after the previous goal was accepted,
  and prints how long each acceptance took.

It prints the events of its goals. With --plain several goals run side by side, else a newer goal
replaces the older goal.
"""

import argparse
import json
import sys
import threading
import time
from pathlib import Path

import actionlib
import genpy
import rospy
from actionlib_msgs.msg import GoalStatus

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
from calls.actionlib_types import action_class, told


def status_name(code):
    return next((name for name, value in vars(GoalStatus).items() if name.isupper() and value == code), str(code))


class Plain:
    """Sends goals side by side, by ActionClient."""

    def __init__(self, name, kind):
        self.client = actionlib.ActionClient(name, kind)
        self.sent = []

    def send(self, goal):
        count = len(self.sent)

        def transition(handle):
            state = actionlib.CommState.to_string(handle.get_comm_state())
            lifetime.say(goal=count, state=state)
            if state in ("DONE", "LOST"):
                ended(count, handle.get_terminal_state(), handle.get_goal_status_text(), handle.get_result())

        def feedback(_handle, message):
            lifetime.say(goal=count, feedback=told(message))

        self.sent.append(self.client.send_goal(goal, transition, feedback))

    def cancel(self, count):
        self.sent[count].cancel()

    def accepts(self, goal, count):
        took = []
        for _ in range(count):
            accepted = threading.Event()

            def transition(handle, accepted=accepted):
                if handle.get_comm_state() not in (actionlib.CommState.WAITING_FOR_GOAL_ACK, actionlib.CommState.PENDING):
                    accepted.set()

            start = time.monotonic_ns()
            # A client without a handle of a goal gets no events of it.
            handle = self.client.send_goal(goal, transition)
            accepted.wait()
            took.append(time.monotonic_ns() - start)
            del handle
        lifetime.say(ns=took)


class Simple:
    """Follows the last goal only, by SimpleActionClient."""

    def __init__(self, name, kind):
        self.client = actionlib.SimpleActionClient(name, kind)
        self.count = 0
        self.over = False

    def send(self, goal):
        # The client registers an end only after its callback, and would take a late end for the end
        # of the next goal.
        while self.over and self.client.simple_state != actionlib.SimpleGoalState.DONE:
            time.sleep(0.001)
        count = self.count
        self.count += 1
        self.over = False

        def done(status, result):
            self.over = True
            ended(count, status, self.client.get_goal_status_text(), result)

        # The client knows the goal as its own only after the call returns, and would lose an
        # earlier response.
        with self.client.action_client.manager.list_mutex:
            self.client.send_goal(
                goal,
                done,
                lambda: lifetime.say(goal=count, state="ACTIVE"),
                lambda message: lifetime.say(goal=count, feedback=told(message)),
            )

    def cancel(self, _count):
        self.client.cancel_goal()


def ended(count, status, text, result):
    lifetime.say(goal=count, end=status_name(status), text=text, result=told(result))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("type")
    parser.add_argument("--node", default="actionlib_client")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node(args.node, disable_rosout=True)
    kind = action_class(args.type)
    driving = (Plain if args.plain else Simple)(args.name, kind)
    if not driving.client.wait_for_server(rospy.Duration(60.0)):
        sys.exit("no server was found")
    lifetime.say(ready=args.name)
    for line in sys.stdin:
        order = json.loads(line)
        if "send" in order:
            goal = type(kind().action_goal.goal)()
            genpy.message.fill_message_args(goal, [order["send"]])
            driving.send(goal)
        elif "accepts" in order:
            driving.accepts(type(kind().action_goal.goal)(), order["accepts"])
        elif "cancel" in order:
            driving.cancel(order["cancel"])
        else:
            driving.client.cancel_all_goals()
        lifetime.say(told=order)
    rospy.spin()


main()
