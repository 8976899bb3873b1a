"""Runs an asyncua server with Methods that prints each call as a JSON line. `--before N` puts N
namespaces before its own namespace."""

import argparse
import asyncio

from asyncua import Server, ua, uamethod

import lifetime

URI = "urn:ua-bridge:system-tests:plc"


class Line:
    """The object with the Methods."""

    def __init__(self):
        self.calls = 0

    def begun(self, name, *arguments):
        self.calls += 1
        lifetime.say(begun=name, arguments=list(arguments), calls=self.calls)

    @uamethod
    async def move(self, _parent, position, speeds):
        self.begun("Move", position, speeds)
        if position < 0:
            return ua.StatusCode(ua.StatusCodes.BadOutOfRange)
        return position * 2, f"{len(speeds)} axes"

    @uamethod
    async def wait(self, _parent, seconds):
        self.begun("Wait", seconds)
        await asyncio.sleep(seconds)
        lifetime.say(ended="Wait")
        return seconds

    @uamethod
    async def reset(self, _parent):
        self.begun("Reset")

    @uamethod
    async def strange(self, _parent, node):
        self.begun("Strange", str(node))


def argument(name, kind, rank=-1):
    described = ua.Argument()
    described.Name, described.DataType, described.ValueRank = name, ua.NodeId(kind, 0), rank
    described.ArrayDimensions = [] if rank < 0 else [0]
    return described


async def run(args):
    server = Server()
    await server.init()
    server.set_endpoint(args.endpoint)
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    for number in range(args.before):
        await server.register_namespace(f"urn:other:{number}")
    space = await server.register_namespace(URI)
    place = await server.nodes.objects.add_object(ua.NodeId("Line", space), ua.QualifiedName("Line", space))
    line = Line()

    async def method(name, function, takes, gives):
        node, name = ua.NodeId(f"Line.{name}", space), ua.QualifiedName(name, space)
        await place.add_method(node, name, function, takes, gives)

    # Duration and LocaleId are subtypes of Double and String.
    takes = [argument("TargetPosition", 11), argument("speeds", 10, 1)]
    await method("Move", line.move, takes, [argument("Reached", 290), argument("Remark", 295)])
    await method("Wait", line.wait, [argument("seconds", 11)], [argument("waited", 11)])
    await method("Reset", line.reset, [], [])
    await method("Strange", line.strange, [argument("node", 17)], [])
    async with server:
        lifetime.say(ready=args.endpoint)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--before", type=int, default=0)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
