"""Runs a rospy node that repeats a topic of any type under another name."""

import argparse

import rospy
from rospy.msg import AnyMsg
from std_msgs.msg import String

import lifetime


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("input")
    parser.add_argument("output")
    parser.add_argument("--node", default="rospy_relay")
    parser.add_argument("--limit", type=float, default=1800.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node(args.node, disable_rosout=True)
    # The bytes are forwarded unchanged; only subscribers see a type, which is std_msgs/String.
    publisher = rospy.Publisher(args.output, String, queue_size=1000, tcp_nodelay=True)
    rospy.Subscriber(args.input, AnyMsg, publisher.publish, queue_size=None, tcp_nodelay=True)
    lifetime.say(ready=args.output)
    rospy.spin()


main()
