"""Reads the mandatory attributes of every node of a server.

It prints one JSON line for each attribute that a client cannot use, and one line with the counts.
With --server it prints one line with the server's description of itself, and reads no tree. With
--export asyncua's exporter writes the nodes of all namespaces except the namespace of OPC UA, and
its importer loads them into its own server; a line lists the nodes that differ after the import.
"""

import argparse
import asyncio
import os
import tempfile
from xml.etree import ElementTree

from asyncua import Server, ua
from asyncua.common.xmlexporter import XmlExporter

import lifetime
import opcua_session

A = ua.AttributeIds
EVERY = [A.NodeId, A.NodeClass, A.BrowseName, A.DisplayName]
# Mandatory attributes of each class of nodes: OPC 10000-3, tables 2 to 23.
OF_CLASS = {
    ua.NodeClass.Object: [A.EventNotifier],
    ua.NodeClass.Variable: [A.Value, A.DataType, A.ValueRank, A.AccessLevel, A.UserAccessLevel, A.Historizing],
    ua.NodeClass.Method: [A.Executable, A.UserExecutable],
    ua.NodeClass.ObjectType: [A.IsAbstract],
    ua.NodeClass.VariableType: [A.DataType, A.ValueRank, A.IsAbstract],
    ua.NodeClass.ReferenceType: [A.IsAbstract, A.Symmetric],
    ua.NodeClass.DataType: [A.IsAbstract],
    ua.NodeClass.View: [A.ContainsNoLoops, A.EventNotifier],
}
AT_ONCE = 40


async def browsed(client):
    """Returns every node that hierarchical references lead to, with its class."""
    root = client.nodes.root.nodeid
    found, waiting = {root: ua.NodeClass.Object}, [root]
    while waiting:
        part, waiting = waiting[:AT_ONCE], waiting[AT_ONCE:]
        for one in await references(client, part):
            target = ua.NodeId(one.NodeId.Identifier, one.NodeId.NamespaceIndex, one.NodeId.NodeIdType)
            if target not in found:
                found[target] = one.NodeClass
                waiting.append(target)
    return found


async def references(client, nodes):
    parameters = ua.BrowseParameters()
    parameters.View.Timestamp = ua.get_win_epoch()
    for node in nodes:
        wanted = ua.BrowseDescription()
        wanted.NodeId = node
        wanted.BrowseDirection = ua.BrowseDirection.Forward
        wanted.ReferenceTypeId = ua.NodeId(ua.ObjectIds.HierarchicalReferences)
        wanted.IncludeSubtypes = True
        wanted.ResultMask = ua.BrowseResultMask.All
        parameters.NodesToBrowse.append(wanted)
    told = []
    for result in await client.uaclient.browse(parameters):
        while True:
            result.StatusCode.check()
            told.extend(result.References)
            if not result.ContinuationPoint:
                break
            more = ua.BrowseNextParameters()
            more.ContinuationPoints = [result.ContinuationPoint]
            (result,) = await client.uaclient.browse_next(more)
    return told


async def attributes(client, found):
    nodes = list(found)
    read = bad = 0
    for start in range(0, len(nodes), AT_ONCE):
        part = nodes[start : start + AT_ONCE]
        wanted = [
            ua.ReadValueId(NodeId=node, AttributeId=attribute)
            for node in part
            for attribute in EVERY + OF_CLASS[ua.NodeClass(found[node])]
        ]
        parameters = ua.ReadParameters()
        parameters.NodesToRead = wanted
        answers = await client.uaclient.read(parameters)
        for asked, answer in zip(wanted, answers, strict=True):
            read += 1
            if answer.StatusCode.is_good():
                continue
            status = answer.StatusCode.name
            bad += 1
            lifetime.say(node=asked.NodeId.to_string(), attribute=A(asked.AttributeId).name, status=status)
    lifetime.say(nodes=len(nodes), read=read, bad=bad)


async def described(node):
    kind = await node.read_node_class()
    told = {"class": kind.name, "name": (await node.read_browse_name()).Name}
    told["display"] = (await node.read_display_name()).Text
    if kind == ua.NodeClass.Variable:
        told["type"] = (await node.read_data_type()).Identifier
        told["rank"] = int(await node.read_value_rank())
    return told


def without_instances(file):
    """Removes the references of types to their instances: asyncua's importer takes them for the
    type of the type."""
    document = ElementTree.parse(file)
    for references in document.iterfind(".//{*}References"):
        for one in references.findall("{*}Reference"):
            if one.get("ReferenceType") == "HasTypeDefinition" and one.get("IsForward", "true").lower() == "false":
                references.remove(one)
    document.write(file, encoding="utf-8", xml_declaration=True)


async def round_trip(client, found):
    ours = [client.get_node(node) for node in found if node.NamespaceIndex > 0]
    file = tempfile.NamedTemporaryFile(suffix=".xml", delete=False)
    file.close()
    exporter = XmlExporter(client, export_values=False)
    await exporter.build_etree(ours)
    await exporter.write_xml(file.name)
    without_instances(file.name)
    other = Server()
    await other.init()
    for uri in (await client.get_namespace_array())[1:]:
        await other.register_namespace(uri)
    made = await other.import_xml(file.name)
    os.unlink(file.name)
    array = await client.get_namespace_array()
    differ = []
    for node in ours:
        index = await other.get_namespace_index(array[node.nodeid.NamespaceIndex])
        there = other.get_node(ua.NodeId(node.nodeid.Identifier, index, node.nodeid.NodeIdType))
        one = await described(node)
        try:
            same = await described(there) == one
        except ua.UaStatusCodeError as fault:
            same, one = False, {"fault": str(fault), **one}
        if not same:
            differ.append(one)
    lifetime.say(exported=len(ours), imported=len(made), differ=differ)


def plain(structure):
    return {name: opcua_session.plain(getattr(structure, name)) for name in structure.__dataclass_fields__}


async def of_server(client):
    ids = ua.ObjectIds
    value = lambda identifier: client.get_node(ua.NodeId(identifier)).read_value()
    status = await value(ids.Server_ServerStatus)
    summary = await value(ids.Server_ServerDiagnostics_ServerDiagnosticsSummary)
    namespaces = []
    for one in await client.get_node(ua.NodeId(ids.Server_Namespaces)).get_children():
        namespaces.append(await (await one.get_child("0:NamespaceUri")).read_value())
    lifetime.say(
        build=plain(status.BuildInfo),
        state=int(status.State),
        sessions=await value(ids.Server_ServerCapabilities_MaxSessions),
        connected=summary.CurrentSessionCount,
        namespaces=namespaces,
    )


class First:
    """Stores the first value of a monitored item."""

    def __init__(self):
        self.value = asyncio.get_running_loop().create_future()

    def datachange_notification(self, node, value, data):
        if not self.value.done():
            self.value.set_result(value)


async def of_roles(client, nodes):
    """Prints the profiles and roles of the server, and the permissions of nodes."""
    ids = ua.ObjectIds
    profiles = client.get_node(ua.NodeId(ids.Server_ServerCapabilities_ServerProfileArray))
    first = First()
    subscription = await client.create_subscription(50, first)
    await subscription.subscribe_data_change(profiles)
    rate = await client.get_node(
        ua.NodeId(ids.Server_ServerCapabilities_MinSupportedSampleRate)
    ).read_data_value()
    roles = {}
    for role in await client.get_node(ua.NodeId(ids.Server_ServerCapabilities_RoleSet)).get_children():
        if await role.read_node_class() != ua.NodeClass.Object:
            continue
        parts = await role.get_children()
        names = [(await part.read_browse_name()).Name for part in parts]
        (identities,) = [part for part, name in zip(parts, names) if name == "Identities"]
        rules = [[rule.CriteriaType.name, rule.Criteria] for rule in await identities.read_value()]
        roles[(await role.read_browse_name()).Name] = {"parts": names, "identities": rules}
    permissions = {}
    for node in nodes:
        told = permissions[node] = {}
        for name in ("RolePermissions", "UserRolePermissions", "AccessRestrictions", "AccessLevelEx", "ArrayDimensions"):
            read = await client.get_node(node).read_attribute(A[name], raise_on_bad_status=False)
            value = read.Value.Value if read.Value is not None else None
            if name.endswith("RolePermissions") and value is not None:
                value = [[one.RoleId.Identifier, int(one.Permissions)] for one in value]
            told[name] = value if read.StatusCode.is_good() else read.StatusCode.name
    array = await profiles.read_data_value()
    lifetime.say(
        profiles=array.Value.Value,
        monitored=await asyncio.wait_for(first.value, 10),
        stamped=array.SourceTimestamp is not None,
        rate=rate.Value.Value,
        roles=roles,
        permissions=permissions,
    )
    await subscription.delete()


async def run(args):
    async with await opcua_session.client_of(args) as client:
        if args.roles:
            await of_roles(client, args.roles)
            return
        if args.server:
            await of_server(client)
            return
        found = await browsed(client)
        await attributes(client, found)
        if args.export:
            await round_trip(client, found)


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("--export", action="store_true")
    parser.add_argument("--server", action="store_true")
    parser.add_argument("--roles", metavar="NODE", nargs="+", default=[])
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
