"""Reads all nodes of a simulated module with asyncua, and runs a service by the handshake.

    pea_judge.py ENDPOINT MANIFEST SERVICE
"""

import asyncio
import sys
from xml.etree import ElementTree

from asyncua import Client, ua

import lifetime


def local(element):
    return element.tag.split("}")[-1]


def nodes(manifest):
    """Returns namespace and identifier of each OPCUAItem, by its name."""
    found = {}
    for item in ElementTree.parse(manifest).getroot().iter():
        if (item.get("RefBaseClassPath") or "").endswith("/OPCUAItem"):
            values = {child.get("Name"): child[0].text for child in item if local(child) == "Attribute"}
            found[item.get("Name")] = (values["Namespace"], values["Identifier"])
    return found


async def until(node, wanted):
    for _ in range(2000):
        value = await node.read_value()
        if wanted(value):
            return value
        await asyncio.sleep(0.01)
    raise SystemExit(f"{node} stays {value}")


async def judge(endpoint, manifest, service):
    async with Client(endpoint, timeout=20) as client:
        known = {}
        unreadable = []
        for name, (namespace, identifier) in nodes(manifest).items():
            index = await client.get_namespace_index(namespace)
            kind = f"i={identifier}" if identifier.isdigit() else f"s={identifier}"
            node = client.get_node(f"ns={index};{kind}")
            try:
                await node.read_value()
                known[name] = node
            except ua.UaError as error:
                unreadable.append(f"{name}: {error}")
        of = lambda name: known[f"{service}.{name}"]
        word = lambda value: ua.Variant(value, ua.VariantType.UInt32)
        await of("CommandExt").write_value(word(4))
        await asyncio.sleep(0.3)
        without = await of("StateCur").read_value()
        for request, active in (("StateAutOp", "StateAutAct"), ("SrcExtOp", "SrcExtAct")):
            await of(request).write_value(ua.Variant(True, ua.VariantType.Boolean))
            await until(of(active), lambda value: value)
        await of("ProcedureExt").write_value(word(1))
        await until(of("ProcedureReq"), lambda value: value == 1)
        await until(of("CommandEn"), lambda value: value & 4)
        states = []
        seen = asyncio.Event()

        class Handler:
            def datachange_notification(self, node, value, data):
                if value != 16:
                    states.append(value)
                if value == 131072:
                    seen.set()

        subscription = await client.create_subscription(10, Handler())
        await subscription.subscribe_data_change(
            of("StateCur"), sampling_interval=5, queuesize=20
        )
        await of("CommandExt").write_value(word(4))
        await asyncio.wait_for(seen.wait(), 20)
        command = await until(of("CommandExt"), lambda value: value == 0)
        lifetime.say(
            read=len(known),
            unreadable=unreadable,
            without_handshake=without,
            states=states,
            command=command,
        )


lifetime.bound(60.0)
asyncio.run(judge(*sys.argv[1:]))
