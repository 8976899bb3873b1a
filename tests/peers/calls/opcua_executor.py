"""Runs an asyncua server whose object `Line` has a Method for each CASE, named as the case. For a
line on standard input it reports its executions."""

import argparse
import asyncio
import sys
from pathlib import Path
from types import SimpleNamespace

from asyncua import Server, ua, uamethod

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
from calls.cases import CASES
from calls.counting import Counted

URI = "urn:ua-bridge:system-tests:plc"
DONE = {"success": ua.VariantType.Boolean, "message": ua.VariantType.String}
BASIC = {
    "bool_value": ua.VariantType.Boolean,
    "byte_value": ua.VariantType.Byte,
    "char_value": ua.VariantType.Byte,
    "float32_value": ua.VariantType.Float,
    "float64_value": ua.VariantType.Double,
    "int8_value": ua.VariantType.SByte,
    "uint8_value": ua.VariantType.Byte,
    "int16_value": ua.VariantType.Int16,
    "uint16_value": ua.VariantType.UInt16,
    "int32_value": ua.VariantType.Int32,
    "uint32_value": ua.VariantType.UInt32,
    "int64_value": ua.VariantType.Int64,
    "uint64_value": ua.VariantType.UInt64,
    "string_value": ua.VariantType.String,
}
TYPES = {
    "bundled": ({"data": ua.VariantType.Boolean}, DONE),
    "files": (BASIC, BASIC),
    "empty": ({}, DONE),
    "megabyte": ({}, DONE),
}


def arguments(types):
    made = []
    for name, kind in types.items():
        one = ua.Argument()
        one.Name, one.DataType, one.ValueRank = name, ua.NodeId(kind.value, 0), -1
        made.append(one)
    return made


def executes(counted, case):
    kind, (takes, gives) = CASES[case], TYPES[case]

    def method(_parent, *given):
        request = SimpleNamespace(**dict(zip(takes, given)))
        response = SimpleNamespace(**{name: "" if type_ == ua.VariantType.String else 0 for name, type_ in gives.items()})
        counted.execute(case, kind, request, response)
        return tuple(ua.Variant(getattr(response, name), type_) for name, type_ in gives.items())

    return uamethod(method)


async def run(args):
    server = Server()
    await server.init()
    server.set_endpoint(args.endpoint)
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await server.register_namespace(URI)
    place = await server.nodes.objects.add_object(ua.NodeId("Line", space), ua.QualifiedName("Line", space))
    counted = Counted(lifetime.say, 0.0)
    for case in args.case:
        takes, gives = TYPES[case]
        node, name = ua.NodeId(f"Line.{case}", space), ua.QualifiedName(case, space)
        await place.add_method(node, name, executes(counted, case), arguments(takes), arguments(gives))
    async with server:
        lifetime.say(ready=args.endpoint)
        await asyncio.to_thread(counted.listen)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("case", nargs="+")
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
