"""A viewer of the Foxglove WebSocket protocol: subscribes to all channels and prints the first
value of each as a JSON line, and a file of the robot's model if one is named."""

import argparse
import asyncio
import json
import struct

import websockets
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

import lifetime
from mcap_values import plain


async def watch(args):
    protocols = [websockets.Subprotocol(args.protocol)]
    async with websockets.connect(args.url, subprotocols=protocols, max_size=None) as socket:
        channels, seen = {}, set()
        async for frame in socket:
            if isinstance(frame, str):
                message = json.loads(frame)
                if message["op"] == "serverInfo":
                    lifetime.say(protocol=socket.subprotocol, capabilities=message["capabilities"])
                elif message["op"] == "advertise":
                    new = {channel["id"]: channel for channel in message["channels"]}
                    channels.update(new)
                    # The number of a subscription differs from that of its channel.
                    wanted = [{"id": 1000 + number, "channelId": number} for number in new]
                    await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                continue
            if frame[0] == 4:
                lifetime.say(**asset(frame))
                return
            opcode, subscription, time = struct.unpack_from("<BIQ", frame)
            channel = channels[subscription - 1000]
            if opcode != 1 or channel["topic"] in seen:
                continue
            seen.add(channel["topic"])
            lifetime.say(topic=channel["topic"], encoding=channel["encoding"], time=time,
                         schema=channel["schemaName"], value=decoded(channel, frame[13:]))
            if len(seen) == args.topics:
                if args.asset is None:
                    return
                await socket.send(json.dumps({"op": "fetchAsset", "uri": args.asset, "requestId": 9}))


def asset(frame):
    opcode, request, status, length = struct.unpack_from("<BIBI", frame)
    return {"request": request, "status": status, "error": frame[10:10 + length].decode(),
            "data": frame[10 + length:].decode("latin-1")}


def decoded(channel, data):
    if channel["encoding"] != "cdr":
        return json.loads(data)
    schema = Schema(id=1, name=channel["schemaName"], encoding=channel["schemaEncoding"],
                    data=channel["schema"].encode())
    return plain(DecoderFactory().decoder_for("cdr", schema)(data))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("--protocol", default="foxglove.sdk.v1")
    parser.add_argument("--topics", type=int, default=1, help="end after a value of this many topics")
    parser.add_argument("--asset", help="fetch this file after the values")
    parser.add_argument("--limit", type=float, default=60.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(watch(args))


main()
