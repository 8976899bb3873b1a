"""Measures Python serializers with the messages that `messages-bench dump` prints.

    python3 serializers.py genpy|rosbags

Reading converts the bytes to the library's object, writing converts it back. Neither makes UADP of
it.
"""
import io
import sys
import timeit


def genpy(name, data):
    import importlib

    package, name = name.split("/")
    try:
        cls = getattr(importlib.import_module(package + ".msg"), name)
    except ImportError:
        return None
    message = cls().deserialize(data)
    return lambda: cls().deserialize(data), lambda: message.serialize(io.BytesIO())


def rosbags(wire, name, data):
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if wire == "ROS 1" else Stores.ROS2_JAZZY)
    name = name.replace("/", "/msg/")
    if wire == "ROS 1":
        read, write = store.deserialize_ros1, store.serialize_ros1
    else:
        read, write = store.deserialize_cdr, store.serialize_cdr
    message = read(data, name)
    return lambda: read(data, name), lambda: write(message, name)


for line in sys.stdin:
    name, wire, label, data = line.rstrip("\n").split("\t")
    data = bytes.fromhex(data)
    if sys.argv[1] == "genpy":
        both = genpy(name, data) if wire == "ROS 1" else None
    else:
        both = rosbags(wire, name, data)
    for what, run in zip(("read", "write"), both or ()):
        number = max(1, timeit.Timer(run).autorange()[0] // 10)
        best = min(timeit.repeat(run, number=number, repeat=5)) / number
        print(f"{label} {wire}, {sys.argv[1]} {what}".ljust(44), f"{best * 1e9:10.0f} ns")
