"""Simulates a device by asyncua: a server with Methods that registers with the discovery server of
its level.

Configure sets the place of the device, and each call is printed. Hold blocks the device for the
given number of seconds, in which it answers no other request. Judge returns the given StatusCode,
with an InputArgumentResult and an output. With `--pairs`, the folder of `opcua_access.py servers`,
all connections are signed and encrypted: the server uses the pair `--pair`, and registers with
`--registers-with`.
"""

import argparse
import asyncio
import pathlib
import time

from asyncua import Client, Server, ua, uamethod

import lifetime
import opcua_session


@uamethod
def add(parent, a, b):
    return a + b


@uamethod
def configure(parent, place, supervisor, discovery):
    lifetime.say(place=place, supervisor=supervisor, discovery=discovery)


@uamethod
async def hold(parent, seconds):
    # time.sleep blocks the loop, so that it serves no other request meanwhile.
    lifetime.say(holds=seconds)
    time.sleep(seconds)
    lifetime.say(held=seconds)
    return seconds


async def judge(parent, code):
    result = ua.CallMethodResult()
    result.StatusCode = ua.StatusCode(code.Value)
    result.InputArgumentResults = [ua.StatusCode(ua.StatusCodes.BadOutOfRange)]
    result.OutputArguments = [ua.Variant(1.5, ua.VariantType.Double)]
    return result


def argument(name, kind):
    one = ua.Argument()
    one.Name = name
    one.DataType = ua.NodeId(kind)
    one.ValueRank = -1
    return one


async def register(args):
    server = ua.RegisteredServer()
    server.ServerUri = args.uri
    server.DiscoveryUrls = [args.endpoint]
    server.ServerType = ua.ApplicationType.Server
    server.ServerNames = [ua.LocalizedText(args.name)]
    server.IsOnline = True
    while True:
        client = Client(args.lds, timeout=2)
        client.application_uri = args.uri
        try:
            if args.pairs:
                pair = pathlib.Path(args.pairs) / args.registers_with
                await client.set_security(
                    opcua_session.POLICIES["Basic256Sha256"],
                    certificate=f"{pair}_certificate.der",
                    private_key=f"{pair}_key.pem",
                    mode=ua.MessageSecurityMode.SignAndEncrypt,
                )
            await client.connect_sessionless()
            await client.uaclient.register_server(server)
            break
        except (ua.UaError, OSError, asyncio.TimeoutError):
            await asyncio.sleep(0.1)
    await client.disconnect_sessionless()


async def run(args):
    server = Server()
    await server.init()
    await server.set_application_uri(args.uri)
    server.name = args.name
    server.set_endpoint(args.endpoint)
    if args.pairs:
        await opcua_session.secure(server, args.pairs, "Basic256Sha256", args.pair, args.uri)
    else:
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await server.register_namespace(args.uri)
    device = await server.nodes.objects.add_object(space, "device")
    double, text = ua.ObjectIds.Double, ua.ObjectIds.String
    await device.add_method(space, "Add", add, [argument("a", double), argument("b", double)], [argument("sum", double)])
    told = [argument(name, text) for name in ["Place", "SupervisorUri", "DiscoveryUrl"]]
    await device.add_method(space, "Configure", configure, told, [])
    number = ua.ObjectIds.UInt32
    await device.add_method(space, "Hold", hold, [argument("seconds", double)], [argument("held", double)])
    await device.add_method(space, "Judge", judge, [argument("code", number)], [argument("known", double)])
    await device.add_method(space, "Follow", add, [argument("node", ua.ObjectIds.NodeId)], [])
    async with server:
        await register(args)
        lifetime.say(ready=True)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("lds")
    parser.add_argument("name")
    parser.add_argument("uri")
    parser.add_argument("--pairs")
    parser.add_argument("--pair", default="sound")
    parser.add_argument("--registers-with", default="sound")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
