"""Runs an asyncua client at the PubSub configuration of a server, with an order in each line of
standard input.

- `walk` reads every attribute of all nodes below the object PublishSubscribe.
- `read PATH` reads the value of a node below it.
- `call PATH` calls a Method.
- `file PATH` reads and decodes a file.
- `open PATH MODE` opens a file and leaves it open.
- `leave` closes the session.

Each response is a JSON line with the number of the order.
"""

import argparse
import asyncio
import dataclasses
import sys

from asyncua import ua
from asyncua.client.ua_file import UaFile
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import extensionobject_from_binary

import lifetime
import opcua_session

ROOT = "i=14443"
# Mandatory attributes of each class of nodes (OPC 10000-3, 5); clients rarely read the optional
# attributes.
ALL = ["NodeId", "NodeClass", "BrowseName", "DisplayName"]
MORE = {
    ua.NodeClass.Object: ["EventNotifier"],
    ua.NodeClass.Variable: ["Value", "DataType", "ValueRank", "AccessLevel", "UserAccessLevel", "Historizing"],
    ua.NodeClass.Method: ["Executable", "UserExecutable"],
}


def opened(value):
    if isinstance(value, (list, tuple)):
        return [opened(item) for item in value]
    if isinstance(value, ua.NodeId):
        return value.to_string()
    if isinstance(value, ua.Guid):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, (ua.NodeId, ua.Guid)):
        return {field.name: opened(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return opcua_session.plain(value)


async def walk(client):
    seen, bad, kinds, todo = set(), [], {}, [(client.get_node(ROOT), "")]
    while todo:
        node, path = todo.pop()
        if node.nodeid in seen:
            continue
        seen.add(node.nodeid)
        kind = await node.read_node_class()
        kinds[kind.name] = kinds.get(kind.name, 0) + 1
        for name in ALL + MORE.get(kind, []):
            answer = await node.read_attribute(ua.AttributeIds[name], raise_on_bad_status=False)
            if not answer.StatusCode.is_good():
                bad.append([path, name, answer.StatusCode.name])
        if kind in (ua.NodeClass.Object, ua.NodeClass.Variable) and await node.read_type_definition() is None:
            bad.append([path, "HasTypeDefinition", "missing"])
        for child in await node.get_children():
            todo.append((child, f"{path}/{(await child.read_browse_name()).Name}"))
    return {"walked": kinds, "bad": bad}


async def found(client, path):
    above = node = client.get_node(ROOT)
    for name in path.split("/"):
        children = await node.get_children()
        names = [(await child.read_browse_name()).Name for child in children]
        if name not in names:
            return None
        above, node = node, children[names.index(name)]
    return above, node


async def in_file(node):
    """Returns the properties of a file, and its content."""
    async with UaFile(node, "r") as file:
        content, size = await file.read(), await file.get_size()
    decoded = extensionobject_from_binary(Buffer(content))
    mime = await (await node.get_child("MimeType")).read_value()
    said = {"type": type(decoded).__name__, "namespaces": decoded.Namespaces, "mime": mime, "complete": size == len(content)}
    return said | {"body": type(decoded.Body.Value).__name__, "content": opened(decoded.Body.Value)}


async def carried_out(client, order, path):
    if order == "walk":
        return await walk(client)
    if order == "open":
        path, _, mode = path.rpartition(" ")
    nodes = await found(client, path)
    if nodes is None:
        return {"missing": True}
    above, node = nodes
    if order == "file":
        return await in_file(node)
    if order == "open":
        try:
            await node.call_method("Open", ua.Variant(int(mode), ua.VariantType.Byte))
            return {"opened": "Good"}
        except ua.UaStatusCodeError as error:
            return {"opened": ua.StatusCode(error.code).name}
    if order == "read":
        answer = await node.read_attribute(ua.AttributeIds.Value, raise_on_bad_status=False)
        return {"value": opened(answer.Value.Value), "status": answer.StatusCode.name}
    request = ua.CallMethodRequest()
    request.ObjectId, request.MethodId = above.nodeid, node.nodeid
    (result,) = await client.uaclient.call([request])
    return {"called": result.StatusCode.name}


async def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    async with await opcua_session.client_of(args) as client:
        lifetime.say(ready=args.endpoint)
        loop = asyncio.get_running_loop()
        number = 0
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            number += 1
            order, _, path = line.rstrip("\n").partition(" ")
            if order == "leave":
                break
            lifetime.say(order=number, path=path, **await carried_out(client, order, path))


asyncio.run(main())
