"""Uses the knowledge of ua-mes as an asyncua client: queries and changes it by OPC UA methods.

    opcua_knowledge.py URL --manifest FILE [--user NAME --password PASSWORD ...]

Prints a JSON line for each call: its name, and its outputs or the status of its refusal.
"""

import argparse
import asyncio
import pathlib

from asyncua import ua

import lifetime
import opcua_session

ALL = "SELECT ?o { <urn:a> <urn:p> ?o } ORDER BY ?o"


def text(value):
    return ua.Variant(value, ua.VariantType.String)


def contents(value):
    return ua.Variant(value, ua.VariantType.ByteString)


def query(sparql, rows, form="text/csv"):
    return "Query", text(sparql), text(form), ua.Variant(rows, ua.VariantType.UInt32)


async def run(args):
    manifest = pathlib.Path(args.manifest).read_bytes()
    calls = [
        query(ALL, 0),
        ("Update", text("INSERT DATA { <urn:a> <urn:p> 1 , 2 , 3 }")),
        query(ALL, 2),
        query("SELECT *\n{ ?s ?p }", 0),
        query("ASK { <urn:a> <urn:p> 3 }", 0, ""),
        ("Load", text("file"), text("b.ttl"), contents(b"<urn:b> <urn:p> 1 .\n<urn:b> 2")),
        ("Load", text("file"), text("b.ttl"), contents(b"<urn:b> <urn:p> 1 .")),
        ("ImportMtp", text("stage"), contents(manifest)),
    ]
    async with await opcua_session.client_of(args) as client:
        component = client.get_node(ua.NodeId(1, 1))
        knowledge = await component.get_child("1:Knowledge")
        for name, *arguments in calls:
            try:
                outputs = await knowledge.call_method(f"1:{name}", *arguments)
                lifetime.say(call=name, outputs=outputs)
            except ua.UaStatusCodeError as error:
                lifetime.say(call=name, status=ua.StatusCode(error.code).name)


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("--manifest", required=True, help="the manifest of a module")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
