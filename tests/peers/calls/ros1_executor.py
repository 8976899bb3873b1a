"""Runs a rospy server of services, each `CASE=/name`. For a line on standard input it reports its
executions."""

import argparse
import sys
from pathlib import Path

import rospy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
from calls import ros1_services
from calls.cases import CASES, Messages
from calls.counting import Counted


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("service", nargs="+")
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    counted = Counted(lifetime.say, args.delay)
    rospy.init_node("executor", disable_rosout=True, disable_signals=True)
    lifetime.bound(args.limit)
    for case, _, name in (text.partition("=") for text in args.service):
        kind = CASES[case]
        made = ros1_services.service_class(kind.type)
        if case == "messages":
            Messages.state = made.others["lifecycle_msgs/State"]

        def handle(request, case=case, kind=kind, made=made):
            return counted.execute(case, kind, request, made._response_class())

        rospy.Service(name, made, handle)
    lifetime.say(ready=args.service)
    counted.listen()


main()
