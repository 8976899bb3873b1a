"""Defines the ROS 2 interfaces of the tests, with the names that ROS 2 gives them on DDS."""

import base64
from dataclasses import dataclass, field, fields, is_dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float32, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.util import duration


@dataclass
@final
class Bool(IdlStruct, typename="std_msgs.msg.dds_.Bool_"):
    data: bool = False


@dataclass
@final
class UInt32(IdlStruct, typename="std_msgs.msg.dds_.UInt32_"):
    data: uint32 = 0


@dataclass
@final
class Float64(IdlStruct, typename="std_msgs.msg.dds_.Float64_"):
    data: float64 = 0.0


@dataclass
@final
class String(IdlStruct, typename="std_msgs.msg.dds_.String_"):
    data: str = ""


@dataclass
@final
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
@final
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
@final
class JointState(IdlStruct, typename="sensor_msgs.msg.dds_.JointState_"):
    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@dataclass
@final
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
@final
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
@final
class TwistStamped(IdlStruct, typename="geometry_msgs.msg.dds_.TwistStamped_"):
    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
@final
class Point32(IdlStruct, typename="geometry_msgs.msg.dds_.Point32_"):
    x: float32 = 0.0
    y: float32 = 0.0
    z: float32 = 0.0


@dataclass
@final
class Polygon(IdlStruct, typename="geometry_msgs.msg.dds_.Polygon_"):
    points: sequence[Point32] = field(default_factory=list)


@dataclass
@final
class PolygonStamped(IdlStruct, typename="geometry_msgs.msg.dds_.PolygonStamped_"):
    header: Header = field(default_factory=Header)
    polygon: Polygon = field(default_factory=Polygon)


@dataclass
@final
class Clock(IdlStruct, typename="rosgraph_msgs.msg.dds_.Clock_"):
    clock: Time = field(default_factory=Time)


@dataclass
@final
class Log(IdlStruct, typename="rcl_interfaces.msg.dds_.Log_"):
    stamp: Time = field(default_factory=Time)
    level: uint8 = 0
    name: str = ""
    msg: str = ""
    file: str = ""
    function: str = ""
    line: uint32 = 0


@dataclass
@final
class Unheard(IdlStruct, typename="nobody_msgs.msg.dds_.Unheard_"):
    """A type without a definition at any bridge."""

    data: uint8 = 0


TYPES = {
    "std_msgs/Bool": Bool,
    "std_msgs/UInt32": UInt32,
    "std_msgs/Float64": Float64,
    "std_msgs/String": String,
    "sensor_msgs/JointState": JointState,
    "geometry_msgs/Twist": Twist,
    "geometry_msgs/TwistStamped": TwistStamped,
    "geometry_msgs/PolygonStamped": PolygonStamped,
    "rosgraph_msgs/Clock": Clock,
    "rcl_interfaces/Log": Log,
    "nobody_msgs/Unheard": Unheard,
}


def matched(endpoint):
    """Returns how many readers a writer has matched, or writers a reader.

    The Python package queries the number, allocates as many handles and queries again. It raises
    IndexError if an endpoint was matched in between, so the query is repeated.
    """
    while True:
        try:
            if isinstance(endpoint, DataWriter):
                return len(endpoint.get_matched_subscriptions())
            return len(endpoint.get_matched_publications())
        except IndexError:
            continue


def kind_of(type_name):
    try:
        return TYPES[type_name]
    except KeyError:
        raise SystemExit(f"no ROS 2 type {type_name} here; there are {', '.join(TYPES)}") from None


def build(kind, value):
    """Returns a sample of class `kind`. A value that is not an object is the value of the field
    `data`."""
    wanted = value if isinstance(value, dict) else {"data": value}
    sample = kind()
    for one in fields(kind):
        if one.name in wanted:
            given = wanted[one.name]
            old = getattr(sample, one.name)
            setattr(sample, one.name, build(type(old), given) if is_dataclass(old) else given)
    return sample


def plain(value):
    """Returns the JSON form of a sample."""
    if is_dataclass(value):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, (bytes, bytearray)):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def dds_topic(ros_topic):
    return "rt/" + ros_topic.lstrip("/")


def qos(args):
    reliability = (
        Policy.Reliability.Reliable(duration(seconds=10))
        if args.reliability == "reliable"
        else Policy.Reliability.BestEffort
    )
    durability = (
        Policy.Durability.TransientLocal
        if args.durability == "transient_local"
        else Policy.Durability.Volatile
    )
    deadline = [Policy.Deadline(duration(milliseconds=args.deadline))] if args.deadline else []
    return Qos(
        reliability,
        durability,
        *deadline,
        Policy.History.KeepLast(args.depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def add_arguments(parser):
    parser.add_argument("topic", help="as ROS 2 names it: /chatter")
    parser.add_argument("type")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--reliability", choices=["reliable", "best_effort"], default="reliable")
    parser.add_argument("--durability", choices=["volatile", "transient_local"], default="volatile")
    parser.add_argument("--depth", type=int, default=20000)
    parser.add_argument("--deadline", type=int, help="milliseconds")
    parser.add_argument("--limit", type=float, default=120.0)
