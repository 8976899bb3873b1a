"""Runs a rospy client: it calls a service once for each --value and prints the response or the
error as a JSON line."""

import argparse
import json

import roslib.message
import rospy

import lifetime
import ros1_messages


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("service")
    parser.add_argument("type")
    parser.add_argument("--value", action="append", required=True)
    parser.add_argument("--persistent", action="store_true")
    parser.add_argument("--limit", type=float, default=60.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)

    kind = roslib.message.get_service_class(args.type)
    rospy.init_node("rospy_client", disable_rosout=True)
    rospy.wait_for_service(args.service, timeout=30)
    proxy = rospy.ServiceProxy(args.service, kind, persistent=args.persistent)
    lifetime.say(ready=args.service)
    for text in args.value:
        fields = json.loads(text)
        try:
            answer = proxy(**fields)
        except rospy.ServiceException as error:
            lifetime.say(error=str(error))
        else:
            lifetime.say(value=ros1_messages.plain(answer))


main()
