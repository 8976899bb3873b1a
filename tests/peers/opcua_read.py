"""Reads nodes of an OPC UA server: one JSON line per node, with status and timestamps; or the nodes
below."""

import argparse
import asyncio

from asyncua import ua

import lifetime
import opcua_session


async def run(args):
    async with await opcua_session.client_of(args) as client:
        for text in args.node:
            node = client.get_node(text)
            if args.children:
                found = await node.get_children()
                names = [] if args.nameless else [(await child.read_browse_name()).Name for child in found]
                lifetime.say(node=text, children=[child.nodeid.to_string() for child in found], names=names)
                continue
            wanted = ua.ReadValueId(node.nodeid, ua.AttributeIds.Value, args.range)
            parameters = ua.ReadParameters()
            parameters.TimestampsToReturn = ua.TimestampsToReturn.Both
            parameters.NodesToRead = [wanted]
            answer = await client.uaclient.read(parameters)
            lifetime.say(**opcua_session.described(text, answer[0]))


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("--children", action="store_true", help="the nodes below, instead of the values")
    parser.add_argument("--nameless", action="store_true", help="of the nodes below only what they are, for there are many")
    parser.add_argument("--range", help="IndexRange: 0:9")
    parser.add_argument("node", nargs="+", help="as OPC UA writes it: ns=2;i=10")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
