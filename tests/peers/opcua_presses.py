"""Serves presses of a type of its maker by asyncua: objects with a force, its unit, a state and a
method.

opcua_presses.py ENDPOINT URI [--press NAME].. [--export FILE] [--variables COUNT]

Each press has the nodes of its type. A line on standard input adds the press `late`, and reports a
change of the model. With `--export`, the model is written as a NodeSet2 file first. With
`--variables`, there are that many variables in folders of 100.
"""

import argparse
import asyncio
import pathlib

from asyncua import Server, ua, uamethod

import lifetime

MAKER = "urn:example:presses"
UNITS = "http://www.opcfoundation.org/UA/units/un/cefact"


@uamethod
def stop(parent):
    return []


async def make_types(server, space):
    """Returns the type of presses, and the DataType of their modes."""
    base = await server.nodes.base_object_type.add_object_type(ua.NodeId(1000, space), f"{space}:MachineType")
    press = await base.add_object_type(ua.NodeId(1001, space), f"{space}:PressType")
    await press.write_attribute(
        ua.AttributeIds.Description,
        ua.DataValue(ua.Variant(ua.LocalizedText("A press", "en"), ua.VariantType.LocalizedText)),
    )
    force = await press.add_variable(ua.NodeId(6001, space), f"{space}:Force", 0.0, ua.VariantType.Double)
    await force.set_modelling_rule(True)
    unit = ua.EUInformation(NamespaceUri=UNITS, UnitId=5129559, DisplayName=ua.LocalizedText("N", "en"))
    units = await force.add_property(ua.NodeId(6002, space), "0:EngineeringUnits", unit)
    await units.set_modelling_rule(True)
    return press, unit


async def add_press(server, space, types, number, name):
    press, unit = types
    at = 5000 + 10 * number
    node = await server.nodes.objects.add_object(ua.NodeId(at, space), f"{space}:{name}")
    await node.delete_reference(ua.NodeId(ua.ObjectIds.BaseObjectType), ua.ObjectIds.HasTypeDefinition)
    await node.add_reference(press, ua.ObjectIds.HasTypeDefinition, bidirectional=False)
    force = await node.add_variable(ua.NodeId(at + 1, space), f"{space}:Force", 12.5 + number, ua.VariantType.Double)
    await force.add_property(ua.NodeId(at + 2, space), "0:EngineeringUnits", unit)
    await node.add_variable(ua.NodeId(at + 3, space), f"{space}:Steps", [1, 2, 3], ua.VariantType.Int32)
    await node.add_method(ua.NodeId(at + 4, space), f"{space}:Stop", stop, [], [])
    return node


async def add_variables(server, space, count):
    folder = None
    for number in range(count):
        if number % 100 == 0:
            folder = await server.nodes.objects.add_folder(ua.NodeId(100000 + number // 100, space), f"{space}:Folder{number}")
        await folder.add_variable(ua.NodeId(200000 + number, space), f"{space}:Value{number}", float(number))


def name_model(file):
    """Adds the model, which asyncua leaves out and NodeSet2 files have."""
    end = "</NamespaceUris>"
    model = f'{end}<Models><Model ModelUri="{MAKER}"/></Models>'
    file.write_text(file.read_text().replace(end, model, 1))


async def run(args):
    server = Server()
    await server.init()
    await server.set_application_uri(args.uri)
    server.set_endpoint(args.endpoint)
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await server.register_namespace(MAKER)
    types = await make_types(server, space)
    for number, name in enumerate(args.press):
        await add_press(server, space, types, number, name)
    await add_variables(server, space, args.variables)
    if args.export:
        await server.export_xml_by_ns(args.export, [space], export_values=True)
        name_model(pathlib.Path(args.export))
    changes = await server.get_event_generator(ua.ObjectIds.GeneralModelChangeEventType)
    told = lifetime.told()
    async with server:
        lifetime.say(ready=True)
        while not told.is_set():
            await asyncio.sleep(0.05)
        await add_press(server, space, types, 9, "late")
        await changes.trigger(message="a press was added")
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("uri")
    parser.add_argument("--press", action="append", default=[])
    parser.add_argument("--export")
    parser.add_argument("--variables", type=int, default=0)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
