"""Runs an asyncua server for benchmarks.

It has COUNT variables with the NodeIds from ns=2;i=10, a variable ns=2;i=5 that clients write, and
a Method ns=2;i=6 of the object ns=2;i=7 that returns at once. After a JSON line `{"change": true}`
on standard input it sets all variables every 103 ms to the time of the change, in microseconds of
the machine's monotonic clock; `false` ends the changes.
"""

import argparse
import asyncio
import json
import sys
import time

from asyncua import Server, ua, uamethod

import lifetime
import opcua_session

PERIOD = 0.103


@uamethod
async def answer(_parent):
    return True, "Answer", 1


async def change(server, nodes):
    due = time.monotonic()
    while True:
        value = ua.Variant(time.monotonic_ns() / 1000, ua.VariantType.Double)
        for node in nodes:
            await server.write_attribute_value(node, ua.DataValue(value))
        due += PERIOD
        await asyncio.sleep(max(0.0, due - time.monotonic()))


async def run(args):
    server = Server()
    await server.init()
    server.set_endpoint(args.endpoint)
    if args.pairs:
        await opcua_session.secure(server, args.pairs)
    else:
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await server.register_namespace("urn:ua-bridge:bench")
    line = await server.nodes.objects.add_object(ua.NodeId(7, space), ua.QualifiedName("Line", space))
    nodes = []
    for number in range(args.count):
        node = ua.NodeId(10 + number, space)
        await line.add_variable(node, ua.QualifiedName(f"v{number}", space), 0.0)
        nodes.append(node)
    written = await line.add_variable(ua.NodeId(5, space), ua.QualifiedName("written", space), 0.0)
    await written.set_writable()
    gives = [ua.VariantType.Boolean, ua.VariantType.String, ua.VariantType.UInt32]
    await line.add_method(ua.NodeId(6, space), ua.QualifiedName("Answer", space), answer, [], gives)
    reader = asyncio.StreamReader()
    pipe = asyncio.StreamReaderProtocol(reader)
    await asyncio.get_running_loop().connect_read_pipe(lambda: pipe, sys.stdin)
    changing = None
    async with server:
        lifetime.say(ready=args.endpoint)
        while said := await reader.readline():
            if json.loads(said)["change"]:
                changing = asyncio.create_task(change(server, nodes))
            elif changing:
                changing.cancel()
            lifetime.say(changed=True)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--pairs", help="the folder of `opcua_access.py pairs`; without it nothing is secured")
    parser.add_argument("--limit", type=float, default=3600.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
