"""What the rclpy peers of calls have in common."""

import importlib
import threading

from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.qos import QoSProfile

# The usual 10 lose requests and replies where many come at once.
DEEP = QoSProfile(depth=1000)


def service_class(name):
    package, short = name.split("/")
    return getattr(importlib.import_module(f"{package}.srv"), short)


def spinning(node, threads):
    """Spins the node in a thread of its own."""
    executor = MultiThreadedExecutor(threads)
    executor.add_node(node)

    def spin():
        try:
            executor.spin()
        except ExternalShutdownException:
            pass

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
