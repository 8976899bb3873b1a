"""Runs asyncua's PubSub as a subscriber: DataSetReaders that print one JSON line per received
DataSetMessage."""

import argparse
import asyncio

from asyncua import ua
from asyncua.pubsub import (
    DataSetMeta,
    DataSetReader,
    PubSub,
    PubSubConnection,
    ReaderGroup,
    UdpSettings,
)

import lifetime
import opcua_session


class Heard:
    """Receives the values of a DataSetReader."""

    def __init__(self, writer):
        self.writer = writer

    async def on_dataset_received(self, meta, fields):
        lifetime.say(writer=self.writer, fields=[described(field) for field in fields])

    async def on_state_change(self, meta, state):
        pass


def described(field):
    data = field.Value
    variant = data.Value
    return {
        "name": field.Name,
        "type": variant.VariantType.name,
        "dimensions": variant.Dimensions,
        "value": opcua_session.plain(variant.Value),
        "status": data.StatusCode.value if data.StatusCode is not None else None,
        "source": opcua_session.plain(data.SourceTimestamp),
        "server": opcua_session.plain(data.ServerTimestamp),
    }


def reader(args, writer):
    meta = DataSetMeta.Create("fields")
    for index in range(args.fields):
        # The messages contain the types.
        meta.add_scalar(f"field {index}", ua.VariantType.Variant)
    return DataSetReader.new(
        ua.Variant(ua.UInt16(args.publisher)),
        ua.UInt16(args.group),
        ua.UInt16(writer),
        meta,
        enabled=True,
        subscribed=Heard(writer),
    )


async def run(args):
    readers = [reader(args, writer) for writer in args.writer]
    connection = PubSubConnection.udp_uadp(
        "subscriber",
        ua.UInt16(65000),
        UdpSettings(Url=args.url),
        reader_groups=[ReaderGroup.new("readers", readers, enable=True)],
    )
    pubsub = PubSub.new()
    await pubsub.add_connection(connection)
    async with pubsub:
        lifetime.say(ready=args.url)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url", help="opc.udp://239.0.0.5:4840")
    parser.add_argument("--publisher", type=int, required=True, help="a UInt16")
    parser.add_argument("--group", type=int, required=True)
    parser.add_argument("--writer", type=int, action="append", required=True)
    parser.add_argument("--fields", type=int, default=40, help="of a DataSet, at most")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
