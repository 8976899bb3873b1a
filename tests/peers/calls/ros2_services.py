"""Provides the common parts of the rclpy peers of calls."""

import importlib
import threading

from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.qos import QoSProfile

# The default depth of 10 loses requests and replies if many arrive at the same time.
DEEP = QoSProfile(depth=1000)


def service_class(name):
    package, short = name.split("/")
    return getattr(importlib.import_module(f"{package}.srv"), short)


def spinning(node, threads):
    """Spins the node in its own thread."""
    executor = MultiThreadedExecutor(threads)
    executor.add_node(node)

    def spin():
        try:
            executor.spin()
        except ExternalShutdownException:
            pass

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
