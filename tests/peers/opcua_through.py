"""Follows a skill behind stations: a JSON line for each value of its state and for each event.

opcua_through.py ENDPOINT NODE   the NodeId of the skill at the server of the endpoint
"""

import argparse
import asyncio

from asyncua import ua

import lifetime
import opcua_session


class Watch:
    def __init__(self, client, types):
        self.client, self.types = client, types

    def datachange_notification(self, node, value, data):
        lifetime.say(value=value.Text if value else None, status=data.monitored_item.Value.StatusCode.name)

    def event_notification(self, event):
        lifetime.say(
            event=event.Message.Text,
            source=event.SourceName,
            node=event.SourceNode.to_string(),
            of=self.types.get(event.EventType, event.EventType.to_string()),
            to=event.ToState.Text,
            number=getattr(event, "ToState/Number"),
        )


async def types_of(client, node):
    """Returns the names of the type of an object and of its supertypes."""
    at = client.get_node(await node.read_type_definition())
    names = []
    while at.nodeid != ua.NodeId(ua.ObjectIds.BaseObjectType):
        name = await at.read_browse_name()
        names.append([(await client.get_namespace_array())[name.NamespaceIndex], name.Name])
        above = await at.get_referenced_nodes(ua.ObjectIds.HasSubtype, ua.BrowseDirection.Inverse)
        at = above[0]
    return names


async def event_types(client):
    """Returns the names of the types of transition events."""
    base = client.get_node(ua.ObjectIds.ProgramTransitionEventType)
    names = {}
    for node in await base.get_referenced_nodes(ua.ObjectIds.HasSubtype):
        names[node.nodeid] = (await node.read_browse_name()).Name
    return names


FIELDS = ["EventType", "SourceNode", "SourceName", "Message", "ToState", "ToState/Number"]


async def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("node")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    async with await opcua_session.client_of(args) as client:
        skill = client.get_node(args.node)
        lifetime.say(types=await types_of(client, skill))
        children = {(await child.read_browse_name()).Name: child for child in await skill.get_children()}
        subscription = await client.create_subscription(20, Watch(client, await event_types(client)))
        base = ua.NodeId(ua.ObjectIds.BaseEventType)
        selects = [
            ua.SimpleAttributeOperand(
                TypeDefinitionId=base,
                BrowsePath=[ua.QualifiedName(name, 0) for name in path.split("/")],
                AttributeId=ua.AttributeIds.Value,
            )
            for path in FIELDS
        ]
        await subscription.subscribe_events(skill, evfilter=ua.EventFilter(SelectClauses=selects), queuesize=100)
        await subscription.subscribe_data_change(children["CurrentState"], queuesize=100)
        lifetime.say(ready=True)
        await asyncio.Event().wait()


asyncio.run(main())
