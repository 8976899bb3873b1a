"""Runs a rospy server of a service that a folder defines: it answers each request with --answer and
prints a line."""

import argparse
import json

import rospy

import lifetime
import ros1_definitions
import ros1_messages


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("service")
    parser.add_argument("type")
    parser.add_argument("definitions")
    parser.add_argument("--answer", default="{}")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    kind = ros1_definitions.Definitions(args.definitions).service(args.type)

    def answer(request):
        lifetime.say(value=ros1_messages.plain(request))
        return ros1_messages.build(kind._response_class, json.loads(args.answer))

    rospy.init_node("rospy_answer", disable_rosout=True)
    service = rospy.Service(args.service, kind, answer)
    lifetime.say(ready=args.service)
    rospy.spin()
    service.shutdown()


main()
