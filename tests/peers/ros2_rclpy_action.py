"""Runs an action of `test_msgs/Fibonacci` with rclpy itself: the behavior of rcl_action, and its
view of the graph.

`serve` decides about goals by their order: -1 is rejected and -2 is aborted. Other goals get the
numbers one by one as feedback and succeed. Goals from 100 on get three numbers and run until they
are cancelled; odd orders refuse a cancel. Order 110 succeeds although it was cancelled, and order
112 is aborted. With `--decides-after` the server decides this number of seconds late.

`call` executes lines of standard input: `send ORDER`, `cancel N`, `cancel_all`, `cancel_unknown`,
`cancel_until N`, `result N`, `result_unknown`, and `back` and `gone`, which wait for a server or
its loss, with N counting goals from 0. It requests results by itself only with --results.
`accepts N` sends N goals of order 0, each after the previous goal was accepted, and prints how long
each acceptance took.

Both roles also execute `node NAME`, which prints the actions of a node; `action NAME`, the
endpoints of an action; `participants`, the number of processes; `watch`, which prints each status
as a late subscriber receives it; `leave`, which ends the process like rclpy.
"""

import argparse
import os
import queue
import sys
import threading
import time
import uuid

import rclpy
from action_msgs.msg import GoalInfo, GoalStatusArray
from action_msgs.srv import CancelGoal
from builtin_interfaces.msg import Time
from rclpy.action import (
    ActionClient,
    ActionServer,
    CancelResponse,
    GoalResponse,
    get_action_client_names_and_types_by_node,
    get_action_server_names_and_types_by_node,
)
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import qos_profile_action_status_default
from rclpy.signals import SignalHandlerOptions
from test_msgs.action import Fibonacci, NestedMessage
from unique_identifier_msgs.msg import UUID

import lifetime

NAMES = ["UNKNOWN", "ACCEPTED", "EXECUTING", "CANCELING", "SUCCEEDED", "CANCELED", "ABORTED"]
CODES = ["NONE", "REJECTED", "UNKNOWN_GOAL_ID", "GOAL_TERMINATED"]
TURN = 0.005


def lines():
    """Returns a queue with the lines of standard input."""
    waiting = queue.Queue()

    def read():
        for line in sys.stdin:
            waiting.put(line.split())

    threading.Thread(target=read, daemon=True).start()
    return waiting


class Server:
    def __init__(self, node, args):
        self.numbers, self.late = {}, args.decides_after
        options = {} if args.keep is None else {"result_timeout": args.keep}
        self.end = ActionServer(
            node,
            Fibonacci,
            args.action,
            self.work,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=self.decide,
            cancel_callback=self.decide_cancel,
            **options,
        )

    def decide(self, goal):
        if self.late:
            lifetime.say(asked=goal.order)
            time.sleep(self.late)
        lifetime.say(goal=goal.order, accepted=goal.order != -1)
        return GoalResponse.REJECT if goal.order == -1 else GoalResponse.ACCEPT

    def decide_cancel(self, goal):
        order = goal.request.order
        lifetime.say(cancel=order)
        return CancelResponse.REJECT if order % 2 else CancelResponse.ACCEPT

    def work(self, goal):
        order, numbers = goal.request.order, []
        for _ in range(3 if order >= 100 else max(order, 0)):
            numbers.append(sum(numbers[-2:]) if len(numbers) > 1 else 1)
            goal.publish_feedback(Fibonacci.Feedback(sequence=numbers))
        while order >= 100 and not goal.is_cancel_requested:
            time.sleep(TURN)
        if self.late:
            lifetime.say(worked=order, cancelled=goal.is_cancel_requested)
        if order in (-2, 112):
            goal.abort()
        elif order >= 100 and order != 110:
            goal.canceled()
        else:
            goal.succeed()
        return Fibonacci.Result(sequence=numbers)

    def turn(self):
        pass

    def run(self, words):
        raise SystemExit(f"there is no {words[0]}")


class Client:
    def __init__(self, node, args):
        self.args = args
        self.end = ActionClient(node, Fibonacci, args.action)
        # These requests are possible by `ros2 service call`, but not by an action client.
        self.cancel = node.create_client(CancelGoal, f"{args.action}/_action/cancel_goal")
        self.result = node.create_client(Fibonacci.Impl.GetResultService, f"{args.action}/_action/get_result")
        self.ids, self.handles, self.said, self.asked, self.waits = [], {}, {}, [], []
        self.took = []

    def ready(self):
        services = (self.cancel, self.result)
        return self.end.server_is_ready() and all(part.service_is_ready() for part in services)

    def then(self, future, say):
        self.asked.append((future, say))

    def send(self, order):
        number = len(self.ids)
        self.ids.append(UUID(uuid=list(uuid.uuid4().bytes)))
        self.then(
            self.end.send_goal_async(
                Fibonacci.Goal(order=order),
                lambda message: lifetime.say(feedback=number, sequence=list(message.feedback.sequence)),
                self.ids[number],
            ),
            lambda handle: self.answered(number, handle),
        )

    def answered(self, number, handle):
        lifetime.say(goal=number, accepted=handle.accepted)
        self.handles[number] = handle
        if handle.accepted and self.args.results:
            self.then(handle.get_result_async(), lambda answer: self.ended(number, answer))

    def measure(self, left):
        if not left:
            lifetime.say(ns=self.took)
            self.took = []
            return
        start = time.monotonic_ns()

        def accepted(future):
            self.took.append(time.monotonic_ns() - start)
            self.measure(left - 1)

        self.end.send_goal_async(Fibonacci.Goal(order=0)).add_done_callback(accepted)

    def ended(self, number, answer):
        lifetime.say(result=number, status=NAMES[answer.status], sequence=list(answer.result.sequence))

    def cancelled(self, answer):
        ids = [list(one.uuid) for one in self.ids]
        told = [list(info.goal_id.uuid) for info in answer.goals_canceling]
        # Goals of other clients are not counted here.
        goals = [ids.index(one) if one in ids else None for one in told]
        lifetime.say(cancel=CODES[answer.return_code], goals=goals)

    def ask_cancel(self, goal_id=None, stamp=None):
        info = GoalInfo(goal_id=goal_id or UUID(), stamp=stamp or Time())
        self.then(self.cancel.call_async(CancelGoal.Request(goal_info=info)), self.cancelled)

    def run(self, words):
        verb, number = words[0], int(words[1]) if len(words) > 1 else None
        unknown = UUID(uuid=list(uuid.uuid4().bytes))
        if verb == "send":
            self.send(number)
        elif verb == "accepts":
            self.measure(number)
        elif verb == "cancel":
            self.then(self.handles[number].cancel_goal_async(), self.cancelled)
        elif verb == "cancel_until":
            self.ask_cancel(stamp=self.handles[number].stamp)
        elif verb == "cancel_all":
            self.ask_cancel()
        elif verb == "cancel_unknown":
            self.ask_cancel(unknown)
        elif verb == "result":
            self.then(self.handles[number].get_result_async(), lambda answer: self.ended(number, answer))
        elif verb == "result_unknown":
            request = Fibonacci.Impl.GetResultService.Request(goal_id=unknown)
            self.then(self.result.call_async(request), lambda answer: self.ended(None, answer))
        elif verb in ("back", "gone"):
            self.waits.append(verb)
        else:
            raise SystemExit(f"there is no {verb}")

    def turn(self):
        for verb in [verb for verb in self.waits if (verb == "back") == self.ready()]:
            self.waits.remove(verb)
            lifetime.say(**{verb: True})
        waiting, self.asked = self.asked, []
        for future, say in waiting:
            if future.done():
                say(future.result())
            else:
                self.asked.append((future, say))
        for number, handle in self.handles.items():
            if handle.accepted and self.said.get(number) != handle.status:
                self.said[number] = handle.status
                lifetime.say(state=number, status=NAMES[handle.status])


def say_node(node, name):
    """Prints a node's actions like `ros2 node info`."""
    actions = {}
    for role, ask in (
        ("servers", get_action_server_names_and_types_by_node),
        ("clients", get_action_client_names_and_types_by_node),
    ):
        try:
            actions[role] = ask(node, name, "/")
        except NodeNameNonExistentError:
            actions[role] = None
    lifetime.say(node=name, **actions)


def say_action(node, action):
    """Prints the properties of each endpoint of an action; the endpoints of its services have the
    names of DDS."""
    base, seen = f"{action}/_action", []
    topics = [(f"{base}/feedback", False), (f"{base}/status", False)]
    for part in ("send_goal", "cancel_goal", "get_result"):
        topics += [(f"rq{base}/{part}Request", True), (f"rr{base}/{part}Reply", True)]
    for topic, plain in topics:
        for kind, ask in (("writer", node.get_publishers_info_by_topic), ("reader", node.get_subscriptions_info_by_topic)):
            for one in ask(topic, plain):
                seen.append(
                    {
                        "topic": topic,
                        "kind": kind,
                        "node": one.node_name,
                        "type": one.topic_type,
                        "hash": str(one.topic_type_hash),
                        "reliability": one.qos_profile.reliability.name,
                        "durability": one.qos_profile.durability.name,
                    }
                )
    lifetime.say(action=action, endpoints=seen)


def watch(node, action):
    def heard(message):
        lifetime.say(list=[NAMES[one.status] for one in message.status_list])

    node.create_subscription(GoalStatusArray, f"{action}/_action/status", heard, qos_profile_action_status_default)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["serve", "call"])
    parser.add_argument("action")
    parser.add_argument("--keep", type=int, help="how many seconds the server keeps results")
    parser.add_argument("--decides-after", type=float, default=0.0, help="how many seconds the server takes to decide")
    parser.add_argument("--results", action="store_true", help="the client asks for the result of what is accepted")
    parser.add_argument("--nested", help="a server of test_msgs/NestedMessage beside it")
    parser.add_argument("--wait", type=float, default=20.0)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node(f"rclpy_{args.role}")
    part = {"serve": Server, "call": Client}[args.role](node, args)
    executor = MultiThreadedExecutor(num_threads=16) if args.role == "serve" else SingleThreadedExecutor()
    executor.add_node(node)
    if args.nested:
        # Only its endpoints are needed.
        ActionServer(node, NestedMessage, args.nested, lambda goal: NestedMessage.Result())
    end = time.monotonic() + args.wait
    while args.role == "call" and not part.ready():
        if time.monotonic() > end:
            raise SystemExit("no server within the time")
        time.sleep(TURN)
    lifetime.say(ready=args.action)
    told = lines()
    while True:
        executor.spin_once(timeout_sec=TURN)
        part.turn()
        if told.empty():
            continue
        words = told.get()
        if words[0] == "node":
            say_node(node, words[1])
        elif words[0] == "action":
            say_action(node, words[1])
        elif words[0] == "participants":
            lifetime.say(participants=len(node.get_publishers_info_by_topic("ros_discovery_info", True)))
        elif words[0] == "watch":
            watch(node, args.action)
        elif words[0] == "leave":
            part.end.destroy()
            node.destroy_node()
            rclpy.shutdown()
            lifetime.say(left=args.action)
            os._exit(0)
        else:
            part.run(words)


if __name__ == "__main__":
    main()
