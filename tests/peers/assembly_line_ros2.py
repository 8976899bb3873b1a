"""Simulates the ROS 2 side of the assembly line: a TurtleBot3 that parks and carries a bucket."""

import argparse
import time

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import lifetime
import ros2_types
from ros2_types import Bool, JointState, UInt32

SHOWS = {"/park/busy": Bool(True), "/bucket/busy": Bool(False)}
TAKES = {
    "/conveyor/switch": Bool,
    "/conveyor/running": Bool,
    "/storage/covers": UInt32,
    "/conveyor/covers": UInt32,
    "/turtlebot3/covers": UInt32,
}
# The ROS 1 side has the same topic: each side produces its own.
MORE = {"/joint_states": JointState()}
QOS = Qos(
    Policy.Reliability.Reliable(duration(seconds=10)),
    Policy.Durability.Volatile,
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--domain", type=int, default=2)
    parser.add_argument("--more", action="store_true")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    participant = DomainParticipant(args.domain)

    def topic(name, kind):
        return Topic(participant, ros2_types.dds_topic(name), kind, qos=QOS)

    shows = {**SHOWS, **(MORE if args.more else {})}
    shown = [
        (DataWriter(participant, topic(name, type(value)), qos=QOS), value)
        for name, value in shows.items()
    ]
    taken = [
        (name, DataReader(participant, topic(name, kind), qos=QOS)) for name, kind in TAKES.items()
    ]
    lifetime.say(ready="assembly line")
    while True:
        for writer, value in shown:
            writer.write(value)
        for name, reader in taken:
            for sample in reader.take(N=100):
                if sample.sample_info.valid_data:
                    lifetime.say(heard=name, value=sample.data)
        time.sleep(0.1)


main()
