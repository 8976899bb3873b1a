"""Queries a discovery server without a session, or registers a server with it: one JSON line for
each response."""

import argparse
import asyncio

from asyncua import ua

import lifetime
import opcua_access
import opcua_session


def described(error):
    return {"status": type(error).__name__, "code": getattr(error, "code", None)}


async def find(client, args):
    servers = await client.find_servers()
    lifetime.say(
        registered=[
            {
                "uri": one.ApplicationUri,
                "name": one.ApplicationName.Text,
                "urls": one.DiscoveryUrls,
                "gateway": one.GatewayServerUri,
            }
            for one in servers
        ]
    )
    if args.what == "find-servers":
        return
    asked = ua.FindServersOnNetworkParameters()
    asked.StartingRecordId = args.start
    asked.MaxRecordsToReturn = args.most
    asked.ServerCapabilityFilter = args.capability
    network = await client.uaclient.find_servers_on_network(asked)
    lifetime.say(
        network=[
            {
                "id": one.RecordId,
                "name": one.ServerName,
                "url": one.DiscoveryUrl,
                "capabilities": one.ServerCapabilities,
            }
            for one in network.Servers
        ]
    )
    endpoints = await client.get_endpoints()
    lifetime.say(endpoints=[one.EndpointUrl for one in endpoints])


async def register(client, args):
    server = ua.RegisteredServer()
    server.ServerUri = args.uri
    server.DiscoveryUrls = args.url
    server.ServerType = ua.ApplicationType[args.type]
    server.SemaphoreFilePath = args.semaphore
    server.ServerNames = [ua.LocalizedText(args.name)] if args.name else []
    server.IsOnline = not args.offline
    try:
        if args.old:
            await client.uaclient.register_server(server)
            lifetime.say(status="Good")
            return
        configuration = ua.MdnsDiscoveryConfiguration()
        configuration.MdnsServerName = args.mdns
        configuration.ServerCapabilities = args.capability or ["DA", "AC"]
        parameters = ua.RegisterServer2Parameters()
        parameters.Server = server
        parameters.DiscoveryConfiguration = [configuration] if args.mdns else []
        results = await client.uaclient.register_server2(parameters)
        lifetime.say(status="Good", results=[one.name for one in results or []])
    except ua.UaStatusCodeError as error:
        lifetime.say(**described(error))


async def session(client, args):
    try:
        await client.create_session()
        lifetime.say(status="Good")
    except ua.UaStatusCodeError as error:
        lifetime.say(**described(error))


async def run(args):
    refusals = opcua_access.Refusals()
    try:
        client = await opcua_session.client_of(args)
        await client.connect_sessionless()
    except (ua.UaError, OSError, asyncio.TimeoutError) as error:
        # Only the client's log has the error that ends the connection.
        said = described(error)
        lifetime.say(**said | {"status": refusals.last or said["status"]})
        return
    try:
        await {"find": find, "find-servers": find, "register": register, "session": session}[args.what](client, args)
    finally:
        await client.disconnect_sessionless()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["find", "find-servers", "register", "session"])
    opcua_session.add_arguments(parser)
    parser.add_argument("--uri", default="urn:asyncua:arm")
    parser.add_argument("--url", action="append", default=[])
    parser.add_argument("--name", default="arm")
    parser.add_argument("--type", default="Server", choices=["Server", "Client", "DiscoveryServer"])
    parser.add_argument("--semaphore", help="a file that is there while the server is installed")
    parser.add_argument("--capability", action="append", default=[], help="of the server, or that one found has")
    parser.add_argument("--start", type=int, default=0, help="the first record")
    parser.add_argument("--most", type=int, default=0, help="how many records")
    parser.add_argument("--mdns", help="the name to be announced under")
    parser.add_argument("--offline", action="store_true")
    parser.add_argument("--old", action="store_true", help="RegisterServer instead of RegisterServer2")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
