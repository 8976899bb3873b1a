"""Opens sessions with a subscription each, in rounds of clients that connect at once.

In a round, every other client closes its session; the connections of the others are aborted. With
`--hold COUNT`, that many sessions stay open until the program is ended.
"""

import argparse
import asyncio
import logging

from asyncua import Client

import lifetime

TIME = "i=2258"


class Ignore:
    def datachange_notification(self, node, value, data):
        pass


async def arrive(endpoint):
    client = Client(endpoint, timeout=60)
    client.session_timeout = 5_000
    await client.connect()
    subscription = await client.create_subscription(500, Ignore())
    await subscription.subscribe_data_change(client.get_node(TIME))
    return client


async def vanish(client):
    client.uaclient.protocol.transport.abort()


async def run(args):
    own = asyncio.current_task()
    for number in range(args.rounds):
        clients = await asyncio.gather(*(arrive(args.endpoint) for _ in range(args.clients)))
        leave = [vanish(one) if at % 2 else one.disconnect() for at, one in enumerate(clients)]
        await asyncio.gather(*leave, return_exceptions=True)
        others = [task for task in asyncio.all_tasks() if task is not own]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        lifetime.say(round=number + 1, clients=len(clients))
    if args.hold:
        held = [await arrive(args.endpoint) for _ in range(args.hold)]
        lifetime.say(held=len(held))
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--rounds", type=int, default=0)
    parser.add_argument("--clients", type=int, default=15)
    parser.add_argument("--hold", type=int, default=0)
    parser.add_argument("--limit", type=float, default=600.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    # Aborted connections would be logged.
    logging.disable(logging.CRITICAL)
    asyncio.run(run(args))


main()
