"""Runs the peer of a crowd: it subscribes to /crowd/out_* and publishes /crowd/in_* to all
subscribers."""

import argparse
import time

import rospy
from std_msgs.msg import String

import lifetime


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("topics", type=int)
    parser.add_argument("--limit", type=float, default=240.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node("rospy_crowd", disable_rosout=True)
    for number in range(args.topics):
        rospy.Subscriber(f"/crowd/out_{number}", String, lambda _: None)
    publishers = [
        rospy.Publisher(f"/crowd/in_{number}", String, queue_size=10, latch=True)
        for number in range(args.topics)
    ]
    for publisher in publishers:
        publisher.publish("here")
    lifetime.say(ready=args.topics)
    while not rospy.is_shutdown():
        time.sleep(0.1)


main()
