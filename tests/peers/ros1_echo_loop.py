"""Runs a rospy node that sends every topic of the space back onto itself: the bridge must not make
a loop of it.

The node also receives its own publications and ignores them; otherwise it would make a loop without
a bridge.
"""

import argparse
import re
import time

import rospy

import lifetime
import ros1_messages

IN_THE_SPACE = re.compile(r"^/ua_\d+_\d+_\d+$")


class Echo:
    def __init__(self, topic, type_name):
        self.topic = topic
        self.count = 0
        kind = ros1_messages.message_class(type_name)
        self.publisher = rospy.Publisher(topic, kind, queue_size=1000, tcp_nodelay=True)
        self.subscriber = rospy.Subscriber(topic, kind, self.heard, queue_size=None, tcp_nodelay=True)

    def heard(self, message):
        sender = message._connection_header.get("callerid")
        if sender == rospy.get_name():
            return
        self.publisher.publish(message)
        self.count += 1
        lifetime.say(echoed=self.topic, count=self.count, callerid=sender)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--node", default="rospy_echo")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node(args.node, disable_rosout=True)
    lifetime.say(ready=True)

    echoes = {}
    while not rospy.is_shutdown():
        for topic, type_name in rospy.get_published_topics():
            if IN_THE_SPACE.match(topic) and topic not in echoes:
                echoes[topic] = Echo(topic, type_name)
                lifetime.say(echoing=topic)
        time.sleep(0.05)


main()
