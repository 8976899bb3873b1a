"""Runs asyncua's PubSub as a listener on a UADP group: one JSON line per DataSetMessage."""

import argparse
import asyncio

from asyncua import ua
from asyncua.pubsub.uadp import UadpDataSetKeepAlive, UadpDataSetVariant
from asyncua.pubsub.udp import OpcUdp, UdpSettings

import lifetime
import opcua_session


class Heard:
    async def got_uadp(self, message):
        group = message.GroupHeader
        for writer, one in zip(message.DataSetPayloadHeader, message.Payload):
            if isinstance(one, UadpDataSetVariant):
                kind = "key_frame"
                fields = [
                    {"type": field.VariantType.name, "value": opcua_session.plain(field.Value)}
                    for field in one.Data
                ]
            elif isinstance(one, UadpDataSetKeepAlive):
                kind, fields = "keep_alive", []
            else:
                kind, fields = type(one).__name__, []
            lifetime.say(
                kind=kind,
                publisher=message.Header.PublisherId,
                publisher_type=type(message.Header.PublisherId).__name__,
                group=group.WriterGroupId if group is not None else None,
                writer=writer,
                sequence=one.Header.SequenceNo,
                timestamp=opcua_session.plain(one.Header.Timestamp),
                fields=fields,
            )


async def run(args):
    settings = UdpSettings(Url=args.url)
    sock, _, _ = settings.create_socket()
    loop = asyncio.get_running_loop()
    await loop.create_datagram_endpoint(
        lambda: OpcUdp(settings, Heard(), ua.Variant(ua.UInt16(65000))), sock=sock
    )
    lifetime.say(ready=args.url)
    await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url", help="opc.udp://239.0.0.5:4840")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
