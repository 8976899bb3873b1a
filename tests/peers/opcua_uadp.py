#!/usr/bin/env python3
"""A UADP publisher and listener made of raw bytes: it shares no code with what it tests.

    opcua_uadp.py send 239.192.0.40:4840 --topic 1,2,10 --double 2.5 [--sequence 1] [--status 0x8034] [--keep-alive]
    opcua_uadp.py listen 239.192.0.40:4840 [--publisher 0] [--within 10] [--count 1]

`listen` prints a JSON line {"listening": true} when it has joined, then one for each DataSetMessage:
publisher, writer_group, writer, kind, sequence, timestamp, picoseconds, status, fields: [[type id, value], ..].
Layout: OPC 10000-14, 7.2.4.4 and 7.2.4.5. Only Variant fields of scalar fixed-size types and String are read.
"""

import argparse
import json
import socket
import struct
import sys
import time

EPOCH_TICKS = 116_444_736_000_000_000


def ticks_now():
    return time.time_ns() // 100 + EPOCH_TICKS


def network_message(topic, sequence, fields, status=None, keep_alive=False, ticks=None, picoseconds=None):
    """One NetworkMessage with one DataSetMessage; `fields` are encoded Variants."""
    publisher, group, writer = topic
    out = struct.pack("<BBHBHHBH", 0xF1, 0x01, publisher, 0x09, group, sequence, 1, writer)
    flags1 = 0x01 | 0x08 | 0x80 | (0x10 if status is not None else 0)
    flags2 = (3 if keep_alive else 0) | 0x10 | (0x20 if picoseconds is not None else 0)
    out += struct.pack("<BBHq", flags1, flags2, sequence, ticks_now() if ticks is None else ticks)
    if picoseconds is not None:
        out += struct.pack("<H", picoseconds)
    if status is not None:
        out += struct.pack("<H", status)
    if not keep_alive:
        out += struct.pack("<H", len(fields)) + b"".join(fields)
    return out


def double(value):
    return b"\x0b" + struct.pack("<d", value)


def int32(value):
    return b"\x06" + struct.pack("<i", value)


def boolean(value):
    return b"\x01" + struct.pack("<?", value)


def string(value):
    encoded = value.encode()
    return b"\x0c" + struct.pack("<i", len(encoded)) + encoded


class Bytes:
    def __init__(self, data):
        self.data, self.at = data, 0

    def take(self, form):
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values[0]


FIXED = {1: "?", 2: "b", 3: "B", 4: "h", 5: "H", 6: "i", 7: "I", 8: "q", 9: "Q", 10: "f", 11: "d", 13: "q", 19: "I"}


def scalar(data, kind):
    if kind == 0:
        return None
    if kind in FIXED:
        return data.take(FIXED[kind])
    if kind == 12:
        length = data.take("i")
        text = data.data[data.at : data.at + max(length, 0)].decode()
        data.at += max(length, 0)
        return text if length >= 0 else None
    raise ValueError(f"type {kind} is not read here")


def variant(data):
    encoding = data.take("B")
    kind = encoding & 0x3F
    if encoding & 0x80:
        return [kind, [scalar(data, kind) for _ in range(data.take("i"))]]
    return [kind, scalar(data, kind)]


def decode(datagram):
    data = Bytes(datagram)
    flags = data.take("B")
    extended1 = data.take("B") if flags & 0x80 else 0
    extended2 = data.take("B") if extended1 & 0x80 else 0
    message = {"publisher": None, "writer_group": None}
    if flags & 0x10:
        message["publisher"] = data.take("BHIQ"[extended1 & 7])
    if flags & 0x20:
        group = data.take("B")
        for bit, name, form in [(1, "writer_group", "H"), (2, "group_version", "I"), (4, "number", "H"), (8, "group_sequence", "H")]:
            if group & bit:
                message[name] = data.take(form)
    writers = [data.take("H") for _ in range(data.take("B"))] if flags & 0x40 else [None]
    if extended1 & 0x20:
        message["sent"] = data.take("q")
    if extended1 & 0x40:
        data.take("H")
    if extended1 & 0x10 or extended2 & 0x03:
        raise ValueError("secured, chunked or promoted fields are not read here")
    if len(writers) > 1:
        for _ in writers:
            data.take("H")
    for writer in writers:
        yield {**message, "writer": writer, **data_set_message(data)}


def data_set_message(data):
    flags1 = data.take("B")
    flags2 = data.take("B") if flags1 & 0x80 else 0
    message = {"kind": ["key frame", "delta frame", "event", "keep-alive"][flags2 & 0x0F]}
    for present, name, form in [
        (flags1 & 0x08, "sequence", "H"),
        (flags2 & 0x10, "timestamp", "q"),
        (flags2 & 0x20, "picoseconds", "H"),
        (flags1 & 0x10, "status", "H"),
        (flags1 & 0x20, "major", "I"),
        (flags1 & 0x40, "minor", "I"),
    ]:
        message[name] = data.take(form) if present else None
    if flags2 & 0x0F == 0:
        message["fields"] = [variant(data) for _ in range(data.take("H"))]
    return message


def address(text):
    host, port = text.rsplit(":", 1)
    return host, int(port)


def multicast(host):
    return 224 <= int(host.split(".")[0]) <= 239


def sender():
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
    return out


def listener(group):
    host, port = group
    heard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    heard.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    heard.bind(group)
    if multicast(host):
        heard.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(host) + socket.inet_aton("127.0.0.1"))
    return heard


def send(arguments):
    fields = [double(v) for v in arguments.double] + [int32(v) for v in arguments.int32]
    fields += [boolean(v == "true") for v in arguments.boolean] + [string(v) for v in arguments.string]
    topic = tuple(int(part) for part in arguments.topic.split(","))
    message = network_message(topic, arguments.sequence, fields, arguments.status, arguments.keep_alive, arguments.ticks, arguments.picoseconds)
    sender().sendto(message, address(arguments.group))


def listen(arguments):
    heard = listener(address(arguments.group))
    print(json.dumps({"listening": True}), flush=True)
    end, left = time.monotonic() + arguments.within, arguments.count
    while left > 0:
        heard.settimeout(max(end - time.monotonic(), 0.001))
        try:
            datagram = heard.recv(65535)
        except TimeoutError:
            sys.exit("nothing more came")
        for message in decode(datagram):
            if arguments.publisher is None or message["publisher"] == arguments.publisher:
                if message["kind"] == "key frame" or arguments.all:
                    print(json.dumps(message), flush=True)
                    left -= 1


def main():
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("send")
    one.add_argument("group")
    one.add_argument("--topic", required=True)
    one.add_argument("--sequence", type=int, default=1)
    one.add_argument("--status", type=lambda text: int(text, 0))
    one.add_argument("--ticks", type=int)
    one.add_argument("--picoseconds", type=int)
    one.add_argument("--keep-alive", action="store_true")
    for name, kind in [("double", float), ("int32", int), ("boolean", str), ("string", str)]:
        one.add_argument(f"--{name}", type=kind, action="append", default=[])
    two = commands.add_parser("listen")
    two.add_argument("group")
    two.add_argument("--publisher", type=int)
    two.add_argument("--within", type=float, default=10)
    two.add_argument("--count", type=int, default=1)
    two.add_argument("--all", action="store_true", help="keep-alives too")
    arguments = parser.parse_args()
    send(arguments) if arguments.command == "send" else listen(arguments)


if __name__ == "__main__":
    main()
