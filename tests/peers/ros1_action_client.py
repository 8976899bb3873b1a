"""Runs an actionlib client, controlled by lines of standard input: `send N` sends the goal N and
numbers it by the count of goals so far, `cancel COUNT` cancels that goal, `cancel_all` cancels all
goals. It prints the events of its goals."""

import argparse
import sys

import actionlib
import rospy

import lifetime
from ros1_actions import TestAction, TestGoal, start, status_name


class Many:
    """Sends goals side by side, by ActionClient."""

    def __init__(self, name):
        self.client = actionlib.ActionClient(name, TestAction)
        self.sent = []

    def send(self, number):
        count = len(self.sent)

        def transition(handle):
            state = actionlib.CommState.to_string(handle.get_comm_state())
            lifetime.say(count=count, state=state)
            if state == "DONE":
                result = handle.get_result()
                lifetime.say(
                    count=count,
                    end=status_name(handle.get_terminal_state()),
                    text=handle.get_goal_status_text(),
                    result=result.result if result else None,
                )

        def feedback(_handle, feedback):
            lifetime.say(count=count, feedback=feedback.feedback)

        self.sent.append(self.client.send_goal(TestGoal(goal=number), transition, feedback))

    def cancel(self, count):
        self.sent[count].cancel()

    def cancel_all(self):
        self.client.cancel_all_goals()


class Simple:
    """Follows the last goal only, by SimpleActionClient."""

    def __init__(self, name):
        self.client = actionlib.SimpleActionClient(name, TestAction)
        self.count = 0

    def send(self, number):
        count = self.count
        self.count += 1

        def done(status, result):
            text = self.client.get_goal_status_text()
            lifetime.say(count=count, end=status_name(status), text=text, result=result.result)

        # The client knows the goal as its own only after the call returns, and would lose an
        # earlier response.
        with self.client.action_client.manager.list_mutex:
            self.client.send_goal(
                TestGoal(goal=number),
                done,
                lambda: lifetime.say(count=count, state="ACTIVE"),
                lambda feedback: lifetime.say(count=count, feedback=feedback.feedback),
            )

    def cancel(self, _count):
        self.client.cancel_goal()

    def cancel_all(self):
        self.client.cancel_all_goals()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("--node", default="rospy_action_client")
    parser.add_argument("--simple", action="store_true")
    parser.add_argument("--clock-offset", type=float, default=0.0)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    start(args.node, args.clock_offset)
    driving = (Simple if args.simple else Many)(args.name)
    found = driving.client.wait_for_server(rospy.Duration(30.0))
    if not found:
        sys.exit("no server was found")
    lifetime.say(ready=args.name)
    for line in sys.stdin:
        word, *numbers = line.split()
        getattr(driving, word)(*map(int, numbers))
        lifetime.say(told=line.strip())
    rospy.spin()


main()
