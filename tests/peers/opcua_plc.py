"""Runs an asyncua server as a PLC that does not know the space.

Its variables are set by JSON lines on standard input, such as {"set": "Speed", "value": 1.5,
"status": "UncertainLastUsableValue", "age": 60}. Clients write another variable, and each write is
printed. `--before N` puts N namespaces before its own; with `--user NAME PASSWORD` it refuses all
other users. With `--only POLICY`, and the folder of `opcua_access.py pairs`, it refuses all clients
without that security policy.
"""

import argparse
import asyncio
import datetime
import json
import sys

from asyncua import Server, ua
from asyncua.server.user_managers import User, UserManager, UserRole

import lifetime
import opcua_session

URI = opcua_session.SERVER_URI


class Heard:
    def __init__(self):
        self.first = True

    def datachange_notification(self, _node, value, _data):
        if not self.first:
            lifetime.say(written=value)
        self.first = False


class One(UserManager):
    def __init__(self, name, password):
        self.wanted = (name, password)

    def get_user(self, _server, username=None, password=None, certificate=None):
        told = password.decode() if isinstance(password, bytes) else password
        if (username, told) == self.wanted:
            return User(role=UserRole.Admin)
        return None


def data_value(said):
    age = datetime.timedelta(seconds=said.get("age", 0))
    status = ua.StatusCode(getattr(ua.StatusCodes, said.get("status", "Good")))
    value = ua.Variant(said["value"], ua.VariantType.Double)
    source = datetime.datetime.now(datetime.timezone.utc) - age
    return ua.DataValue(value, status, SourceTimestamp=source)


async def run(args):
    server = Server(user_manager=One(*args.user) if args.user else None)
    await server.init()
    server.set_endpoint(args.endpoint)
    if args.only:
        await opcua_session.secure(server, args.pairs, args.only, args.pair, args.uri)
    else:
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    if args.user:
        server.set_identity_tokens([ua.UserNameIdentityToken])
    for number in range(args.before):
        await server.register_namespace(f"urn:other:{number}")
    space = await server.register_namespace(URI)
    line = await server.nodes.objects.add_object(ua.NodeId("Line", space), ua.QualifiedName("Line", space))
    variables = {}
    for name in ["Speed", "Load", "Setpoint"]:
        node = ua.NodeId(f"Line.{name}", space)
        variables[name] = await line.add_variable(node, ua.QualifiedName(name, space), 0.5)
    await variables["Setpoint"].set_writable()
    reader = asyncio.StreamReader()
    pipe = asyncio.StreamReaderProtocol(reader)
    await asyncio.get_running_loop().connect_read_pipe(lambda: pipe, sys.stdin)
    async with server:
        subscription = await server.create_subscription(20, Heard())
        await subscription.subscribe_data_change(variables["Setpoint"])
        lifetime.say(ready=args.endpoint)
        while line := await reader.readline():
            said = json.loads(line)
            await variables[said["set"]].write_value(data_value(said))
            lifetime.say(set=said["set"])
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--before", type=int, default=0)
    parser.add_argument("--user", nargs=2)
    parser.add_argument("--only", choices=list(opcua_session.POLICIES))
    parser.add_argument("--pairs")
    parser.add_argument("--uri", default=URI, help="the ApplicationUri it says it has")
    parser.add_argument("--pair", default="server", help="which of them it has")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args))


main()
