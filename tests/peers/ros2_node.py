"""Runs a ROS 2 node of rclpy that executes JSON objects, one per line of standard input.

A response has the `id` of its request.

{"nodes": 1}                      the names of all nodes, as `ros2 node list`
{"info": "/node"}                 a node, as `ros2 node info`
{"topics": 1}                     names and types, as `ros2 topic list -t`
{"topic": "/t"}                   the endpoints of a topic, as `ros2 topic info -v`
{"subscribe": "/t", "type": "std_msgs/msg/String", "qos": {...}}
                                  prints {"heard": "/t", "value": ...} from then on,
                                  with "checksum": 1 the checksum of the message's `data`
{"publish": "/t", "type": ..., "qos": {...}, "value": {...}}
                                  publishes once; without a value it only creates the publisher
{"publish": "/t", "type": ..., "seed": 7}
                                  random values in every field, which are the response
{"publish": "/t", "bytes": 1000000, "seed": 7}
                                  a std_msgs/msg/UInt8MultiArray; the response is the checksum
{"call": "/s", "type": "std_srvs/srv/Trigger", "value": {...}}
                                  responds with {"reply": ...}
{"serve": "/s", "type": ..., "value": {...}}
                                  replies with the value, prints {"asked": "/s", "value": ...}
{"parameters": "/node"}           its parameters with values and descriptors,
                                  as `ros2 param dump` and `describe`
{"set": "/node", "name": ..., "value": ...}
                                  responds with the result of the node
"""

import argparse
import array
import importlib
import json
import sys
import threading
import zlib
from random import Random

import numpy
import rclpy
from rclpy.action import get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosidl_parser import definition
from std_msgs.msg import UInt8MultiArray

import lifetime

WAIT = 15.0


def type_of(name):
    package, kind, name = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def qos(asked):
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=asked.get("depth", 10),
        reliability=ReliabilityPolicy[asked.get("reliability", "RELIABLE")],
        durability=DurabilityPolicy[asked.get("durability", "VOLATILE")],
    )


def plain(value):
    """Returns the JSON form of a message."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, (list, tuple, array.array, numpy.ndarray)):
        return [plain(one) for one in value]
    return value.item() if isinstance(value, numpy.generic) else value


def filled(message, values):
    """Returns the message with these fields set; the other fields stay as they are."""
    for name, value in values.items():
        there = getattr(message, name)
        if hasattr(there, "get_fields_and_field_types"):
            filled(there, value)
        elif isinstance(there, array.array):
            setattr(message, name, array.array(there.typecode, value))
        else:
            setattr(message, name, value)
    return message


INTEGERS = {f"{sign}int{size}": (size, sign == "") for sign in ("", "u") for size in (8, 16, 32, 64)}


def anything(kind, random):
    """Returns a value of a type of `rosidl_parser.definition` that differs from the default; floats
    are exact with 32 bits."""
    if isinstance(kind, definition.NamespacedType):
        return any_message(type_of("/".join(kind.namespaced_name())), random)
    if isinstance(kind, definition.AbstractNestedType):
        if isinstance(kind, definition.Array):
            count = kind.size
        else:
            count = random.randint(1, min(getattr(kind, "maximum_size", 4), 4))
        return [anything(kind.value_type, random) for _ in range(count)]
    if isinstance(kind, definition.AbstractGenericString):
        letters = "abcäöü€" if isinstance(kind, definition.AbstractWString) else "abcdefg"
        return "".join(random.choices(letters, k=min(getattr(kind, "maximum_size", 5), 5)))
    if kind.typename == "boolean":
        return random.random() < 0.5
    if kind.typename == "octet":
        return bytes([random.randrange(256)])
    if kind.typename in INTEGERS:
        size, signed = INTEGERS[kind.typename]
        value = random.getrandbits(size)
        return value - 2**size if signed and value >= 2 ** (size - 1) else value
    return random.randint(-1000, 1000) / 8


def any_message(kind, random):
    message = kind()
    if kind.__module__.startswith("builtin_interfaces"):
        # Use the precision of OPC UA: ticks of 100 ns, and a Duration is a Double.
        bits = 31 if kind.__name__ == "Time" else 20
        message.sec, message.nanosec = random.getrandbits(bits), random.randrange(10**7) * 100
        return message
    for name, one in zip(kind.get_fields_and_field_types(), kind.SLOT_TYPES, strict=True):
        setattr(message, name, anything(one, random))
    return message


def endpoint(one):
    profile = one.qos_profile
    infinite = 2**63 - 1
    return {
        "node": one.node_namespace.rstrip("/") + "/" + one.node_name,
        "type": one.topic_type,
        "hash": str(one.topic_type_hash),
        "kind": one.endpoint_type.name,
        "reliability": profile.reliability.name,
        "durability": profile.durability.name,
        "liveliness": profile.liveliness.name,
        "deadline": None if profile.deadline.nanoseconds == infinite else profile.deadline.nanoseconds,
        "lifespan": None if profile.lifespan.nanoseconds == infinite else profile.lifespan.nanoseconds,
    }


class Judge(Node):
    def __init__(self, name):
        super().__init__(name, namespace="/judge")
        self.kept = {}

    def full_names(self):
        return sorted(space.rstrip("/") + "/" + name for name, space in self.get_node_names_and_namespaces())

    def info(self, full):
        space, _, name = full.rpartition("/")
        space = space or "/"
        return {
            "publishers": self.get_publisher_names_and_types_by_node(name, space),
            "subscribers": self.get_subscriber_names_and_types_by_node(name, space),
            "services": self.get_service_names_and_types_by_node(name, space),
            "clients": self.get_client_names_and_types_by_node(name, space),
            "action servers": get_action_server_names_and_types_by_node(self, name, space),
            "action clients": get_action_client_names_and_types_by_node(self, name, space),
        }

    def publisher(self, asked):
        topic = asked["publish"]
        if topic not in self.kept:
            self.kept[topic] = self.create_publisher(type_of(asked["type"]), topic, qos(asked.get("qos", {})))
        return self.kept[topic]

    def subscribe(self, asked):
        topic = asked["subscribe"]
        value = (lambda message: zlib.crc32(message.data)) if "checksum" in asked else plain
        self.kept["subscribed", topic] = self.create_subscription(
            type_of(asked["type"]),
            topic,
            lambda message: lifetime.say(heard=topic, value=value(message)),
            qos(asked.get("qos", {})),
        )

    def serve(self, asked):
        service = asked["serve"]

        def answer(request, response):
            lifetime.say(asked=service, value=plain(request))
            return filled(response, asked["value"])

        self.kept["served", service] = self.create_service(type_of(asked["type"]), service, answer)

    def call(self, asked):
        kind = type_of(asked["type"])
        client = self.create_client(kind, asked["call"])
        try:
            if not client.wait_for_service(WAIT):
                return "no server"
            return plain(done(client.call_async(filled(kind.Request(), asked.get("value", {})))))
        finally:
            self.destroy_client(client)

    def parameters_of(self, full):
        client = AsyncParameterClient(self, full)
        if not client.wait_for_services(WAIT):
            return "no server"
        names = sorted(done(client.list_parameters()).result.names)
        values = done(client.get_parameters(names)).values
        types = done(client.get_parameter_types(names)).types
        told = done(client.describe_parameters(names)).descriptors
        return {
            name: {
                "value": parameter_value_to_python(value),
                "type": kind,
                "described": one.name,
                "described type": one.type,
                "description": one.description,
                "read only": one.read_only,
            }
            for name, value, kind, one in zip(names, values, types, told, strict=True)
        }

    def set_parameter_of(self, asked):
        client = AsyncParameterClient(self, asked["set"])
        if not client.wait_for_services(WAIT):
            return "no server"
        result = done(client.set_parameters([Parameter(asked["name"], value=asked["value"])])).results[0]
        return {"successful": result.successful, "reason": result.reason}

    def do(self, asked):
        if "nodes" in asked:
            return self.full_names()
        if "info" in asked:
            return self.info(asked["info"])
        if "topics" in asked:
            return dict(self.get_topic_names_and_types())
        if "topic" in asked:
            found = self.get_publishers_info_by_topic(asked["topic"]) + self.get_subscriptions_info_by_topic(asked["topic"])
            return [endpoint(one) for one in found]
        if "subscribe" in asked:
            return self.subscribe(asked)
        if "publish" in asked:
            publisher = self.publisher(asked)
            if "bytes" in asked:
                data = Random(asked["seed"]).randbytes(asked["bytes"])
                publisher.publish(UInt8MultiArray(data=data))
                return zlib.crc32(data)
            if "seed" in asked:
                message = any_message(type_of(asked["type"]), Random(asked["seed"]))
                publisher.publish(message)
                return plain(message)
            if "value" in asked:
                publisher.publish(filled(type_of(asked["type"])(), asked["value"]))
            return publisher.get_subscription_count()
        if "call" in asked:
            return self.call(asked)
        if "serve" in asked:
            return self.serve(asked)
        if "parameters" in asked:
            return self.parameters_of(asked["parameters"])
        if "set" in asked:
            return self.set_parameter_of(asked)
        raise ValueError("not a command")


def done(future):
    """Returns the result of a future that the executor's thread completes."""
    event = threading.Event()
    future.add_done_callback(lambda _: event.set())
    if not event.wait(WAIT):
        raise TimeoutError(f"no answer within {WAIT} s")
    return future.result()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("name", nargs="?", default="rclpy")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    lifetime.bound(args.limit)
    node = Judge(args.name)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin():
        try:
            executor.spin()
        except ExternalShutdownException:
            pass

    spinning = threading.Thread(target=spin)
    spinning.start()
    lifetime.say(ready=args.name)
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            answer = {"answer": node.do(asked)}
        except Exception as error:  # reported to the test, which then fails
            answer = {"error": repr(error)}
        lifetime.say(id=asked.get("id"), **answer)
    rclpy.shutdown()
    spinning.join()


if __name__ == "__main__":
    main()
