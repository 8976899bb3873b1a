"""Writes one value into a node of an OPC UA server and says with which status the server answered."""

import argparse
import asyncio
import json

from asyncua import ua
from asyncua.ua.uaerrors import UaStatusCodeError

import lifetime
import opcua_session


async def run(args):
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
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
