"""Runs a rospy node that sets parameters and a clock by JSON objects, one per line of standard
input.

{"set": name, "value": value}, {"delete": name}, {"get": name}, {"search": name},
{"clock": [secs, nsecs]}
"""

import argparse
import json
import sys
import threading

import rospy
from rosgraph_msgs.msg import Clock

import lifetime


def answer(asked, clock):
    if "set" in asked:
        rospy.set_param(asked["set"], asked["value"])
    elif "delete" in asked:
        rospy.delete_param(asked["delete"])
    elif "get" in asked:
        return rospy.get_param(asked["get"], None)
    elif "search" in asked:
        return rospy.search_param(asked["search"])
    elif "clock" in asked:
        clock.publish(rospy.Time(*asked["clock"]))
    return "done"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--node", default="rospy_params")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node(args.node, disable_rosout=True)
    clock = rospy.Publisher("/clock", Clock, queue_size=10, latch=True, tcp_nodelay=True)

    def follow():
        for line in sys.stdin:
            asked = json.loads(line)
            lifetime.say(asked=asked, value=answer(asked, clock))

    threading.Thread(target=follow, daemon=True).start()
    lifetime.say(ready=args.node)
    rospy.spin()


main()
