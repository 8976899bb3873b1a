"""Writes one value into a node of an OPC UA server and prints the status of the response. With
--many it writes 1, 2, 3 ... until the connection is lost, and prints the confirmed values."""

import argparse
import asyncio
import json
import os

from asyncua import ua
from asyncua.ua.uaerrors import UaStatusCodeError

import lifetime
import opcua_session


async def many(args):
    client = await opcua_session.client_of(args)
    await client.connect()
    lifetime.say(ready=True)
    node, count = client.get_node(args.node), 0
    try:
        while True:
            count += 1
            await node.write_value(ua.DataValue(ua.Variant(float(count), ua.VariantType[args.type])))
            lifetime.say(confirmed=count)
    except Exception as gone:  # any failure is the loss of the connection
        lifetime.say(gone=type(gone).__name__, at=count)


async def run(args):
    if args.many:
        await many(args)
        # An orderly end of the client would wait for the server.
        os._exit(0)
    async with await opcua_session.client_of(args) as client:
        value = bytes(args.zeros) if args.zeros else json.loads(args.value)
        variant = ua.Variant(value, ua.VariantType[args.type])
        try:
            await client.get_node(args.node).write_value(ua.DataValue(variant))
            status = "Good"
        except UaStatusCodeError as refused:
            status = ua.StatusCode(refused.code).name
        lifetime.say(node=args.node, status=status)


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("node")
    parser.add_argument("type", help="the builtin type's name: Boolean")
    parser.add_argument("value", help="JSON", nargs="?")
    parser.add_argument("--zeros", type=int, help="so many bytes, instead of a value")
    parser.add_argument("--many", action="store_true")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
