"""ROS 2 messages as Cyclone DDS types: the names and layouts that rmw_cyclonedds puts on the wire."""

from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, float64, int32, sequence, uint8, uint32


@dataclass
class Bool(IdlStruct, typename="std_msgs::msg::dds_::Bool_"):
    data: bool


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


@dataclass
class UInt32(IdlStruct, typename="std_msgs::msg::dds_::UInt32_"):
    data: uint32


@dataclass
class Float64(IdlStruct, typename="std_msgs::msg::dds_::Float64_"):
    data: float64


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Unheard(IdlStruct, typename="nobody_msgs::msg::dds_::Unheard_"):
    """A type for which no definition is anywhere."""

    data: uint8


TYPES = {
    "std_msgs/Bool": Bool,
    "std_msgs/String": String,
    "std_msgs/UInt32": UInt32,
    "std_msgs/Float64": Float64,
    "sensor_msgs/JointState": JointState,
    "nobody_msgs/Unheard": Unheard,
}


def build(type_name, value):
    """The message for a JSON value: nested objects for messages, `data` alone for the one-field types."""
    kind = TYPES[type_name]
    if not isinstance(value, dict):
        return kind(data=value)
    if kind is JointState:
        header = value["header"]
        stamp = header["stamp"]
        return JointState(
            header=Header(stamp=Time(**stamp), frame_id=header["frame_id"]),
            name=value["name"],
            position=value["position"],
            velocity=value["velocity"],
            effort=value["effort"],
        )
    return kind(**value)
