"""Reads nodes of an OPC UA server by its DataTypeDefinitions: one JSON line per node, with the type
and the content."""

import argparse
import asyncio
import dataclasses

from asyncua import ua

import lifetime
import opcua_session


def opened(value):
    if isinstance(value, list):
        return [opened(item) for item in value]
    if dataclasses.is_dataclass(value):
        return {field.name: opened(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return opcua_session.plain(value)


async def encodings(client, data_type):
    """Returns the BrowseNames of a DataType's encodings, with their NodeIds."""
    found = await client.get_node(data_type).get_references(ua.ObjectIds.HasEncoding)
    return {one.BrowseName.Name: one.NodeId.to_string() for one in found}


async def run(args):
    async with await opcua_session.client_of(args) as client:
        await client.load_data_type_definitions()
        for text in args.node:
            node = client.get_node(text)
            # The writer of the value may be silent by now.
            value = (await node.read_data_value(raise_on_bad_status=False)).Value.Value
            first = value[0] if isinstance(value, list) else value
            data_type = await node.read_data_type()
            lifetime.say(
                node=text,
                type=type(first).__name__,
                data_type=data_type.to_string(),
                encodings=await encodings(client, data_type),
                value=opened(value),
            )


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("node", nargs="+")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
