"""Measures round trips over an MQTT broker between two clients of paho, each in its own process.

`echo` sends each message back. `ask` reads a number of round trips per line on standard input, and
prints the time of each in microseconds.
"""

import json
import socket
import sys
import threading
import time

import paho.mqtt.client as mqtt


def connected(client, topic):
    """Connects, subscribes to the topic, and returns when the broker has confirmed it."""
    there = threading.Event()
    client.on_subscribe = lambda *_: there.set()
    client.on_connect = lambda client, *_: client.subscribe(topic)
    client.connect("127.0.0.1", 1883)
    client.socket().setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    client.loop_start()
    if not there.wait(30):
        raise SystemExit("the broker confirms no subscription")
    print(json.dumps({"ready": True}), flush=True)


def main():
    mode, size = sys.argv[1], int(sys.argv[2])
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
    if mode == "echo":
        client.on_message = lambda client, _, message: client.publish("bench/back", message.payload)
        connected(client, "bench/there")
        threading.Event().wait()
    back = threading.Event()
    client.on_message = lambda *_: back.set()
    connected(client, "bench/back")
    payload = bytes(size)
    for line in sys.stdin:
        times = []
        for _ in range(int(line)):
            back.clear()
            start = time.perf_counter()
            client.publish("bench/there", payload)
            if not back.wait(30):
                raise SystemExit("no message came back")
            times.append((time.perf_counter() - start) * 1e6)
        print(json.dumps({"us": times}), flush=True)


main()
