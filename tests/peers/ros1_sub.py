"""Runs a rospy subscriber: one JSON line per message, with the name of the publishing node."""

import argparse

import rospy

import lifetime
import ros1_definitions
import ros1_messages


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("topic")
    parser.add_argument("type")
    parser.add_argument("--node", default="rospy_sub")
    parser.add_argument("--definitions", help="a folder with the definition of the type")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)

    def heard(message):
        header = message._connection_header
        lifetime.say(
            topic=args.topic,
            callerid=header.get("callerid"),
            type=header.get("type"),
            latching=header.get("latching") == "1",
            value=ros1_messages.plain(message),
        )

    if args.definitions:
        kind = ros1_definitions.Definitions(args.definitions).message(args.type)
    else:
        kind = ros1_messages.message_class(args.type)
    rospy.init_node(args.node, disable_rosout=True)
    subscriber = rospy.Subscriber(
        args.topic, kind, heard, queue_size=None, tcp_nodelay=True
    )
    lifetime.say(ready=args.topic)
    rospy.spin()
    subscriber.unregister()


main()
