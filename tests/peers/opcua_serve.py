"""Runs a small OPC UA server by asyncua: the harness tests its own clients with it."""

import argparse
import asyncio

from asyncua import Server, ua

import lifetime


async def run(args):
    server = Server()
    await server.init()
    server.set_endpoint(args.endpoint)
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await server.register_namespace("urn:ua-bridge:system-tests")
    variable = await server.nodes.objects.add_variable(
        ua.NodeId(10, space), "conveyor_running", True
    )
    await variable.set_writable()
    async with server:
        lifetime.say(ready=variable.nodeid.to_string())
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--limit", type=float, default=60.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
