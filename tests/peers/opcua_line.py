"""Runs the OPC UA server of an assembly line by asyncua: nodes with numbers, texts and GUIDs, in
its own namespace.

With --export it also writes its nodes as a NodeSet.
"""

import argparse
import asyncio
import uuid

from asyncua import Server, ua

import lifetime

URI = "urn:ua-bridge:system-tests:line"


async def build(server):
    space = await server.register_namespace(URI)
    line = await server.nodes.objects.add_object(ua.NodeId(100, space), f"{space}:Line")
    conveyor = await line.add_object(ua.NodeId(101, space), f"{space}:Conveyor")
    running = await conveyor.add_variable(ua.NodeId(10, space), f"{space}:Running", True)
    await running.add_property(ua.NodeId(11, space), f"{space}:Unit", "none")
    await conveyor.add_variable(ua.NodeId("Line.Conveyor.Switch", space), f"{space}:Switch", False)
    await conveyor.add_variable(
        ua.NodeId("Speeds [m/s] °", space), f"{space}:Speeds", [0.5, 1.5], ua.VariantType.Double
    )
    await line.add_variable(
        ua.NodeId(uuid.UUID("09087e75-8e5e-499b-954f-f2a9603db28a"), space), f"{space}:Mode", 3, ua.VariantType.Int32
    )
    await line.add_variable(ua.NodeId(70000, space), f"{space}:Running", True)
    await line.add_method(ua.NodeId(30, space), f"{space}:Start", lambda *_: [], [ua.VariantType.Boolean], [])
    return [100, 101, 10, 11, "Line.Conveyor.Switch", "Speeds [m/s] °", 70000], space


async def run(args):
    server = Server()
    await server.init()
    server.set_endpoint(args.endpoint)
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    for uri in args.before:
        await server.register_namespace(uri)
    identifiers, space = await build(server)
    if args.export:
        nodes = [server.get_node(ua.NodeId(one, space)) for one in identifiers]
        nodes.append(server.get_node(ua.NodeId(uuid.UUID("09087e75-8e5e-499b-954f-f2a9603db28a"), space)))
        await server.export_xml(nodes, args.export)
    async with server:
        lifetime.say(ready=URI)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--export", metavar="FILE")
    parser.add_argument("--before", action="append", default=[], help="namespaces that come before")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
