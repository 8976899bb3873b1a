"""Reads the folder `Values` of a component and prints JSON lines: the description of each value,
then each change with its status.
"""

import argparse
import asyncio

from asyncua import ua

import lifetime
import opcua_session


class Changes:
    def __init__(self, names):
        self.names = names

    async def datachange_notification(self, node, value, data):
        status = data.monitored_item.Value.StatusCode
        lifetime.say(changed=self.names[node.nodeid], value=opcua_session.plain(value), status=status.name)


async def named(node):
    return {(await child.read_browse_name()).Name: child for child in await node.get_children()}


async def described(node):
    found = {"node": node.nodeid.to_string()}
    children = await named(node)
    if "EURange" in children:
        eu_range = await children["EURange"].read_value()
        found["range"] = [eu_range.Low, eu_range.High]
    if "EngineeringUnits" in children:
        unit = await children["EngineeringUnits"].read_value()
        found["unit"] = [unit.DisplayName.Text, unit.UnitId]
    kind = await node.read_type_definition()
    data_type = await node.read_data_type()
    return found | {"type": kind.Identifier, "data_type": data_type.Identifier, "rank": (await node.read_value_rank()).value}


async def run(args):
    async with await opcua_session.client_of(args) as client:
        lifetime.say(ready=args.endpoint)
        component = client.get_node(ua.NodeId(1, 1))
        values = await named((await named(component))["Values"])
        lifetime.say(values={name: await described(node) for name, node in values.items()})
        watched = dict(values)
        for name, node in values.items():
            watched[f"{name}.Reason"] = (await named(node))["Reason"]
        names = {node.nodeid: name for name, node in watched.items()}
        subscription = await client.create_subscription(50, Changes(names))
        await subscription.subscribe_data_change(list(watched.values()), queuesize=10, sampling_interval=0)
        await asyncio.to_thread(lifetime.told().wait)


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
