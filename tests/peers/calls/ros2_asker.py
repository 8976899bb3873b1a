"""Runs an rclpy client with orders on standard input, such as {"case": "bundled", "service": "/s",
"first": 0, "count": 10, "at_once": 4}.

`patience` is the time in seconds after which a call counts as failed.
"""

import argparse
import sys
import threading
import time
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
from calls.cases import CASES
from calls.counting import Asked, lines
from calls.ros2_services import DEEP, service_class, spinning


def ask(node, clients, order):
    kind = CASES[order["case"]]
    made = service_class(kind.type)
    name = order["service"]
    if name not in clients:
        clients[name] = node.create_client(made, name, qos_profile=DEEP)
    client = clients[name]
    if not client.wait_for_service(order.get("wait", 20)):
        return {"absent": True}
    asked = Asked()
    numbers = iter(range(order.get("first", 0), order.get("first", 0) + order.get("count", 1)))
    lock = threading.Lock()

    def run():
        while True:
            with lock:
                number = next(numbers, None)
            if number is None:
                return
            request = made.Request()
            kind.ask(request, number)
            done = threading.Event()
            start = time.monotonic()
            future = client.call_async(request)
            future.add_done_callback(lambda _, done=done: done.set())
            if not done.wait(order.get("patience", 40)):
                asked.refused("no answer")
                continue
            response = future.result()
            asked.answered(kind.right(response, number), str(response), time.monotonic() - start)

    threads = [threading.Thread(target=run) for _ in range(order.get("at_once", 1))]
    start = time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return {**asked.told(order.get("times")), "seconds": time.monotonic() - start}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    lifetime.bound(args.limit)
    node = rclpy.create_node("asker")
    spinning(node, 2)
    lifetime.say(ready="asker")
    clients = {}
    for order in lines():
        lifetime.say(id=order.get("id"), answer=ask(node, clients, order))


main()
