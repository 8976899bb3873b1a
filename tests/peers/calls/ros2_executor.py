"""Runs an rclpy server of services, each `CASE=/name`. For a line on standard input it reports its
executions."""

import argparse
import sys
from pathlib import Path

import rclpy
from lifecycle_msgs.msg import State
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.signals import SignalHandlerOptions

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
from calls.cases import CASES, Messages
from calls.counting import Counted
from calls.ros2_services import DEEP, service_class, spinning


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("service", nargs="+")
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--threads", type=int, default=4)
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    lifetime.bound(args.limit)
    counted = Counted(lifetime.say, args.delay)
    node = rclpy.create_node("executor")
    Messages.state = State
    group = ReentrantCallbackGroup()
    for case, _, name in (text.partition("=") for text in args.service):
        kind = CASES[case]

        def handle(request, response, case=case, kind=kind):
            return counted.execute(case, kind, request, response)

        node.create_service(service_class(kind.type), name, handle, qos_profile=DEEP, callback_group=group)
    spinning(node, args.threads)
    lifetime.say(ready=args.service)
    counted.listen()


main()
