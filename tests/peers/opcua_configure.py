"""Configures a component and prints a JSON line: the answer or the fault, the shown fields, and the
force of the last run of its first skill.
"""

import argparse
import asyncio
import json

from asyncua import ua

import lifetime
import opcua_session


async def named(node):
    return {(await child.read_browse_name()).Name: child for child in await node.get_children()}


async def shown(node):
    value = await node.read_data_value(raise_on_bad_status=False)
    return opcua_session.plain(value.Value.Value) if value.StatusCode.is_good() else None


async def run(args):
    async with await opcua_session.client_of(args) as client:
        component = await named(client.get_node(ua.NodeId(1, 1)))
        children = await named(component["Configuration"])
        method = children.pop("Configure")
        # For the supervisor of a plant, which sets and restores single fields.
        children.pop("SetFields")
        fields = json.loads(args.fields)
        pairs = [ua.KeyValuePair(Key=ua.QualifiedName(name), Value=ua.Variant(value)) for name, value in fields.items()]
        told = {}
        if pairs:
            try:
                argument = ua.Variant(pairs, ua.VariantType.ExtensionObject)
                told["answer"] = await component["Configuration"].call_method(method.nodeid, argument)
            except ua.UaStatusCodeError as error:
                told["fault"] = ua.StatusCode(error.code).name
        parameters = await named((await named(client.get_node(ua.NodeId(100, 1))))["ParameterSet"])
        told["shown"] = {name: await shown(node) for name, node in children.items()}
        lifetime.say(**told, force=await shown(parameters["Force"]))


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("--fields", default="{}", help="the fields as a JSON object")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
