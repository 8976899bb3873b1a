"""Runs a Cyclone DDS server or client of a ROS 2 service, as rmw_cyclonedds does: two topics, and a
header of 16 bytes before each body.

`serve` answers each request with --answer, `call` sends each --value as a request and prints the
replies.
"""

import argparse
import json
import random
import time

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

import lifetime
import ros2_service_types
import ros2_types


def body(sample):
    """Returns the JSON form of a request or reply without its header."""
    plain = ros2_types.plain(sample)
    for name in ("client", "count", "structure_needs_at_least_one_member"):
        plain.pop(name, None)
    return plain


class Ends:
    """The two topics of a service."""

    def __init__(self, participant, name, kinds):
        qos = ros2_service_types.qos()
        base = name.lstrip("/")
        self.request = Topic(participant, f"rq/{base}Request", kinds[0], qos=qos)
        self.reply = Topic(participant, f"rr/{base}Reply", kinds[1], qos=qos)
        self.qos = qos


class Server(Ends):
    def __init__(self, participant, name, kinds):
        super().__init__(participant, name, kinds)
        self.kind = kinds[1]
        self.writer = DataWriter(participant, self.reply, qos=self.qos)
        self.reader = DataReader(participant, self.request, qos=self.qos)

    def answer(self, request, reply):
        # As in rmw_cyclonedds: a request may arrive before the reader of its client is matched, and
        # an earlier reply would be lost. A client has one writer and one reader.
        end = time.monotonic() + 1.0
        while ros2_types.matched(self.writer) < ros2_types.matched(self.reader) and time.monotonic() < end:
            time.sleep(0.001)
        reply.client, reply.count = request.client, request.count
        self.writer.write(reply)


class Client(Ends):
    def __init__(self, participant, name, kinds):
        super().__init__(participant, name, kinds)
        self.kind = kinds[0]
        self.reader = DataReader(participant, self.reply, qos=self.qos)
        self.writer = DataWriter(participant, self.request, qos=self.qos)
        self.id = random.getrandbits(64)
        self.count = 0
        self.strange = 0

    def wait(self, seconds):
        """Waits until a server has matched both topics."""
        end = time.monotonic() + seconds
        while not (ros2_types.matched(self.writer) and ros2_types.matched(self.reader)):
            if time.monotonic() > end:
                raise SystemExit("no server within the time")
            time.sleep(0.005)

    def ask(self, request):
        self.count += 1
        request.client, request.count = self.id, self.count
        self.writer.write(request)
        return self.count

    def replies(self):
        """Yields number and reply of the replies for this client."""
        for reply in self.reader.take(N=1000):
            if not hasattr(reply, "count"):
                continue
            if reply.client == self.id:
                yield reply.count, reply
            else:
                self.strange += 1

    def call(self, request, seconds=10.0):
        number = self.ask(request)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for answered, reply in self.replies():
                if answered == number:
                    return reply
            time.sleep(0.001)
        raise SystemExit("no reply within the time")


def serve(args, participant, kinds):
    server = Server(participant, args.service, kinds)
    lifetime.say(ready=args.service)
    due = []
    leaving = lifetime.told() if args.leave else None
    while leaving is None or not leaving.is_set():
        for request in server.reader.take(N=1000):
            if not hasattr(request, "count"):
                continue
            lifetime.say(value=body(request), number=request.count)
            if not args.silent:
                due.append((time.monotonic() + args.delay, request))
        while due and due[0][0] <= time.monotonic():
            request = due.pop(0)[1]
            reply = ros2_types.build(server.kind, json.loads(args.answer))
            if args.echo:
                setattr(reply, args.echo, json.dumps(body(request)))
            server.answer(request, reply)
        time.sleep(0.001)


def call(args, participant, kinds):
    client = Client(participant, args.service, kinds)
    lifetime.say(ready=args.service)
    client.wait(args.wait)
    # The server may match this client later than this client matches the server.
    time.sleep(args.settle)
    values = [json.loads(value) for value in args.value]
    if args.at_once:
        open_calls = {client.ask(ros2_types.build(client.kind, value)) for value in values * args.at_once}
        end = time.monotonic() + args.wait
        while open_calls and time.monotonic() < end:
            for number, reply in client.replies():
                open_calls.discard(number)
                lifetime.say(value=body(reply))
            time.sleep(0.001)
        lifetime.say(unanswered=len(open_calls), strange=client.strange)
        return
    clients = [client]
    for value in values:
        lifetime.say(value=body(clients[-1].call(ros2_types.build(client.kind, value), args.wait)))
        if args.anew:
            clients.append(Client(participant, args.service, kinds))
            clients[-1].wait(args.wait)
    lifetime.say(unanswered=0, strange=client.strange)


def garbage(args, participant, kinds):
    """Sends samples with the type name of the requests that end within the header, or have a body
    of another form."""
    name = kinds[0].__idl_typename__.replace("::", ".").rsplit(".", 1)[1].rstrip("_")
    package, kind = kinds[0].__idl_typename__.replace("::", ".").split(".")[:2]
    fields = {
        "short": [("data", ros2_service_types.uint8, 7)],
        "bare": ros2_service_types.HEADER,
    }[args.form]
    strange = ros2_service_types.struct(f"{package}/{kind}/{name}", fields)
    qos = ros2_service_types.qos()
    topic = Topic(participant, f"rq/{args.service.lstrip('/')}Request", strange, qos=qos)
    writer = DataWriter(participant, topic, qos=qos)
    lifetime.say(ready=args.service)
    while not ros2_types.matched(writer):
        time.sleep(0.005)
    for _ in range(args.count):
        writer.write(strange())
    lifetime.say(sent=args.count)
    lifetime.told().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["serve", "call", "garbage"])
    parser.add_argument("service")
    parser.add_argument("type")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--answer", default="{}")
    parser.add_argument("--echo", help="the text field of the answer that repeats the request")
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--silent", action="store_true")
    parser.add_argument("--leave", action="store_true", help="leave in order on a line of standard input")
    parser.add_argument("--value", action="append", default=[])
    parser.add_argument("--at-once", type=int, default=0, help="ask this many times before waiting for a reply")
    parser.add_argument("--wait", type=float, default=10.0)
    parser.add_argument("--settle", type=float, default=0.2)
    parser.add_argument("--anew", action="store_true", help="ask each time with one more client of the participant")
    parser.add_argument("--form", choices=["short", "bare"], default="short")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    kinds = ros2_service_types.SERVICES[args.type]
    participant = DomainParticipant(args.domain)
    {"serve": serve, "call": call, "garbage": garbage}[args.role](args, participant, kinds)


if __name__ == "__main__":
    main()
