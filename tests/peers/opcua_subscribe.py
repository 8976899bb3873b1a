"""Subscribes to nodes of an OPC UA server: one JSON line per notification. With --events it
subscribes to the events of the nodes, and prints the given fields."""

import argparse
import asyncio

import lifetime
import opcua_session
from asyncua import ua


class Heard:
    def __init__(self, fields):
        self.fields = fields

    def event_notification(self, event):
        values = [field.Value for field in event.event_fields]
        texts = [value.Text if isinstance(value, ua.LocalizedText) else opcua_session.plain(value) for value in values]
        lifetime.say(event=dict(zip(self.fields, texts)))

    def datachange_notification(self, node, _value, data):
        lifetime.say(**opcua_session.described(node.nodeid.to_string(), data.monitored_item.Value))

    def status_change_notification(self, status):
        lifetime.say(subscription_status=str(status))


async def run(args):
    async with await opcua_session.client_of(args) as client:
        fields = args.events or []
        subscription = await client.create_subscription(args.period, Heard(fields))
        nodes = [client.get_node(text) for text in args.node]
        if fields:
            selects = [
                ua.SimpleAttributeOperand(
                    TypeDefinitionId=ua.NodeId(ua.ObjectIds.BaseEventType),
                    BrowsePath=[ua.QualifiedName(name, 0) for name in path.split("/")],
                    AttributeId=ua.AttributeIds.Value,
                )
                for path in fields
            ]
            for node in nodes:
                await subscription.subscribe_events(node, evfilter=ua.EventFilter(SelectClauses=selects), queuesize=100)
        else:
            await subscription.subscribe_data_change(nodes)
        lifetime.say(ready=True)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("--period", type=float, default=50.0, help="publishing interval in ms")
    parser.add_argument("--events", metavar="PATH", action="append", help="a field of the events, as FromState/Number")
    parser.add_argument("node", nargs="+")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
