"""Runs an asyncua client that calls Methods of the space: the orders of ros1_asker.py, with the
path of a Method below Objects as `service`."""

import argparse
import asyncio
import sys
import time
from pathlib import Path
from types import SimpleNamespace

from asyncua import ua

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
import opcua_session
from calls.cases import CASES
from calls.counting import Asked, lines


async def method_of(client, path):
    """Returns the object with the Method, the Method, and its arguments; None if there is none."""
    object_ = node = client.nodes.objects
    for name in path.split("/"):
        children = await node.get_children()
        names = [(await child.read_browse_name()).Name for child in children]
        if name not in names:
            return None
        object_, node = node, children[names.index(name)]
    arguments = {"InputArguments": [], "OutputArguments": []}
    for child in await node.get_properties():
        arguments[(await child.read_browse_name()).Name] = await child.read_value()
    return object_, node, arguments


async def found(client, path, seconds):
    end = time.monotonic() + seconds
    while True:
        try:
            place = await method_of(client, path)
        except ua.UaError:
            place = None
        if place is not None or time.monotonic() > end:
            return place
        await asyncio.sleep(0.05)


async def called(client, place, kind, request):
    object_, method, arguments = place
    asked = ua.CallMethodRequest()
    asked.ObjectId, asked.MethodId = object_.nodeid, method.nodeid
    asked.InputArguments = [
        ua.Variant(getattr(request, one.Name), ua.VariantType(one.DataType.Identifier))
        for one in arguments["InputArguments"]
        if hasattr(request, one.Name)
    ]
    (result,) = await client.uaclient.call([asked])
    if not result.StatusCode.is_good():
        return None, result.StatusCode.name
    names = [one.Name for one in arguments["OutputArguments"]]
    return SimpleNamespace(**{name: one.Value for name, one in zip(names, result.OutputArguments)}), ""


async def ask(client, places, order):
    kind, path = CASES[order["case"]], order["service"]
    if path not in places:
        places[path] = await found(client, path, order.get("wait", 20))
        if places[path] is None:
            return {"absent": True}
        if any(one.DataType.NamespaceIndex for one in places[path][2]["OutputArguments"]):
            await client.load_data_type_definitions()
    asked = Asked()
    first = order.get("first", 0)
    for number in range(first, first + order.get("count", 1)):
        request = SimpleNamespace(**kind.takes)
        kind.ask(request, number)
        start = time.monotonic()
        try:
            response, why = await called(client, places[path], kind, request)
        except (ua.UaError, asyncio.TimeoutError) as error:
            response, why = None, f"{type(error).__name__} {error}"
        if response is None:
            asked.refused(why)
        else:
            asked.answered(kind.right(response, number), str(response), time.monotonic() - start)
    return asked.told()


async def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.set_defaults(limit=200.0, patience=40.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    async with await opcua_session.client_of(args) as client:
        lifetime.say(ready="asker")
        places, orders = {}, lines()
        while (order := await asyncio.to_thread(next, orders, None)) is not None:
            lifetime.say(id=order.get("id"), answer=await ask(client, places, order))


asyncio.run(main())
