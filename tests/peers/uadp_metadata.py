"""Checks DataSetMetaData by asyncua: one JSON line per announcement in a UADP group, and per
structure in its data.

The headers of NetworkMessages are read here as far as bridges write them. asyncua decodes the
announcements and the values; structures are decoded by the classes that it makes of
StructureDescriptions announced before.
"""

import argparse
import socket
import struct

from asyncua import ua
from asyncua.common.structures104 import make_structure
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import struct_from_binary, variant_from_binary

import lifetime
import opcua_session

DATA = 0xF1
DISCOVERY = 0x91
ANNOUNCEMENT = 2 << 2
DATA_SET_META_DATA = 2


def plain(value):
    if isinstance(value, list):
        return [plain(one) for one in value]
    if hasattr(value, "__dataclass_fields__"):
        names = value.__dataclass_fields__
        return {name: plain(getattr(value, name)) for name in names if name != "data_type"}
    return opcua_session.plain(value)


def announcement(datagram):
    assert datagram[1] == 0x91 and datagram[2] == ANNOUNCEMENT
    publisher, flags, token, nonce = struct.unpack_from("<HBIB", datagram, 3)
    assert (flags, token, nonce) == (0, 0, 0)
    kind, sequence, writer = struct.unpack_from("<BHH", datagram, 11)
    if kind != DATA_SET_META_DATA:
        # Programs also announce their application.
        return
    rest = Buffer(datagram[16:])
    meta = struct_from_binary(ua.DataSetMetaDataType, rest)
    status = struct.unpack("<I", rest.read(4))[0]
    assert len(rest) == 0, "bytes behind the announcement"
    for one in reversed(meta.StructureDataTypes):
        learn(one)
    lifetime.say(
        publisher=publisher,
        writer=writer,
        status=status,
        name=meta.Name,
        topic_name=(meta.Name or "").split(" ")[0],
        description=meta.Description.Text,
        version=meta.ConfigurationVersion.MajorVersion,
        structures=[one.Name.Name for one in meta.StructureDataTypes],
        fields=[
            {
                "name": field.Name,
                "type": field.BuiltInType,
                "data_type": field.DataType.to_string(),
                "rank": field.ValueRank,
                "properties": {pair.Key.Name: property_of(pair.Value) for pair in field.Properties},
            }
            for field in meta.Fields
        ],
    )


def property_of(value):
    value = value.Value if isinstance(value, ua.Variant) else value
    if isinstance(value, ua.EUInformation):
        return [value.NamespaceUri, value.UnitId, value.DisplayName.Text, value.Description.Text]
    if isinstance(value, ua.Range):
        return [value.Low, value.High]
    if isinstance(value, list):
        return [property_of(one) for one in value]
    if isinstance(value, ua.EnumValueType):
        return [value.Value, value.DisplayName.Text]
    if isinstance(value, ua.LocalizedText):
        return value.Text
    return opcua_session.plain(value)


def learn(described):
    """Makes asyncua create a class of a StructureDescription."""
    if described.DataTypeId in ua.extension_objects_by_datatype:
        return
    name = described.Name.Name.replace("/", "_")
    definition = described.StructureDefinition
    made = make_structure(described.DataTypeId, name, definition)
    ua.register_extension_object(
        name, definition.DefaultEncodingId, made[name], described.DataTypeId
    )


def data(datagram):
    """Reads a key frame as bridges write it, and prints its fields that are structures."""
    publisher, _, group, count, writer = struct.unpack_from("<HBHBH", datagram, 2)
    at = 2 + 8 + 10
    flags = datagram[at]
    assert count == 1 and flags & 0x80
    at += 2 + 2 + 8 + 2 + 2 + (4 if flags & 0x20 else 0)
    fields = struct.unpack_from("<H", datagram, at)[0]
    rest = Buffer(datagram[at + 2 :])
    values = [variant_from_binary(rest).Value for _ in range(fields)]
    if any(hasattr(value, "__dataclass_fields__") for value in values):
        lifetime.say(topic=f"ua_{publisher}_{group}_{writer}", values=[plain(value) for value in values])


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("group", nargs="?", default="239.192.0.40")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    heard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    heard.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    heard.bind((args.group, 4840))
    member = struct.pack("4s4s", socket.inet_aton(args.group), socket.inet_aton("127.0.0.1"))
    heard.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    lifetime.say(ready=args.group)
    while True:
        datagram = heard.recv(65535)
        if datagram[0] == DISCOVERY and datagram[2] == ANNOUNCEMENT:
            announcement(datagram)
        elif datagram[0] == DATA and datagram[1] & 0x80 == 0:
            try:
                data(datagram)
            except ua.UaError:
                # The type of the structure is announced later.
                continue


main()
