"""Exports the nodes of one namespace by asyncua's exporter, and imports them into its own server
with the given NodeSets.

It prints one JSON line with the number of nodes, and the nodes that differ after the import.
"""

import argparse
import asyncio
import os
import re
import tempfile

from asyncua import Server, ua
from asyncua.common.xmlexporter import XmlExporter

import lifetime
import opcua_session


async def below(client, index):
    """Returns the nodes of the namespace that hierarchical references lead to."""
    found, waiting = {}, [client.nodes.root]
    seen = {client.nodes.root.nodeid}
    while waiting:
        node = waiting.pop()
        for child in await node.get_children():
            if child.nodeid in seen:
                continue
            seen.add(child.nodeid)
            waiting.append(child)
            if child.nodeid.NamespaceIndex == index:
                found[child.nodeid] = child
    return list(found.values())


async def described(node, namespaces):
    kind = await node.read_node_class()
    browse = await node.read_browse_name()
    told = {"class": kind.name, "name": [namespaces[browse.NamespaceIndex], browse.Name]}
    told["display"] = (await node.read_display_name()).Text
    parent = await node.get_parent()
    told["parent"] = [namespaces[parent.nodeid.NamespaceIndex], str(parent.nodeid.Identifier)]
    if kind == ua.NodeClass.Variable:
        data_type = await node.read_data_type()
        told["type"] = [namespaces[data_type.NamespaceIndex], str(data_type.Identifier)]
        told["rank"] = int(await node.read_value_rank())
        value = await node.read_data_value(raise_on_bad_status=False)
        # The encoding of a NodeId is not part of its value.
        told["value"] = re.sub(r", NodeIdType=<[^>]*>", "", repr(value.Value.Value)) if value.Value else None
    return told


async def run(args):
    async with await opcua_session.client_of(args) as client:
        index = await client.get_namespace_index(args.namespace)
        ours = await below(client, index)
        file = tempfile.NamedTemporaryFile(suffix=".xml", delete=False)
        file.close()
        exporter = XmlExporter(client, export_values=True)
        await exporter.build_etree(ours)
        await exporter.write_xml(file.name)
        other = Server()
        await other.init()
        for nodeset in args.nodeset:
            await other.import_xml(nodeset)
        made = await other.import_xml(file.name)
        os.unlink(file.name)
        here, there = await client.get_namespace_array(), await other.get_namespace_array()
        differ = []
        for node in ours:
            theirs = ua.NodeId(node.nodeid.Identifier, there.index(args.namespace), node.nodeid.NodeIdType)
            one = await described(node, here)
            try:
                two = await described(other.get_node(theirs), there)
            except ua.UaStatusCodeError as fault:
                two = str(fault)
            if one != two:
                differ.append([one, two])
        lifetime.say(exported=len(ours), imported=len(made), differ=differ)


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("namespace", help="the URI of what is exported")
    parser.add_argument("--nodeset", action="append", default=[], help="what the other server has, in the order to load")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
