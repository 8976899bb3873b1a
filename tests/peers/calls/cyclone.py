"""Runs a Cyclone DDS server or client of services of ROS 2.

`serve CASE=/name ..` works as ros2_executor.py, and `ask` as ros2_asker.py with one call at a time.
"""

import argparse
import json
import sys
import threading
import time
from pathlib import Path

from cyclonedds.domain import DomainParticipant

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
import ros2_service_types
import ros2_types
from calls.cases import CASES, Messages
from calls.counting import Asked, Counted, lines
from ros2_service import Client, Server


def serve(participant, services):
    Messages.state = ros2_service_types.State
    counted = Counted(lifetime.say, 0.0)
    servers = []
    for case, _, name in (text.partition("=") for text in services):
        kinds = ros2_service_types.SERVICES[CASES[case].type]
        servers.append((case, Server(participant, name, kinds)))
    threading.Thread(target=counted.listen, daemon=True).start()
    lifetime.say(ready=services)
    while True:
        for case, server in servers:
            for request in server.reader.take(N=100):
                if hasattr(request, "count"):
                    server.answer(request, counted.execute(case, CASES[case], request, server.kind()))
        time.sleep(0.001)


def answered(client, request, seconds):
    number = client.ask(request)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for other, reply in client.replies():
            if other == number:
                return reply
        time.sleep(0.001)
    return None


def asked(participant, clients, order):
    kind, name = CASES[order["case"]], order["service"]
    if name not in clients:
        clients[name] = Client(participant, name, ros2_service_types.SERVICES[kind.type])
    client = clients[name]
    end = time.monotonic() + order.get("wait", 20)
    while not (ros2_types.matched(client.writer) and ros2_types.matched(client.reader)):
        if time.monotonic() > end:
            return {"absent": True}
        time.sleep(0.005)
    # The server may match this client later than this client matches the server.
    time.sleep(0.2)
    told = Asked()
    first = order.get("first", 0)
    for number in range(first, first + order.get("count", 1)):
        request = client.kind()
        kind.ask(request, number)
        start = time.monotonic()
        reply = answered(client, request, order.get("patience", 40))
        if reply is None:
            told.refused("no answer")
        else:
            told.answered(kind.right(reply, number), str(reply), time.monotonic() - start)
    return told.told()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["serve", "ask"])
    parser.add_argument("service", nargs="*")
    parser.add_argument("--domain", type=int, default=2)
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_intermixed_args()
    lifetime.bound(args.limit)
    participant = DomainParticipant(args.domain)
    if args.role == "serve":
        serve(participant, args.service)
    clients = {}
    lifetime.say(ready="ask")
    for order in lines():
        lifetime.say(id=order.get("id"), answer=asked(participant, clients, order))


main()
