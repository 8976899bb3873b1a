"""Runs a rospy subscriber that only counts: one JSON line with the count after each change, and
rospy's errors."""

import argparse
import logging
import threading
import time

import rospy

import lifetime
import ros1_messages


class Said(logging.Handler):
    def emit(self, record):
        lifetime.say(log=record.getMessage())


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("topic")
    parser.add_argument("type", nargs="?", help="without one, any")
    parser.add_argument("--node", default="rospy_tally")
    parser.add_argument("--limit", type=float, default=240.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    kind = ros1_messages.message_class(args.type) if args.type else rospy.AnyMsg

    lock = threading.Lock()
    count = 0

    def heard(_):
        nonlocal count
        with lock:
            count += 1

    rospy.init_node(args.node, disable_rosout=True)
    logging.getLogger("rospy").addHandler(Said(logging.ERROR))
    rospy.Subscriber(args.topic, kind, heard, queue_size=None, tcp_nodelay=True)
    lifetime.say(ready=args.topic)
    said = 0
    while not rospy.is_shutdown():
        with lock:
            now = count
        if now != said:
            said = now
            lifetime.say(tally=now)
        time.sleep(0.05)


main()
