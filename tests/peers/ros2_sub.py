"""Runs a Cyclone DDS reader with ROS 2 names: one JSON line per sample."""

import argparse

from cyclonedds.core import ReadCondition, SampleState, ViewState, InstanceState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import lifetime
import ros2_service_types
import ros2_types


def main():
    parser = argparse.ArgumentParser()
    ros2_types.add_arguments(parser)
    args = parser.parse_args()
    lifetime.bound(args.limit)

    qos = ros2_types.qos(args)
    participant = DomainParticipant(args.domain)
    kind = ros2_service_types.MESSAGES.get(args.type) or ros2_types.kind_of(args.type)
    topic = Topic(participant, ros2_types.dds_topic(args.topic), kind, qos=qos)
    reader = DataReader(participant, topic, qos=qos)
    news = ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any)
    waitset = WaitSet(participant)
    waitset.attach(news)
    lifetime.say(ready=args.topic)

    while True:
        waitset.wait(duration(milliseconds=200))
        for sample in reader.take(N=1000):
            if sample.sample_info.valid_data:
                lifetime.say(topic=args.topic, value=ros2_types.plain(sample))


main()
