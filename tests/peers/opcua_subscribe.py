"""Subscribes to nodes of an OPC UA server: one JSON line per notification."""

import argparse
import asyncio

import lifetime
import opcua_session


class Heard:
    def datachange_notification(self, node, _value, data):
        lifetime.say(**opcua_session.described(node.nodeid.to_string(), data.monitored_item.Value))

    def status_change_notification(self, status):
        lifetime.say(subscription_status=str(status))


async def run(args):
    async with await opcua_session.client_of(args) as client:
        subscription = await client.create_subscription(args.period, Heard())
        nodes = [client.get_node(text) for text in args.node]
        await subscription.subscribe_data_change(nodes)
        lifetime.say(ready=True)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("--period", type=float, default=50.0, help="publishing interval in ms")
    parser.add_argument("node", nargs="+")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
