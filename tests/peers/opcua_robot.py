"""Reads robots like a client of OPC 40010-1, which does not know skills, and prints JSON lines.

It reads each motion device system of the DeviceSet, then each value of its first task control while
skill 1 of the server's own namespace runs once. With `--values` it reads the axes, the power trains,
the speed override, the load at the flange and the safety states of the first system, and ends.
"""

import argparse
import asyncio

from asyncua import ua

import lifetime
import opcua_session

DEVICES = "http://opcfoundation.org/UA/DI/"
ROBOTICS = "http://opcfoundation.org/UA/Robotics/"
TASK = ["TaskProgramName", "TaskProgramLoaded"]
PLATE = ["Manufacturer", "Model", "ProductCode", "SerialNumber"]
# The ReferenceTypes Moves and Requires.
MOVES, REQUIRES = 18178, 18179
# Methods of skill 1.
RESET, START = 109, 105


class Told:
    def __init__(self, names):
        self.names = names

    async def datachange_notification(self, node, value, _):
        lifetime.say(changed=self.names[node.nodeid], value=value)


async def names(node, reference=ua.ObjectIds.HierarchicalReferences):
    children = await node.get_children(reference)
    return {(await child.read_browse_name()).Name: child for child in children}


async def value(node):
    shown = await node.read_data_value(raise_on_bad_status=False)
    content = shown.Value.Value if shown.Value else None
    text = content.Text if isinstance(content, ua.LocalizedText) else opcua_session.plain(content)
    return text if shown.StatusCode.is_good() else shown.StatusCode.name


async def values(node, *wanted):
    children = await names(node)
    return {name: await value(children[name]) for name in wanted}


async def with_unit(node):
    """Returns the value of an analog item and its unit."""
    unit = await (await names(node))["EngineeringUnits"].read_value()
    return [await value(node), unit.DisplayName.Text]


async def only(node, folder):
    """Returns the only device in a folder, with its type."""
    found = await names((await names(node))[folder])
    (name,) = found
    kind = await found[name].read_type_definition()
    return name, found[name], kind.Identifier


async def targets(node, reference, robotics):
    """Returns the names of the targets of a reference of OPC 40010-1."""
    found = await node.get_referenced_nodes(ua.NodeId(reference, robotics))
    return [(await target.read_browse_name()).Name for target in found]


async def power_trains(arm, robotics):
    """Returns the power trains of an arm with all that is below them."""
    trains = []
    for name, train in sorted((await names((await names(arm))["PowerTrains"])).items()):
        # A power train refers to its axis, which is no part of it.
        (motor_name, motor), *others = (await names(train, ua.ObjectIds.HasComponent)).items()
        below = await names(motor)
        parameters = await names(below["ParameterSet"])
        current = parameters.get("MotorCurrent")
        trains.append(
            {
                "name": name,
                "types": [
                    (await train.read_type_definition()).Identifier,
                    (await motor.read_type_definition()).Identifier,
                ],
                "motor": motor_name,
                "others": [other for other, _ in others],
                "temperature": await with_unit(parameters["MotorTemperature"]),
                "current": await with_unit(current) if current else None,
                "vendor": current.nodeid.NamespaceIndex != robotics if current else None,
                "plate": await values(motor, *PLATE),
                "moves": await targets(train, MOVES, robotics),
            }
        )
    return trains


async def measured(system, robotics):
    """Returns the axes, the power trains, the speed, the load and the safety states of a system."""
    _, arm, _ = await only(system, "MotionDevices")
    children = await names(arm)
    axes = []
    for name, axis in sorted((await names(children["Axes"])).items()):
        below = await names(axis)
        parameters = await names(below["ParameterSet"])
        read = [await with_unit(parameters[name]) for name in ("ActualPosition", "ActualSpeed")]
        requires = await targets(axis, REQUIRES, robotics)
        axes.append([name, *read, await value(below["MotionProfile"]), requires])
    load = await names(children["FlangeLoad"])
    center = load["CenterOfMass"]
    below = await names(center)
    parts = [await values(below["CartesianCoordinates"], "X", "Y", "Z"), await values(below["Orientation"], "A", "B", "C")]
    shown = await center.read_data_value(raise_on_bad_status=False)
    frame = shown.Value.Value if shown.Value else None
    at = frame.CartesianCoordinates if frame else None
    load = {
        "type": (await children["FlangeLoad"].read_type_definition()).Identifier,
        "mass": await with_unit(load["Mass"]),
        "center": [at.X, at.Y, at.Z] if at else None,
        "parts": parts,
    }
    safety = {}
    for name, state in (await names((await names(system))["SafetyStates"])).items():
        wanted = ["EmergencyStop", "ProtectiveStop", "OperationalMode"]
        safety[name] = await values((await names(state))["ParameterSet"], *wanted)
    speed = await value((await names(children["ParameterSet"]))["SpeedOverride"])
    trains = await power_trains(arm, robotics)
    return {"axes": axes, "trains": trains, "speed": speed, "load": load, "safety": safety}


async def run(args):
    async with await opcua_session.client_of(args) as client:
        lifetime.say(ready=args.endpoint)
        devices, robotics = [await client.get_namespace_index(uri) for uri in (DEVICES, ROBOTICS)]
        device_set = client.get_node(ua.NodeId(5001, devices))
        for system in await device_set.get_children():
            if await system.read_type_definition() != ua.NodeId(1002, robotics):
                continue
            if args.values:
                lifetime.say(**await measured(system, robotics))
                return
            arm_name, arm, arm_type = await only(system, "MotionDevices")
            _, controller, controller_type = await only(system, "Controllers")
            _, task, task_type = await only(controller, "TaskControls")
            controls = await task.get_referenced_nodes(ua.NodeId(4002, robotics))
            parameters = (await names(task))["ParameterSet"]
            lifetime.say(
                system=(await system.read_browse_name()).Name,
                types=[arm_type, controller_type, task_type],
                arm=await values(arm, *PLATE, "MotionDeviceCategory"),
                speed=await values((await names(arm))["ParameterSet"], "SpeedOverride"),
                controller=await values(controller, *PLATE),
                user=await values((await names(controller))["CurrentUser"], "Level"),
                task=await values(task, "ComponentName"),
                mode=await values(parameters, "ExecutionMode"),
                controls=[(await node.read_browse_name()).Name for node in controls] == [arm_name],
            )
            children = await names(parameters)
            watched = {children[name].nodeid: name for name in TASK}
            subscription = await client.create_subscription(20, Told(watched))
            await subscription.subscribe_data_change([children[name] for name in TASK], queuesize=10, sampling_interval=0)
            skill = client.get_node(ua.NodeId(100, 1))
            for method in (RESET, START):
                await skill.call_method(ua.NodeId(method, 1))
            await asyncio.to_thread(lifetime.told().wait)


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("--values", action="store_true")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
