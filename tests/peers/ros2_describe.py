"""Runs a node of ROS 2 Iron and later through Cyclone DDS, with its own type.

It publishes or reads the type, announces the type's hash, and describes the type on request. The
type is `type_description_interfaces/msg/FieldType`, with the hash that ROS 2 publishes; with
--short HASH it is another type of this name, with the first two fields.
"""

import argparse
import time

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl.types import bounded_str, sequence, uint8, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import lifetime
import ros2_service
import ros2_types
from ros2_service_types import service, struct

HASH = "RIHS01_a70b6dd919645a03a3586f7f821defbc886ea3e531a1d95cc0f380a3973ccaa6"
PACKAGE = "type_description_interfaces"

FieldType = struct(
    f"{PACKAGE}/msg/FieldType",
    [("type_id", uint8, 0), ("capacity", uint64, 0), ("string_capacity", uint64, 0), ("nested_type_name", bounded_str[255], "")],
)
Field = struct(f"{PACKAGE}/msg/Field", [("name", str, ""), ("type", FieldType, FieldType), ("default_value", str, "")])
Individual = struct(
    f"{PACKAGE}/msg/IndividualTypeDescription", [("type_name", bounded_str[255], ""), ("fields", sequence[Field], list)]
)
Description = struct(
    f"{PACKAGE}/msg/TypeDescription",
    [("type_description", Individual, Individual), ("referenced_type_descriptions", sequence[Individual], list)],
)
Source = struct(
    f"{PACKAGE}/msg/TypeSource", [("type_name", str, ""), ("encoding", str, ""), ("raw_file_contents", str, "")]
)
KeyValue = struct(f"{PACKAGE}/msg/KeyValue", [("key", str, ""), ("value", str, "")])
GET = service(
    f"{PACKAGE}/srv/GetTypeDescription",
    [("type_name", str, ""), ("type_hash", str, ""), ("include_type_sources", bool, True)],
    [
        ("successful", bool, False),
        ("failure_reason", str, ""),
        ("type_description", Description, Description),
        ("type_sources", sequence[Source], list),
        ("extra_information", sequence[KeyValue], list),
    ],
)

# type_description_interfaces/msg/FieldType: 3 is uint8, 9 uint64, 21 a bounded string.
TRUE = [("type_id", 3, 0), ("capacity", 9, 0), ("string_capacity", 9, 0), ("nested_type_name", 21, 255)]
LIE = TRUE[:-1]
SHORT = TRUE[:2]
ShortFieldType = struct(f"{PACKAGE}/msg/FieldType", [("type_id", uint8, 0), ("capacity", uint64, 0)])


def described(fields):
    made = [Field(name=name, type=FieldType(type_id=kind, string_capacity=bound)) for name, kind, bound in fields]
    return Description(type_description=Individual(type_name=f"{PACKAGE}/msg/FieldType", fields=made))


def announced(args):
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={args.short or HASH};".encode()),
    )


def tell_node(participant, name, readers, writers):
    """Publishes the list of nodes, with the endpoints as the node's endpoints."""
    import ros2_graph

    gid, entities, kind = ros2_graph.KINDS[16]
    topic = Topic(participant, "ros_discovery_info", kind)
    info = DataWriter(participant, topic, qos=ros2_graph.qos(Policy.History.KeepLast(1)))
    gids = [[gid(list(one.guid.bytes)) for one in endpoints] for endpoints in (readers, writers)]
    info.write(kind(gid(list(participant.guid.bytes)), [entities("/", name, *gids)]))
    return info


def answers(args, server):
    for request in server.reader.take(N=100):
        if not hasattr(request, "count") or args.silent:
            continue
        lifetime.say(asked=request.type_name, hash=request.type_hash)
        fields = SHORT if args.short else LIE if args.lie else TRUE
        server.answer(request, GET[1](successful=True, type_description=described(fields)))


def use(args, participant):
    """Publishes a value (`serve`) or prints the received values (`read`), and describes the type on
    request."""
    server = None
    if not args.no_service:
        server = ros2_service.Server(participant, f"/{args.name}/get_type_description", GET)
    kind = ShortFieldType if args.short else FieldType
    qos = announced(args)
    topic = Topic(participant, f"rt/{args.topic.lstrip('/')}", kind, qos=qos)
    endpoint = DataWriter(participant, topic, qos=qos) if args.role == "serve" else DataReader(participant, topic, qos=qos)
    ends = ([], [endpoint]) if args.role == "serve" else ([endpoint], [])
    kept = tell_node(participant, args.name, *ends)
    if args.role == "serve":
        more = {} if args.short else {"string_capacity": 9, "nested_type_name": "ten"}
        endpoint.write(kind(type_id=7, capacity=8, **more))
    leave = lifetime.told()
    lifetime.say(ready=args.topic)
    while kept and not leave.is_set():
        if server:
            answers(args, server)
        for sample in endpoint.take(N=100) if args.role == "read" else ():
            if sample.sample_info.valid_data:
                lifetime.say(value=ros2_types.plain(sample))
        time.sleep(0.005)


def ask(args, participant):
    """Requests the description of a type from the node --node."""
    client = ros2_service.Client(participant, f"{args.node}/get_type_description", GET)
    lifetime.say(ready=args.node)
    client.wait(10.0)
    reply = client.call(GET[0](type_name=args.type, type_hash=args.hash))
    main = reply.type_description.type_description
    lifetime.say(
        value={
            "successful": reply.successful,
            "reason": reply.failure_reason,
            "type": main.type_name,
            "fields": [[one.name, one.type.type_id, one.type.nested_type_name] for one in main.fields],
            "referenced": [one.type_name for one in reply.type_description.referenced_type_descriptions],
        }
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["serve", "read", "ask"])
    parser.add_argument("--topic", default="/ua_2_2_9")
    parser.add_argument("--domain", type=int, default=2)
    parser.add_argument("--name", default="robot", help="the node's")
    parser.add_argument("--short", default="", help="the other type of that name, and its hash")
    parser.add_argument("--lie", action="store_true", help="leave a field out")
    parser.add_argument("--silent", action="store_true", help="answer nobody who asks")
    parser.add_argument("--no-service", action="store_true", help="do not offer to be asked")
    parser.add_argument("--node", default="/endpoints")
    parser.add_argument("--type", default="std_msgs/msg/String")
    parser.add_argument("--hash", default="")
    parser.add_argument("--limit", type=float, default=60.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    {"serve": use, "read": use, "ask": ask}[args.role](args, DomainParticipant(args.domain))


if __name__ == "__main__":
    main()
