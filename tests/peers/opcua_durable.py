"""Leaves a server with two subscriptions, of which one is durable, and looks from another session
when the other one has ended. It prints the statuses of taking over both. Then it makes further
subscriptions durable until the server refuses it, and prints their number, the status, and the
number of rejected requests.
"""

import argparse
import asyncio

from asyncua import Client, ua

import lifetime
from opcua_services import Server, durable, statuses

COUNT = ua.NodeId(ua.ObjectIds.Server_ServerDiagnostics_ServerDiagnosticsSummary_CurrentSubscriptionCount)
REJECTED = ua.NodeId(ua.ObjectIds.Server_ServerDiagnostics_ServerDiagnosticsSummary_RejectedRequestsCount)
# A session has at most 50 subscriptions.
OF_A_SESSION = 50
MOST_SESSIONS = 4
# A lifetime of 3 s: long enough to prepare both subscriptions on a busy machine.
SHORT = {
    "RequestedPublishingInterval": 20.0,
    "RequestedMaxKeepAliveCount": 1,
    "RequestedLifetimeCount": 150,
    "PublishingEnabled": True,
}


async def transferred(server, subscription):
    fields = {"SubscriptionIds": [subscription], "SendInitialValues": False}
    return statuses(await server.one("TransferSubscriptions", **fields))


async def filled(endpoint):
    """Returns the number of subscriptions that become durable, and the status of the next."""
    clients, made, status = [], 0, None
    while status is None and len(clients) < MOST_SESSIONS:
        client = Client(endpoint, timeout=20)
        await client.connect()
        clients.append(client)
        server = Server(client, None)
        for _ in range(OF_A_SESSION):
            server.subscription = await server.subscribed()
            result = await durable(server, server.subscription, 1)
            if not result.StatusCode.is_good():
                status = result.StatusCode.name
                break
            made += 1
    for client in clients:
        await client.disconnect()
    return made, status


async def run(endpoint):
    async with Client(endpoint, timeout=20) as client:
        server = Server(client, None)
        (await server.write({"value": 0.0})).check()
        leaving = Client(endpoint, timeout=20)
        await leaving.connect()
        gone = Server(leaving, None)
        plain, kept = await gone.subscribed(**SHORT), await gone.subscribed(**SHORT)
        gone.subscription = kept
        (await durable(gone, kept, 1)).StatusCode.check()
        for subscription in (plain, kept):
            (await gone.create({"subscription": subscription})).StatusCode.check()
        await leaving.uaclient.close_session(False)
        leaving.uaclient.disconnect_socket()
        while await client.get_node(COUNT).read_value() > 1:
            await asyncio.sleep(0.02)
        lifetime.say(plain=await transferred(server, plain), durable=await transferred(server, kept))
        before = await client.get_node(REJECTED).read_value()
        made, status = await filled(endpoint)
        rejected = await client.get_node(REJECTED).read_value() - before
        lifetime.say(made=made, refused=status, rejected=rejected)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--limit", type=float, default=60.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args.endpoint))


main()
