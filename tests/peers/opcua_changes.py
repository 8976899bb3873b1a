"""Watches the Server object of an OPC UA server for GeneralModelChangeEvents: a JSON line for each,
with the nodes and their verbs."""

import argparse
import asyncio

from asyncua import ua

import lifetime
import opcua_session


class Watch:
    def event_notification(self, event):
        changes = [[change.Affected.to_string(), int(change.Verb)] for change in event.Changes]
        lifetime.say(changes=changes, source=event.SourceNode.to_string())


async def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    async with await opcua_session.client_of(args) as client:
        subscription = await client.create_subscription(50, Watch())
        kind = ua.ObjectIds.GeneralModelChangeEventType
        await subscription.subscribe_events(client.nodes.server, kind)
        lifetime.say(ready=True)
        await asyncio.Event().wait()


asyncio.run(main())
