"""Prints the graph as a ROS 2 node sees it, through Cyclone DDS: nodes, readers, writers and their
announcements.

It receives `ros_discovery_info` with Gids of 16 bytes (from Iron on) or of 24 bytes (up to Humble),
and Cyclone's built-in topics, and prints its knowledge as one JSON line after each change. Each
--node announces a node of that name, in its own participant and with Gids of the same length.
"""

import argparse
import time
from dataclasses import dataclass, field

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import InstanceState, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, bounded_str, sequence, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import lifetime


@dataclass
@final
class Gid16(IdlStruct, typename="rmw_dds_common.msg.dds_.Gid_"):
    data: array[uint8, 16] = field(default_factory=lambda: [0] * 16)


@dataclass
@final
class NodeEntities16(IdlStruct, typename="rmw_dds_common.msg.dds_.NodeEntitiesInfo_"):
    node_namespace: bounded_str[256] = "/"
    node_name: bounded_str[256] = ""
    reader_gid_seq: sequence[Gid16] = field(default_factory=list)
    writer_gid_seq: sequence[Gid16] = field(default_factory=list)


@dataclass
@final
class Participant16(IdlStruct, typename="rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_"):
    gid: Gid16 = field(default_factory=Gid16)
    node_entities_info_seq: sequence[NodeEntities16] = field(default_factory=list)


@dataclass
@final
class Gid24(IdlStruct, typename="rmw_dds_common.msg.dds_.Gid_"):
    data: array[uint8, 24] = field(default_factory=lambda: [0] * 24)


@dataclass
@final
class NodeEntities24(IdlStruct, typename="rmw_dds_common.msg.dds_.NodeEntitiesInfo_"):
    node_namespace: bounded_str[256] = "/"
    node_name: bounded_str[256] = ""
    reader_gid_seq: sequence[Gid24] = field(default_factory=list)
    writer_gid_seq: sequence[Gid24] = field(default_factory=list)


@dataclass
@final
class Participant24(IdlStruct, typename="rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_"):
    gid: Gid24 = field(default_factory=Gid24)
    node_entities_info_seq: sequence[NodeEntities24] = field(default_factory=list)


KINDS = {16: (Gid16, NodeEntities16, Participant16), 24: (Gid24, NodeEntities24, Participant24)}


def qos(history):
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.Durability.TransientLocal,
        history,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def user_data(policies):
    found = policies[Policy.Userdata] if Policy.Userdata in policies else None
    return bytes(found.data).decode("latin-1") if found else ""


def policy(policies, kind):
    return type(policies[kind]).__name__ if kind in policies else ""


def milliseconds(policies):
    """Returns the deadline; None without a deadline."""
    found = policies[Policy.Deadline].deadline if Policy.Deadline in policies else None
    return None if found is None or found > 2**60 else found // 1_000_000


def alive(reader):
    found = reader.read(N=20000)
    return [s for s in found if s.sample_info.valid_data and s.sample_info.instance_state == InstanceState.Alive]


def endpoints(reader):
    return {
        one.key.bytes.hex(): {
            "participant": one.participant_key.bytes.hex(),
            "topic": one.topic_name,
            "type": one.type_name,
            "user_data": user_data(one.qos),
            "reliability": policy(one.qos, Policy.Reliability),
            "durability": policy(one.qos, Policy.Durability),
            "deadline": milliseconds(one.qos),
        }
        for one in alive(reader)
    }


def hear(reader, known):
    """Takes the lists of nodes, and counts samples with Gids of another length."""
    while True:
        try:
            samples = reader.take(N=1)
        except Exception:  # the decoder raises many kinds of exceptions
            known["unreadable"] += 1
            continue
        if not samples:
            return
        for sample in samples:
            if not sample.sample_info.valid_data:
                continue
            known["nodes"][bytes(sample.gid.data[:16]).hex()] = [
                {
                    "name": node.node_namespace.rstrip("/") + "/" + node.node_name,
                    "readers": sorted(bytes(gid.data[:16]).hex() for gid in node.reader_gid_seq),
                    "writers": sorted(bytes(gid.data[:16]).hex() for gid in node.writer_gid_seq),
                }
                for node in sample.node_entities_info_seq
            ]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--gid", type=int, choices=[16, 24], default=16)
    parser.add_argument("--node", action="append", default=[], help="be a node of that name too, in a participant of its own")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)

    gid, entities, kind = KINDS[args.gid]
    participant = DomainParticipant(args.domain)
    topic = Topic(participant, "ros_discovery_info", kind)
    heard = DataReader(participant, topic, qos=qos(Policy.History.KeepAll))
    participants = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
    publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    subscriptions = BuiltinDataReader(participant, BuiltinTopicDcpsSubscription)

    own = []
    for name in args.node:
        one = DomainParticipant(args.domain)
        writer = DataWriter(one, Topic(one, "ros_discovery_info", kind), qos=qos(Policy.History.KeepLast(1)))
        padded = list(one.guid.bytes) + [0] * (args.gid - 16)
        writer.write(kind(gid(padded), [entities("/", name, [], [])]))
        own.append((one, writer))

    lifetime.say(ready="graph")
    known = {"nodes": {}, "unreadable": 0}
    before = None
    while True:
        hear(heard, known)
        now = {
            "nodes": dict(known["nodes"]),
            "unreadable": known["unreadable"],
            "participants": {one.key.bytes.hex(): user_data(one.qos) for one in alive(participants)},
            "publications": endpoints(publications),
            "subscriptions": endpoints(subscriptions),
        }
        now["nodes"] = {key: nodes for key, nodes in now["nodes"].items() if key in now["participants"]}
        if now != before:
            lifetime.say(graph=now)
            before = now
        time.sleep(0.05)


if __name__ == "__main__":
    main()
