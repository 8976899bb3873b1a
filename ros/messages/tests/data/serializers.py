"""Provides foreign ROS serializers with a common interface for `make.py` and `judge.py`.

Each serializer has

    dialect               1 or 2
    schema                name -> [(field, kind, length)]; length None is single, -1 - bound a
                          sequence, else fixed. Kinds are the kinds of ROS 1, with `time` and
                          `duration` for builtin_interfaces too, or names of messages
    build(name, made)     its message of a nested dict of field -> value; a time is
                          (seconds, nanoseconds)
    made(name, message)   the dict of a message
    write(name, message)  the bytes
    read(name, bytes)     the message
"""
import io
import re

CLOCKS = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}
# rosbags and Cyclone of Python give an empty message this field; it is not a field of the type.
HIDDEN = "structure_needs_at_least_one_member"
# Kinds with a class or form of the library: its `convert` makes it, its `parts` takes it apart.
CONVERTED = ("time", "duration", "wstring")


def short(name):
    return name.replace("/msg/", "/")


def full(name):
    return name.replace("/", "/msg/")


class Serializer:
    schema: dict

    def build(self, name, made):
        args = {}
        for field, kind, length in self.schema[name]:
            value = made[field]
            if kind in self.schema:
                one = lambda v, kind=kind: self.build(kind, v)  # noqa: E731
            elif kind in CONVERTED:
                one = lambda v, kind=kind: self.convert(kind, v)  # noqa: E731
            else:
                args[field] = value if length is None else self.array(kind, value)
                continue
            args[field] = one(value) if length is None else [one(each) for each in value]
        return self.message(name, args)

    def made(self, name, message):
        made = {}
        for field, kind, length in self.schema[name]:
            value = getattr(message, field)
            if kind in self.schema:
                one = lambda v, kind=kind: self.made(kind, v)  # noqa: E731
            elif kind in CONVERTED:
                one = self.parts
            else:
                made[field] = value if length is None else self.elements(kind, value)
                continue
            made[field] = one(value) if length is None else [one(each) for each in value]
        return made

    def array(self, kind, values):
        return values

    def elements(self, kind, values):
        return list(values)


class Rosbags(Serializer):
    """rosbags 0.11.9 of PyPI."""

    def __init__(self, dialect, extra=()):
        import numpy
        from rosbags.interfaces import Nodetype
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.numpy, self.dialect = numpy, dialect
        self.store = get_typestore(Stores.ROS1_NOETIC if dialect == 1 else Stores.ROS2_JAZZY)
        for name, text in extra:
            self.store.register(get_types_from_msg(text, full(name)))

        def field(name, desc):
            node, what = desc
            if node == Nodetype.BASE:
                return name, {"byte": "byte" if dialect == 2 else "int8", "char": "uint8"}.get(what[0], what[0]), None
            if node == Nodetype.NAME:
                return name, CLOCKS.get(what) or short(what), None
            return (*field(name, what[0])[:2], what[1] if node == Nodetype.ARRAY else -1 - what[1])

        self.schema = {
            short(name): [field(*f) for f in fields if f[0] != HIDDEN]
            for name, (_, fields) in self.store.fielddefs.items()
            if name not in CLOCKS
        }

    def message(self, name, args):
        return self.store.types[full(name)](**args)

    def convert(self, kind, value):
        return self.store.types[f"builtin_interfaces/msg/{kind.title()}"](*value)

    def parts(self, clock):
        return clock.sec, clock.nanosec

    def array(self, kind, values):
        if kind == "string":
            return values
        return self.numpy.array(values, dtype=self.numpy.dtype({"byte": "uint8"}.get(kind, kind)))

    def elements(self, kind, values):
        return values if kind == "string" else values.tolist()

    def write(self, name, message, little=True):
        if self.dialect == 1:
            return bytes(self.store.serialize_ros1(message, full(name)))
        return bytes(self.store.serialize_cdr(message, full(name), little_endian=little))

    def read(self, name, data):
        if self.dialect == 1:
            return self.store.deserialize_ros1(data, full(name))
        return self.store.deserialize_cdr(data, full(name))


class Cyclone(Serializer):
    """Bytes by cyclonedds 11.0.1 of PyPI, types by the descriptions of rosbags."""

    dialect = 2

    def __init__(self, packages, extra=()):
        self.store = Rosbags(2, extra).store
        self.schema, self.classes = {}, {}
        for name in sorted(self.store.fielddefs):
            if name.split("/")[0] in packages and name not in CLOCKS:
                self.define(name)

    def define(self, name):
        """Returns the class of a type, after defining the classes of its fields."""
        from dataclasses import dataclass

        from cyclonedds.idl import IdlStruct, types
        from rosbags.interfaces import Nodetype

        if name in self.classes:
            return self.classes[name]
        annotations, rows = {}, []
        for field, desc in self.store.fielddefs[name][1]:
            node, what = desc
            length = None
            if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                (node, what), count = what
                length = count if desc[0] == Nodetype.ARRAY else -1 - count
            if node == Nodetype.NAME and what.endswith("/wstring"):  # for rosbags a message
                node, what = Nodetype.BASE, ("wstring", 0)
            if node == Nodetype.NAME:
                base, kind = self.define(what), CLOCKS.get(what) or short(what)
            else:
                kind = {"char": "uint8"}.get(what[0], what[0])
                # rmw_cyclonedds has a word for each UTF-16 unit.
                wide = types.sequence[types.uint32]
                base = {"string": str, "bool": bool, "wstring": wide}.get(kind)
                base = base or getattr(types, {"octet": "byte"}.get(kind, kind))
            if length is not None:
                base = types.array[base, length] if length >= 0 else types.sequence[base]
            annotations[field] = base
            if field != HIDDEN:
                rows.append((field, kind, length))
        said = name.replace("/", "_")
        made = type(said, (IdlStruct,), {"__annotations__": annotations, "__module__": __name__}, typename=said)
        globals()[said] = made
        if name not in CLOCKS:
            self.schema[short(name)] = rows
        self.classes[name] = dataclass(made)
        return self.classes[name]

    def message(self, name, args):
        return self.classes[full(name)](**args) if args else self.classes[full(name)](0)

    def convert(self, kind, value):
        if kind == "wstring":
            return memoryview(value.encode("utf-16-le")).cast("H").tolist()
        return self.classes[f"builtin_interfaces/msg/{kind.title()}"](*value)

    def parts(self, clock):
        if isinstance(clock, list):
            return b"".join(unit.to_bytes(2, "little") for unit in clock).decode("utf-16-le")
        return clock.sec, clock.nanosec

    def write(self, name, message):
        return message.serialize()

    def read(self, name, data):
        return self.classes[full(name)].deserialize(data)


class Genpy(Serializer):
    """Debian's python3-genpy. `classes`: name -> class of all types, including types of fields."""

    dialect = 1

    def __init__(self, classes):
        import genpy

        self.lib, self.classes, self.schema = genpy, classes, {}
        alias = {"byte": "int8", "char": "uint8"}
        for name, cls in classes.items():
            self.schema[name] = []
            for field, kind in zip(cls.__slots__, cls._slot_types):
                base, length = re.fullmatch(r"([^\[]*)(?:\[(\d*)\])?", kind).groups()
                length = None if length is None else int(length) if length else -1
                self.schema[name].append((field, alias.get(base, base), length))

    @staticmethod
    def installed(packages):
        """Returns the classes that Debian made of the .msg files of the packages."""
        import importlib

        classes = {}
        for package in packages:
            for cls in vars(importlib.import_module(package + ".msg")).values():
                if hasattr(cls, "_slot_types"):
                    classes[cls._type] = cls
        return classes

    @staticmethod
    def defined(texts):
        """Returns the classes that genpy makes of definition texts with all dependencies, as in a
        connection header."""
        from genpy.dynamic import generate_dynamic

        classes = {}
        for name, text in texts:
            # Each class is in its own module, with its own classes of its dependencies.
            made = generate_dynamic(name, text)
            classes[name] = made[name]
        return classes

    def message(self, name, args):
        message = self.classes[name]()
        for field, value in args.items():
            setattr(message, field, value)
        return message

    def convert(self, kind, value):
        return self.lib.Time(*value) if kind == "time" else self.lib.Duration(*value)

    def parts(self, clock):
        return clock.secs, clock.nsecs

    def array(self, kind, values):
        return bytes(values) if kind == "uint8" else values

    def elements(self, kind, values):
        return list(values)

    def write(self, name, message):
        out = io.BytesIO()
        message.serialize(out)
        return out.getvalue()

    def read(self, name, data):
        message = self.classes[name]()
        message.deserialize(data)
        return message
