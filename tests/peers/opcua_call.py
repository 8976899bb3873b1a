"""Calls a Method by asyncua.

The client finds the Method by its path below Objects, waits for it, prints its arguments, and calls
it once for each --value, a JSON list of arguments. An argument is a value of the type of the Method
(a ByteString in hexadecimal digits, a DateTime in ISO 8601), or an object with the name of another
type and the value; with --structures it may be the value of a structure, by the definitions of the
server. It prints a JSON line for each response, or its status.
"""

import argparse
import asyncio
import dataclasses
import datetime
import json
import time

from asyncua import ua
from asyncua.common.ua_utils import data_type_to_variant_type

import lifetime
import opcua_session


async def found(client, path, seconds):
    """Returns the object with the Method, and the Method; None if it does not appear within the
    time."""
    end = time.monotonic() + seconds
    while True:
        try:
            node = client.nodes.objects
            object_ = node
            for name in path.split("/"):
                names = [(await child.read_browse_name()).Name for child in await node.get_children()]
                if name not in names:
                    raise ua.UaStatusCodeError(ua.StatusCodes.BadNotFound)
                object_, node = node, (await node.get_children())[names.index(name)]
            return object_, node
        except ua.UaError:
            if time.monotonic() > end:
                return None
            await asyncio.sleep(0.05)


async def arguments(method, which):
    for child in await method.get_properties():
        if (await child.read_browse_name()).Name == which:
            described = []
            for one in await child.read_value():
                described.append([one.Name, one.DataType.Identifier, one.ValueRank])
            return described
    return []


def built(kind, fields):
    made = kind()
    for name, value in fields.items():
        inner = getattr(made, name)
        setattr(made, name, built(type(inner), value) if dataclasses.is_dataclass(inner) else value)
    return made


def opened(value):
    if isinstance(value, list):
        return [opened(item) for item in value]
    if dataclasses.is_dataclass(value):
        return {field.name: opened(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return opcua_session.plain(value)


def argument(value, kind):
    if isinstance(value, dict):
        ((name, value),) = value.items()
        if name in ua.VariantType.__members__:
            return ua.Variant(value, ua.VariantType[name])
        return ua.Variant([built(getattr(ua, name), one) for one in value], ua.VariantType.ExtensionObject)
    if kind == ua.VariantType.ByteString.value and isinstance(value, str):
        value = bytes.fromhex(value)
    if kind == ua.VariantType.DateTime.value and isinstance(value, str):
        value = datetime.datetime.fromisoformat(value)
    return ua.Variant(value, ua.VariantType(kind)) if kind else ua.Variant(value)


async def builtin(client, kind):
    # A DataType such as Duration is encoded as its base type.
    if not isinstance(kind, int) or kind <= 25:
        return kind
    return (await data_type_to_variant_type(client.get_node(ua.NodeId(kind, 0)))).value


async def called(client, object_, method, given):
    # The request is sent unchecked: asyncua's own call_method raises for a wrong argument.
    request = ua.CallMethodRequest()
    request.ObjectId, request.MethodId = object_.nodeid, method.nodeid
    request.InputArguments = given
    try:
        (result,) = await client.uaclient.call([request])
    except asyncio.TimeoutError:
        lifetime.say(given_up=True)
        return
    except ua.UaStatusCodeError as error:
        lifetime.say(fault=type(error).__name__)
        return
    lifetime.say(
        status=result.StatusCode.name,
        arguments=[one.name for one in result.InputArgumentResults or []],
        value=[opened(one.Value) for one in result.OutputArguments or []],
    )


async def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("path")
    parser.add_argument("--value", action="append", default=[])
    parser.add_argument("--wait", type=float, default=30.0)
    parser.add_argument("--structures", action="store_true")
    parser.add_argument("--hold", action="store_true", help="keeps the session until a line comes on standard input")
    parser.add_argument("--gone", action="store_true", help="waits until the Method is gone again")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    async with await opcua_session.client_of(args) as client:
        places = await found(client, args.path, args.wait)
        if places is None:
            lifetime.say(missing=args.path)
            return
        object_, method = places
        if args.structures:
            await client.load_data_type_definitions()
        takes = await arguments(method, "InputArguments")
        gives = await arguments(method, "OutputArguments")
        lifetime.say(node=method.nodeid.to_string(), takes=takes, gives=gives)
        for text in args.value:
            kinds = [await builtin(client, kind) for _, kind, _ in takes] + [None] * 9
            given = [argument(value, kind) for value, kind in zip(json.loads(text), kinds)]
            await called(client, object_, method, given)
        told = lifetime.told() if args.hold else None
        while told and not told.is_set():
            await asyncio.sleep(0.05)
        while args.gone and await found(client, args.path, 0) is not None:
            await asyncio.sleep(0.05)
        if args.gone:
            lifetime.say(gone=args.path)


asyncio.run(main())
