"""Runs asyncua's PubSub as a publisher: three groups of DataSetWriters, with the values of
tests/asyncua_pubsub.rs."""

import argparse
import asyncio
import datetime
import uuid

from asyncua import ua
from asyncua.pubsub import (
    DataSetMeta,
    DataSetWriter,
    PubSub,
    PubSubConnection,
    PublishedDataSet,
    UdpSettings,
    WriterGroup,
)

import lifetime

TIME = datetime.datetime(2026, 5, 17, 12, 34, 56, 789012, tzinfo=datetime.timezone.utc)
LATER = TIME + datetime.timedelta(microseconds=1)
GUID = uuid.UUID("72962b91-fa75-4ae6-8d28-b404dc7daf63")
T = ua.VariantType

SCALARS = [
    (True, T.Boolean),
    (-8, T.SByte),
    (200, T.Byte),
    (-16000, T.Int16),
    (60000, T.UInt16),
    (-2000000000, T.Int32),
    (4000000000, T.UInt32),
    (-(2**63), T.Int64),
    (2**64 - 1, T.UInt64),
    (-1.5, T.Float),
    (0.1, T.Double),
    ("Grüße", T.String),
    (None, T.String),
    (TIME, T.DateTime),
    (GUID, T.Guid),
    (b"\x00\x01\xff", T.ByteString),
    (ua.NodeId("Motor", 2), T.NodeId),
    (ua.NodeId(70000, 300), T.NodeId),
    (ua.StatusCode(ua.UInt32(0x80340000)), T.StatusCode),
    (ua.QualifiedName("speed", 2), T.QualifiedName),
    (ua.LocalizedText("Drehzahl", "de"), T.LocalizedText),
]
ARRAYS = [
    ([True, False, True], T.Boolean),
    ([1, -2, 3], T.Int32),
    ([0.5, -0.5], T.Double),
    (["a", "", "ü"], T.String),
    ([b"", b"\x01"], T.ByteString),
    ([TIME, LATER], T.DateTime),
    ([GUID], T.Guid),
    ([], T.UInt16),
    ([[1, 2, 3], [4, 5, 6]], T.Int16),
]
RAW = [(7, T.Int32), (1.5, T.Double), (GUID, T.Guid)]


def plain(values):
    return [ua.DataValue(ua.Variant(value, kind)) for value, kind in values]


def with_quality():
    return [
        ua.DataValue(
            ua.Variant(21.5, T.Double),
            ua.StatusCode(ua.UInt32(ua.StatusCodes.UncertainSubNormal)),
            SourceTimestamp=TIME,
            ServerTimestamp=LATER,
        ),
        ua.DataValue(ua.Variant([1, 2], T.UInt32), None, SourceTimestamp=TIME),
        ua.DataValue(ua.Variant("good", T.String)),
    ]


def data_set(name, values):
    meta = DataSetMeta.Create(name)
    for index, value in enumerate(values):
        meta.add_scalar(str(index), value.Value.VariantType)
    published = PublishedDataSet.Create(name, meta)
    fields = {str(index): value for index, value in enumerate(values)}
    published.get_source().datasources[name] = fields
    return published


async def run(args):
    data_sets = [
        data_set("scalars", plain(SCALARS)),
        data_set("arrays", plain(ARRAYS)),
        data_set("values", with_quality()),
        data_set("raw", plain(RAW)),
    ]
    several = [
        DataSetWriter.new_uadp("scalars", "scalars", ua.UInt16(10)),
        DataSetWriter.new_uadp("arrays", "arrays", ua.UInt16(11)),
    ]
    values = [DataSetWriter.new_uadp("values", "values", ua.UInt16(20), datavalue=True)]
    raw = [DataSetWriter.new_uadp("raw", "raw", ua.UInt16(30), raw=True)]
    groups = [
        WriterGroup.new_uadp(
            name,
            ua.UInt16(number),
            group_version=ua.VersionTime(77),
            publishing_interval=ua.Duration(args.interval),
            writer=writers,
        )
        for name, number, writers in [("several", 5, several), ("values", 6, values), ("raw", 7, raw)]
    ]
    connection = PubSubConnection.udp_uadp(
        "publisher", ua.UInt16(args.publisher), UdpSettings(Url=args.url), writer_groups=groups
    )
    pubsub = PubSub.new(datasets=data_sets)
    await pubsub.add_connection(connection)
    async with pubsub:
        lifetime.say(ready=args.url)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url", help="opc.udp://239.0.0.5:4840")
    parser.add_argument("--publisher", type=int, default=2)
    parser.add_argument("--interval", type=float, default=50.0, help="milliseconds")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
