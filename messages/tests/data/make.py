"""Makes the tables beside it: what other implementations say about the common interfaces.

    python3 make.py rosbags   needs the package rosbags (0.11.9) -> ros1_md5.txt, ros2_fields.txt, rosbags.json
    python3 make.py cyclone   needs rosbags and cyclonedds (11.0.1) -> cyclone.json
    python3 make.py genpy     needs Debian's python3-std-msgs, -geometry-msgs, -sensor-msgs, -tf2-msgs,
                              -rosgraph-msgs, -actionlib-msgs -> genpy.json
    python3 make.py services  needs Debian's python3-std-srvs, -nav-msgs, -sensor-msgs, -tf2-msgs, -diagnostic-msgs,
                              -roscpp-msg, -move-base-msgs -> ros1_services.txt
    python3 make.py hashes    needs rosbags -> ros2_type_hashes.txt

ros1_md5.txt    name and md5 of each ROS 1 type: rosbags' store ROS1_NOETIC
ros1_services.txt name and md5 of each service of those packages, of roscpp/Logger, and of the messages genaction made
                of two actions: the classes genpy made
ros2_fields.txt name and fields of each ROS 2 type: rosbags' store ROS2_JAZZY
ros2_type_hashes.txt for each of rosbags' stores from Humble to Lyrical a line `# store`, then type hash, name and fields of
                each type that the store before has not or has otherwise
*.json          messages with made-up values: their bytes as that implementation writes them, and the fields a bridge
                is to make of them, one line each, by the rules of the crate's documentation (written here a second time)
"""
import io
import json
import random
import struct
import sys
from fractions import Fraction

PACKAGES_1 = """std_msgs geometry_msgs sensor_msgs nav_msgs trajectory_msgs diagnostic_msgs actionlib_msgs
    rosgraph_msgs shape_msgs visualization_msgs stereo_msgs""".split()
PACKAGES_2 = PACKAGES_1 + """builtin_interfaces action_msgs unique_identifier_msgs tf2_msgs lifecycle_msgs
    rcl_interfaces""".split()
BUILTIN = {
    "bool": "Boolean", "int8": "SByte", "uint8": "Byte", "int16": "Int16", "uint16": "UInt16", "int32": "Int32",
    "uint32": "UInt32", "int64": "Int64", "uint64": "UInt64", "float32": "Float", "float64": "Double",
    "string": "String", "time": "DateTime", "duration": "Double", "byte": "Byte",
}  # fmt: skip
WORDS = ["", "a", "map", "base_link", "Grüße", "odometry/filtered", "日本"]


def value(kind, rng):
    if kind == "bool":
        return rng.random() < 0.5
    if kind in ("float32", "float64"):
        return rng.randrange(-8000, 8000) / 8
    if kind == "string":
        return rng.choice(WORDS)
    if kind == "time":
        return (rng.randrange(0, 2**31), rng.randrange(0, 10**7) * 100)
    if kind == "duration":
        return (rng.randrange(-1000, 1000), rng.randrange(0, 10**9))
    if kind == "byte":  # of ROS 2; rosbags takes it for signed
        return rng.randrange(0, 128)
    bits = int(kind.lstrip("uint"))
    return rng.randrange(0, 2**bits) if kind[0] == "u" else rng.randrange(-(2 ** (bits - 1)), 2 ** (bits - 1))


def make(schema, name, rng):
    """Schema: name -> [(field, kind, length)]; length None single, -1 - bound a sequence, else fixed."""
    made = {}
    for field, kind, length in schema[name]:
        one = (lambda: make(schema, kind, rng)) if kind in schema else (lambda: value(kind, rng))
        if (name, field) == ("std_msgs/Header", "seq"):
            made[field] = 0  # not carried, so no other value comes back
        elif length is None:
            made[field] = one()
        else:
            made[field] = [one() for _ in range(length if length >= 0 else rng.randrange(0, 3))]
    return made


def show(kind, v):
    if kind == "bool":
        return "true" if v else "false"
    if kind == "time":
        return str((v[0] + 11644473600) * 10**7 + v[1] // 100)
    if kind == "duration":
        return repr(float(Fraction(v[0] * 10**9 + v[1], 10**6)))
    return str(v)


def events(schema, name, made, inside=False):
    for field, kind, length in schema[name]:
        v = made[field]
        if (name, field) == ("std_msgs/Header", "seq"):
            continue
        if kind in schema:
            if length is None:
                yield from events(schema, kind, v, inside)
            elif inside:
                yield f"array ExtensionObject {len(v)}"
                for each in v:
                    yield from events(schema, kind, each, True)
            else:
                yield f"structures {kind} {len(v)}"
                for each in v:
                    yield f"begin {kind}"
                    yield from events(schema, kind, each, True)
                    yield "end"
        elif length is None:
            yield f"scalar {BUILTIN[kind]} {show(kind, v)}"
        elif kind in ("uint8", "byte"):
            yield f"scalar ByteString {bytes(v).hex()}"
        elif kind in ("string", "time", "duration"):
            yield f"array {BUILTIN[kind]} {len(v)}"
            for each in v:
                yield f"element {BUILTIN[kind]} {show(kind, each)}"
        else:
            yield " ".join(["packed", BUILTIN[kind], str(len(v))] + [show(kind, each) for each in v])


def short(name):
    return name.replace("/msg/", "/")


def write(path, samples):
    with open(path, "w") as out:
        out.write("[\n" + ",\n".join(json.dumps(s, ensure_ascii=False, separators=(",", ":")) for s in samples) + "\n]\n")


def rosbags():
    import numpy
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore

    samples = []
    for dialect, which, packages in ((1, Stores.ROS1_NOETIC, PACKAGES_1), (2, Stores.ROS2_JAZZY, PACKAGES_2)):
        store = get_typestore(which)
        schema, bounds = {}, {}
        clocks = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}

        def field(name, desc):
            node, what = desc
            if node == Nodetype.BASE:
                return name, {"byte": "byte" if dialect == 2 else "int8", "char": "uint8"}.get(what[0], what[0]), None
            if node == Nodetype.NAME:
                return name, clocks.get(what) or short(what), None
            return (*field(name, what[0])[:2], what[1] if node == Nodetype.ARRAY else -1)

        for full, (_, fields) in store.fielddefs.items():
            if full not in clocks:
                schema[short(full)] = [field(*f) for f in fields]
        # Python's rosbags gives an empty message a hidden field; it is none.
        for name, fields in schema.items():
            schema[name] = [f for f in fields if f[0] != "structure_needs_at_least_one_member"]

        def build(name, made):
            args = {}
            for (f, kind, length), (_, desc) in zip(schema[name], store.fielddefs[name.replace("/", "/msg/")][1]):
                def one(v):
                    if kind in schema:
                        return build(kind, v)
                    if kind in ("time", "duration"):
                        return store.types["builtin_interfaces/msg/" + kind.title()](*v)
                    return v
                v = made[f]
                if length is None:
                    args[f] = one(v)
                elif kind in schema or kind in ("time", "duration", "string"):
                    args[f] = [one(e) for e in v]
                else:
                    args[f] = numpy.array(v, dtype=numpy.dtype({"byte": "uint8"}.get(kind, kind)))
            cls = store.types[name.replace("/", "/msg/")]
            return cls(**args) if schema[name] or dialect == 1 else cls()

        table = []
        for full in sorted(store.fielddefs):
            name = short(full)
            if name.split("/")[0] not in packages:
                continue
            if dialect == 1:
                table.append(f"{name} {store.generate_msgdef(full)[1]}")
            else:
                def written(desc):
                    node, what = desc
                    if node == Nodetype.BASE:
                        return what[0] + (f"<={what[1]}" if what[1] else "")
                    if node == Nodetype.NAME:
                        return short(what)
                    length = str(what[1]) if node == Nodetype.ARRAY else f"<={what[1]}" if what[1] else ""
                    return f"{written(what[0])}[{length}]"
                table.append(" ".join([name] + [f"{f}:{written(d)}" for f, d in store.fielddefs[full][1]
                                                 if f != "structure_needs_at_least_one_member"]))
            if full in clocks:
                continue
            rng = random.Random(f"{name} {dialect}")
            made = make(schema, name, rng)
            message = build(name, made)
            sample = {"type": name, "dialect": dialect, "fields": list(events(schema, name, made))}
            if dialect == 1:
                sample["ros1"] = bytes(store.serialize_ros1(message, full)).hex()
            else:
                sample["little"] = bytes(store.serialize_cdr(message, full, little_endian=True)).hex()
                sample["big"] = bytes(store.serialize_cdr(message, full, little_endian=False)).hex()
            samples.append(sample)
        with open("ros1_md5.txt" if dialect == 1 else "ros2_fields.txt", "w") as out:
            out.write("\n".join(table) + "\n")
    write("rosbags.json", samples)


def cyclone():
    """Types by rosbags' description, bytes by Cyclone DDS."""
    from dataclasses import dataclass

    from cyclonedds.idl import IdlStruct, types
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    clocks = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}
    schema, classes = {}, {}

    def cls(full):
        """Class of the type; its bases first."""
        if full in classes:
            return classes[full]
        annotations, rows = {}, []
        for field, desc in store.fielddefs[full][1]:
            node, what = desc
            length = None
            if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                (node, what), count = what
                length = count if desc[0] == Nodetype.ARRAY else -1
            if node == Nodetype.NAME:
                base, kind = cls(what), clocks.get(what) or short(what)
            else:
                kind = what[0]
                base = {"string": str, "bool": bool}.get(kind) or getattr(types, {"char": "uint8"}.get(kind, kind))
                kind = {"char": "uint8"}.get(kind, kind)
            if length is not None:
                base = types.array[base, length] if length >= 0 else types.sequence[base]
            annotations[field] = base
            if field != "structure_needs_at_least_one_member":
                rows.append((field, kind, length))
        name = full.replace("/", "_")
        made = type(name, (IdlStruct,), {"__annotations__": annotations, "__module__": __name__}, typename=name)
        globals()[name] = made
        schema[short(full)] = rows
        classes[full] = dataclass(made)
        return classes[full]

    def build(name, made):
        full = name.replace("/", "/msg/")
        args = {}
        for field, kind, length in schema[name]:
            def one(v):
                if kind in schema:
                    return build(kind, v)
                if kind in ("time", "duration"):
                    return classes["builtin_interfaces/msg/" + kind.title()](*v)
                return v
            args[field] = one(made[field]) if length is None else [one(e) for e in made[field]]
        return classes[full](**args) if args else classes[full](0)

    samples = []
    for full in sorted(store.fielddefs):
        if full.split("/")[0] in PACKAGES_2 and full not in clocks:
            cls(full)
            name = short(full)
            made = make(schema, name, random.Random("cyclone " + name))
            fields = list(events(schema, name, made))
            samples.append({"type": name, "dialect": 2, "fields": fields, "little": build(name, made).serialize().hex()})
    write("cyclone.json", samples)


def genpy():
    import importlib
    import re

    import genpy as lib

    schema, classes, samples = {}, {}, []
    for package in "std_msgs geometry_msgs sensor_msgs tf2_msgs actionlib_msgs rosgraph_msgs".split():
        module = importlib.import_module(package + ".msg")
        for cls in vars(module).values():
            if hasattr(cls, "_slot_types"):
                classes[cls._type] = cls
    alias = {"byte": "int8", "char": "uint8"}
    for name, cls in classes.items():
        schema[name] = []
        for field, kind in zip(cls.__slots__, cls._slot_types):
            base, length = re.fullmatch(r"([^\[]*)(?:\[(\d*)\])?", kind).groups()
            length = None if length is None else int(length) if length else -1
            schema[name].append((field, alias.get(base, base), length))

    def build(name, made):
        message = classes[name]()
        for field, kind, length in schema[name]:
            def one(v):
                if kind in schema:
                    return build(kind, v)
                if kind == "time":
                    return lib.Time(*v)
                return lib.Duration(*v) if kind == "duration" else v
            v = made[field]
            whole = one(v) if length is None else [one(e) for e in v]
            setattr(message, field, bytes(whole) if kind == "uint8" and length is not None else whole)
        return message

    for name in sorted(classes):
        made = make(schema, name, random.Random("genpy " + name))
        out = io.BytesIO()
        build(name, made).serialize(out)
        needs = re.findall(r"^MSG: (\S+)$", classes[name]._full_text, re.M)
        samples.append({"type": name, "dialect": 1, "md5": classes[name]._md5sum, "needs": needs,
                        "fields": list(events(schema, name, made)), "ros1": out.getvalue().hex()})  # fmt: skip
    write("genpy.json", samples)


def services():
    import importlib

    table = []
    for package in "std_srvs nav_msgs sensor_msgs tf2_msgs diagnostic_msgs roscpp".split():
        module = importlib.import_module(package + ".srv")
        classes = [cls for cls in vars(module).values() if hasattr(cls, "_request_class")]
        table += [f"{cls._type} {cls._md5sum}" for cls in classes]
    messages = [("roscpp", "Logger")]
    for package, action in [("move_base_msgs", "MoveBase"), ("tf2_msgs", "LookupTransform")]:
        for suffix in "Action ActionGoal ActionResult ActionFeedback Goal Result Feedback".split():
            messages.append((package, action + suffix))
    for package, name in messages:
        cls = getattr(importlib.import_module(package + ".msg"), name)
        table.append(f"{cls._type} {cls._md5sum}")
    with open("ros1_services.txt", "w") as out:
        out.write("\n".join(sorted(table)) + "\n")


def hashes():
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore

    def written(desc):
        node, what = desc
        if node == Nodetype.BASE:
            return what[0].replace("octet", "byte") + (f"<={what[1]}" if what[1] else "")
        if node == Nodetype.NAME:
            return short(what)
        length = str(what[1]) if node == Nodetype.ARRAY else f"<={what[1]}" if what[1] else ""
        return f"{written(what[0])}[{length}]"

    before = {}
    with open("ros2_type_hashes.txt", "w") as out:
        for which in "HUMBLE IRON JAZZY KILTED LYRICAL".split():
            store = get_typestore(getattr(Stores, "ROS2_" + which))
            out.write(f"# {which.title()}\n")
            for full in sorted(store.fielddefs):
                fields = [f"{f}:{written(d)}" for f, d in store.fielddefs[full][1]
                          if f != "structure_needs_at_least_one_member"]
                line = " ".join([store.hash_rihs01(full), short(full), *fields])
                if before.get(full) != line:
                    out.write(line + "\n")
                    before[full] = line


{"hashes": hashes, "rosbags": rosbags, "cyclone": cyclone, "genpy": genpy, "services": services}[sys.argv[1]]()
