"""Watches a node of an OPC UA server for events of some types, as asyncua requests them: a JSON
line for each event, and for each data change of an item that monitors events, which is a fault."""

import argparse
import asyncio

from asyncua import ua

import lifetime
import opcua_session


class Watch:
    def event_notification(self, event):
        lifetime.say(type=event.EventType.to_string(), source=event.SourceNode.to_string(), message=event.Message.Text)

    def datachange_notification(self, node, value, _data):
        lifetime.say(datachange=str(node), value=opcua_session.plain(value))


async def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("types", nargs="+", help="NodeIds of event types; events of their subtypes count as well")
    parser.add_argument("--node", default="i=2253", help="the Server object if not given")
    parser.add_argument("--interval", type=int, default=50, help="how often the server publishes, in ms")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    async with await opcua_session.client_of(args) as client:
        subscription = await client.create_subscription(args.interval, Watch())
        await subscription.subscribe_events(client.get_node(args.node), [client.get_node(node) for node in args.types])
        lifetime.say(ready=True)
        await asyncio.Event().wait()


asyncio.run(main())
