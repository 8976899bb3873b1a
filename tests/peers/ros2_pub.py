"""Runs a Cyclone DDS writer with ROS 2 names. Values come as JSON from --value or standard input.

It stays after the last value; a line on standard input then makes it leave in order.
"""

import argparse
import json
import time

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

import lifetime
import ros2_types


def main():
    parser = argparse.ArgumentParser()
    ros2_types.add_arguments(parser)
    parser.add_argument("--value", action="append")
    parser.add_argument("--numbered", type=int, help="send this many numbers instead of values")
    parser.add_argument("--warm-up", help="JSON value to send ten times a second until a line comes on standard input")
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--repeat", type=int, default=1, help="how often to send the values; 0: until told to end")
    parser.add_argument("--wait-readers", type=int, default=0)
    args = parser.parse_args()
    lifetime.bound(args.limit)

    kind = ros2_types.kind_of(args.type)
    if args.numbered is not None:
        values = [str(number) for number in range(args.numbered)]
    else:
        values = lifetime.values_of(args)
    samples = [ros2_types.build(kind, value) for value in values]

    qos = ros2_types.qos(args)
    participant = DomainParticipant(args.domain)
    topic = Topic(participant, ros2_types.dds_topic(args.topic), kind, qos=qos)
    writer = DataWriter(participant, topic, qos=qos)
    lifetime.say(ready=args.topic)
    while ros2_types.matched(writer) < args.wait_readers:
        time.sleep(0.005)

    if args.warm_up is not None:
        told = lifetime.told()
        warm_up = ros2_types.build(kind, json.loads(args.warm_up))
        while not told.wait(0.1):
            writer.write(warm_up)

    start = time.monotonic()
    sent = 0
    turn = 0
    while args.repeat == 0 or turn < args.repeat:
        for sample in samples:
            wait = start + sent / args.rate - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            writer.write(sample)
            sent += 1
        turn += 1
    lifetime.say(sent=sent)
    lifetime.told().wait()


main()
