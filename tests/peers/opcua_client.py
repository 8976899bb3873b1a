#!/usr/bin/env python3
"""An OPC UA client (asyncua) driven by JSON lines: one request on stdin, one answer on stdout.

    opcua_client.py opc.tcp://127.0.0.1:4840 [--security Basic256Sha256 --mode SignAndEncrypt --certificates DIR]

Requests, each with the keys of its answer:
    {"do": "read", "node": "ns=2;i=10"}                       value type status source server picoseconds
    {"do": "write", "node": .., "type": "Double", "value": ..} status
    {"do": "wait", "node": .., "status": "Good", "value": .., "within": 5}   as read; {"timeout": ..} when it never was so
    {"do": "attribute", "node": .., "name": "AccessLevel"}     value
    {"do": "browse", "node": "i=85"}                           children: [[node, browse name], ..]
    {"do": "namespaces"}                                       value: [uri, ..]
    {"do": "subscribe", "node": .., "publishing_ms": 50}       subscribed; then lines {"event": "data", ..}
    {"do": "latency", "write": .., "type": .., "count": 20, "publishing_ms": 50}   ms: [..]
The first line is {"connected": true} or {"refused": "BadSecurityChecksFailed"}.
"""

import argparse
import asyncio
import json
import pathlib
import sys
import time

from asyncua import Client, ua
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography.x509.oid import ExtendedKeyUsageOID

APPLICATION = "urn:ua-bridge:test-client"


def say(**answer):
    print(json.dumps(answer, default=str), flush=True)


def plain(value):
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, ua.Variant):
        return plain(value.Value)
    if isinstance(value, bytes):
        return value.hex()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def described(data):
    # The name of the code proper: the lower half carries info bits, such as that of a queue that overflowed.
    status = ua.StatusCode(data.StatusCode.value & 0xFFFF0000) if data.StatusCode else ua.StatusCode(0)
    return {
        "value": plain(data.Value) if data.Value is not None else None,
        "type": data.Value.VariantType.name if data.Value is not None else None,
        "status": status.name,
        "source": data.SourceTimestamp.isoformat() if data.SourceTimestamp else None,
        "picoseconds": data.SourcePicoseconds,
        "server": data.ServerTimestamp.isoformat() if data.ServerTimestamp else None,
    }


class Printer:
    def __init__(self):
        self.queues = {}

    def datachange_notification(self, node, _value, data):
        answer = described(data.monitored_item.Value)
        queue = self.queues.get(node.nodeid)
        if queue is not None:
            queue.put_nowait((time.monotonic(), answer))
        else:
            say(event="data", node=node.nodeid.to_string(), **answer)

    def status_change_notification(self, status):
        say(event="status", status=str(status))


async def read(client, node):
    params = ua.ReadParameters()
    params.TimestampsToReturn = ua.TimestampsToReturn.Both
    wanted = ua.ReadValueId()
    wanted.NodeId = ua.NodeId.from_string(node)
    wanted.AttributeId = ua.AttributeIds.Value
    params.NodesToRead = [wanted]
    return described((await client.uaclient.read(params))[0])


async def write(client, request):
    data = ua.DataValue(ua.Variant(request["value"], ua.VariantType[request["type"]]))
    params = ua.WriteParameters()
    item = ua.WriteValue()
    item.NodeId = ua.NodeId.from_string(request["node"])
    item.AttributeId = ua.AttributeIds.Value
    item.Value = data
    params.NodesToWrite = [item]
    return {"status": (await client.uaclient.write(params))[0].name}


async def wait(client, request):
    end = time.monotonic() + request.get("within", 5)
    while True:
        seen = await read(client, request["node"])
        if all(seen[key] == request[key] for key in ("status", "value") if key in request):
            return seen
        if time.monotonic() > end:
            return {"timeout": request.get("within", 5), **seen}
        await asyncio.sleep(0.01)


async def latency(client, printer, request):
    """Milliseconds from the Write request to the notification of its value."""
    node = client.get_node(request["write"])
    queue = printer.queues[node.nodeid] = asyncio.Queue()
    subscription = await client.create_subscription(request.get("publishing_ms", 50), printer)
    await subscription.subscribe_data_change(node)
    await asyncio.wait_for(queue.get(), 5)
    taken = []
    for number in range(request.get("count", 20)):
        value = bool(number % 2 == 0) if request["type"] == "Boolean" else number + 1
        start = time.monotonic()
        result = await write(client, {"node": request["write"], "type": request["type"], "value": value})
        if result["status"] != "Good":
            return result
        while True:
            at, seen = await asyncio.wait_for(queue.get(), 5)
            if seen["value"] == value:
                break
        taken.append(round((at - start) * 1000, 2))
    await subscription.delete()
    del printer.queues[node.nodeid]
    return {"ms": taken}


async def answer(client, printer, subscriptions, request):
    do = request["do"]
    if do == "read":
        return await read(client, request["node"])
    if do == "write":
        return await write(client, request)
    if do == "wait":
        return await wait(client, request)
    if do == "latency":
        return await latency(client, printer, request)
    if do == "namespaces":
        return {"value": await client.get_namespace_array()}
    node = client.get_node(request["node"])
    if do == "attribute":
        return {"value": plain((await node.read_attribute(ua.AttributeIds[request["name"]])).Value)}
    if do == "browse":
        children = await node.get_children()
        names = [(await child.read_browse_name()).Name for child in children]
        return {"children": [[child.nodeid.to_string(), name] for child, name in zip(children, names)]}
    if do == "subscribe":
        subscription = await client.create_subscription(request.get("publishing_ms", 50), printer)
        await subscription.subscribe_data_change(node)
        subscriptions.append(subscription)
        return {"subscribed": request["node"]}
    return {"error": f"unknown request {do}"}


async def secure(client, arguments):
    directory = pathlib.Path(arguments.certificates)
    directory.mkdir(parents=True, exist_ok=True)
    certificate, key = directory / "client.der", directory / "client.pem"
    await setup_self_signed_certificate(
        key, certificate, APPLICATION, "localhost", [ExtendedKeyUsageOID.CLIENT_AUTH], {"commonName": "test client"}
    )
    client.application_uri = APPLICATION
    await client.set_security(
        SecurityPolicyBasic256Sha256, str(certificate), str(key), mode=ua.MessageSecurityMode[arguments.mode]
    )


async def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("--security", choices=["None", "Basic256Sha256"], default="None")
    parser.add_argument("--mode", choices=["Sign", "SignAndEncrypt"], default="SignAndEncrypt")
    parser.add_argument("--certificates", default="client-certificates")
    arguments = parser.parse_args()
    client = Client(arguments.url, timeout=10)
    try:
        if arguments.security != "None":
            await secure(client, arguments)
        await client.connect()
    except (ua.UaError, OSError, asyncio.TimeoutError, ConnectionError) as error:
        say(refused=type(error).__name__, why=str(error))
        return
    say(connected=True)
    printer, subscriptions = Printer(), []
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    async with client_closed(client):
        while line := await lines.readline():
            try:
                say(**await answer(client, printer, subscriptions, json.loads(line)))
            except (ua.UaError, asyncio.TimeoutError, KeyError, ConnectionError) as error:
                say(error=type(error).__name__, why=str(error))


class client_closed:
    def __init__(self, client):
        self.client = client

    async def __aenter__(self):
        return self.client

    async def __aexit__(self, *_):
        try:
            await asyncio.wait_for(self.client.disconnect(), 3)
        except (ua.UaError, asyncio.TimeoutError, ConnectionError):
            pass


asyncio.run(main())
