"""Makes the tables beside this file: results of other implementations for the common interfaces.

    python3 make.py rosbags   needs the package rosbags (0.11.9)
                              -> ros1_md5.txt, ros2_fields.txt, rosbags.json
    python3 make.py cyclone   needs rosbags and cyclonedds (11.0.1) -> cyclone.json
    python3 make.py genpy     needs Debian's python3-std-msgs, -geometry-msgs, -sensor-msgs,
                              -tf2-msgs, -rosgraph-msgs, -actionlib-msgs -> genpy.json
    python3 make.py services  needs Debian's python3-std-srvs, -nav-msgs, -sensor-msgs, -tf2-msgs,
                              -diagnostic-msgs, -roscpp-msg, -move-base-msgs -> ros1_services.txt
    python3 make.py actions   needs Debian's python3-actionlib, -move-base-msgs -> ros1_actions.txt
    python3 make.py hashes    needs rosbags -> ros2_type_hashes.txt
    python3 make.py idl       needs rosbags -> rosbags_idl.json

The files of ua_msgs of this project (../../../ua_msgs) are added to each store of rosbags.

ros1_md5.txt          name and MD5 of each ROS 1 type: rosbags' store ROS1_NOETIC
ros1_services.txt     name and MD5 of each service of these packages, of roscpp/Logger, and of the
                      messages of two actions by genaction: the classes of genpy
ros1_actions.txt      name and MD5 of each message of the actions of actionlib and move_base_msgs by
                      genaction: the classes of genpy; also the classes that genpy makes of the
                      Fibonacci actions of other packages and of the actions of ua_msgs here
ros2_fields.txt       name and fields of each ROS 2 type: rosbags' store ROS2_JAZZY
ros2_type_hashes.txt  for each of rosbags' stores from Humble to Lyrical a line `# store`, then type
                      hash, name and fields of each type that is new or changed in the store
rosbags_idl.json      messages of ROS2_JAZZY in IDL, which rosbags reads back, and their type hashes
*.json                (others) random messages: their bytes as the implementation writes them, and
                      the fields that a bridge has to make of them, one line each, by the rules of
                      the crate's documentation (implemented here a second time)
"""
import json
import pathlib
import random
import sys

from fields import events, make
from serializers import CLOCKS, HIDDEN, Cyclone, Genpy, Rosbags, full, short

PACKAGES_1 = """std_msgs geometry_msgs sensor_msgs nav_msgs trajectory_msgs diagnostic_msgs actionlib_msgs
    rosgraph_msgs shape_msgs visualization_msgs stereo_msgs ua_msgs""".split()
PACKAGES_2 = PACKAGES_1 + """builtin_interfaces action_msgs unique_identifier_msgs tf2_msgs lifecycle_msgs
    rcl_interfaces""".split()


def ours():
    files = pathlib.Path(__file__).resolve().parents[3].glob("ua_msgs/msg/*.msg")
    return [(f"ua_msgs/{path.stem}", path.read_text()) for path in sorted(files)]


def write(path, samples):
    with open(path, "w") as out:
        out.write("[\n" + ",\n".join(json.dumps(s, ensure_ascii=False, separators=(",", ":")) for s in samples) + "\n]\n")


def rosbags():
    from rosbags.interfaces import Nodetype

    samples = []
    for dialect, packages in ((1, PACKAGES_1), (2, PACKAGES_2)):
        lib = Rosbags(dialect, ours())
        store = lib.store

        def written(desc):
            node, what = desc
            if node == Nodetype.BASE:
                return what[0] + (f"<={what[1]}" if what[1] else "")
            if node == Nodetype.NAME:
                return short(what)
            length = str(what[1]) if node == Nodetype.ARRAY else f"<={what[1]}" if what[1] else ""
            return f"{written(what[0])}[{length}]"

        table = []
        for name in sorted(map(short, store.fielddefs)):
            if name.split("/")[0] not in packages:
                continue
            if dialect == 1:
                table.append(f"{name} {store.generate_msgdef(full(name))[1]}")
            else:
                fields = store.fielddefs[full(name)][1]
                table.append(" ".join([name] + [f"{f}:{written(d)}" for f, d in fields if f != HIDDEN]))
            if full(name) in CLOCKS:
                continue
            made = make(lib.schema, name, random.Random(f"{name} {dialect}"))
            message = lib.build(name, made)
            sample = {"type": name, "dialect": dialect, "fields": list(events(lib.schema, name, made))}
            if dialect == 1:
                sample["ros1"] = lib.write(name, message).hex()
            else:
                sample["little"] = lib.write(name, message).hex()
                sample["big"] = lib.write(name, message, little=False).hex()
            samples.append(sample)
        with open("ros1_md5.txt" if dialect == 1 else "ros2_fields.txt", "w") as out:
            out.write("\n".join(table) + "\n")
    write("rosbags.json", samples)


def cyclone():
    lib, samples = Cyclone(PACKAGES_2), []
    for name in sorted(lib.schema, key=full):
        made = make(lib.schema, name, random.Random("cyclone " + name))
        fields = list(events(lib.schema, name, made))
        samples.append({"type": name, "dialect": 2, "fields": fields, "little": lib.write(name, lib.build(name, made)).hex()})
    write("cyclone.json", samples)


def genpy():
    import re

    classes = Genpy.installed("std_msgs geometry_msgs sensor_msgs tf2_msgs actionlib_msgs rosgraph_msgs".split())
    lib, samples = Genpy(classes), []
    for name in sorted(classes):
        made = make(lib.schema, name, random.Random("genpy " + name))
        needs = re.findall(r"^MSG: (\S+)$", classes[name]._full_text, re.M)
        samples.append({"type": name, "dialect": 1, "md5": classes[name]._md5sum, "needs": needs,
                        "fields": list(events(lib.schema, name, made)),
                        "ros1": lib.write(name, lib.build(name, made)).hex()})  # fmt: skip
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


FIBONACCI = {
    "actionlib_tutorials": "sequence", "example_interfaces": "sequence", "test_msgs": "sequence",
    "action_tutorials_interfaces": "partial_sequence",
}  # fmt: skip


def actions():
    import importlib
    import pathlib
    import subprocess
    import tempfile

    table = []
    known = [("actionlib", name) for name in ("Test", "TestRequest", "TwoInts")] + [("move_base_msgs", "MoveBase")]
    for package, action in known:
        for suffix in "Action ActionGoal ActionResult ActionFeedback Goal Result Feedback".split():
            cls = getattr(importlib.import_module(package + ".msg"), action + suffix)
            table.append(f"{cls._type} {cls._md5sum}")
    with tempfile.TemporaryDirectory() as root:
        for package, feedback in FIBONACCI.items():
            folder = pathlib.Path(root) / package / "action"
            folder.mkdir(parents=True)
            text = f"int32 order\n---\nint32[] sequence\n---\nint32[] {feedback}\n"
            (folder / "Fibonacci.action").write_text(text)
        script = pathlib.Path(__file__).resolve().parent / "genmsg_md5.py"
        made = subprocess.run([sys.executable, script, root], capture_output=True, text=True, check=True)
        table += made.stdout.splitlines()
    ua_msgs = script.parents[3] / "ua_msgs"
    made = subprocess.run([sys.executable, script, ua_msgs], capture_output=True, text=True, check=True)
    table += made.stdout.splitlines()
    with open("ros1_actions.txt", "w") as out:
        out.write("\n".join(sorted(table)) + "\n")


def hashes():
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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
            for name, text in ours():
                store.register(get_types_from_msg(text, full(name)))
            out.write(f"# {which.title()}\n")
            for name in sorted(store.fielddefs):
                fields = [f"{f}:{written(d)}" for f, d in store.fielddefs[name][1]
                          if f != "structure_needs_at_least_one_member"]
                line = " ".join([store.hash_rihs01(name), short(name), *fields])
                if before.get(name) != line:
                    out.write(line + "\n")
                    before[name] = line


IDL_WORDS = {"bool": "boolean", "byte": "octet", "char": "uint8", "float32": "float", "float64": "double"}


def idl_text(store, full_name):
    """Returns a message in IDL, as rosidl_adapter writes it."""
    from rosbags.interfaces import Nodetype

    package, _, name = full_name.split("/")
    includes, typedefs, members = set(), [], []

    def base(desc):
        node, what = desc
        if node == Nodetype.NAME:
            of, _, message = what.split("/")
            includes.add(f"{of}/msg/{message}.idl")
            return f"{of}::msg::{message}"
        word = IDL_WORDS.get(what[0], what[0])
        return f"{word}<{what[1]}>" if what[1] else word

    def typedef(of, to):
        if (of, to) not in typedefs:
            typedefs.append((of, to))

    constants, fields = store.fielddefs[full_name]
    for field, desc in fields:
        node, what = desc
        if node == Nodetype.ARRAY:
            of = base(what[0])
            flat = of.replace("::", "__")
            if flat != of:
                typedef(of, flat)
            kind = f"{flat}__{what[1]}"
            typedef(flat, f"{kind}[{what[1]}]")
        elif node == Nodetype.SEQUENCE:
            of = base(what[0])
            kind = f"sequence<{of}, {what[1]}>" if what[1] else f"sequence<{of}>"
        else:
            kind = base(desc)
        comment = f'      @verbatim (language="comment", text=\n        "About {field}; {{ it" "\\n" "is")\n'
        members.append(f"{comment}      {kind} {field};\n")
    lines = [f"// generated from rosidl_adapter/resource/msg.idl.em\n// with input from {package}/msg/{name}.msg\n\n"]
    lines += [f'#include "{include}"\n' for include in sorted(includes)]
    lines += [f"\nmodule {package} {{\n  module msg {{\n"]
    lines += [f"    typedef {of} {to};\n" for of, to in typedefs]
    if constants:
        lines.append(f"    module {name}_Constants {{\n")
        for constant, kind, value in constants:
            word = IDL_WORDS.get(kind, kind)
            value = str(value).upper() if word == "boolean" else json.dumps(value)
            lines.append(f"      const {word} {constant} = {value};\n")
        lines.append("    };\n")
    lines.append(f'    @verbatim (language="comment", text=\n      "A message")\n    struct {name} {{\n')
    return "".join([*lines, "\n".join(members), "    };\n  };\n};\n"])


def idl():
    from rosbags.typesys import Stores, get_types_from_idl, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    samples = []
    for name in IDL_SAMPLES:
        text = idl_text(store, full(name))
        read = get_typestore(Stores.ROS2_JAZZY)
        # The parser of rosbags does not support `#include`.
        plain = "".join(line for line in text.splitlines(True) if not line.startswith("#"))
        read.fielddefs.update(get_types_from_idl(plain))
        assert read.fielddefs[full(name)] == store.fielddefs[full(name)], name
        samples.append({"type": name, "hash": read.hash_rihs01(full(name)), "idl": text})
    write("rosbags_idl.json", samples)


IDL_SAMPLES = """geometry_msgs/PoseWithCovariance geometry_msgs/Polygon std_msgs/Empty std_msgs/Byte std_msgs/ByteMultiArray
    sensor_msgs/CameraInfo sensor_msgs/JointState sensor_msgs/BatteryState sensor_msgs/PointField
    shape_msgs/SolidPrimitive shape_msgs/Mesh diagnostic_msgs/DiagnosticStatus rcl_interfaces/ParameterDescriptor
    lifecycle_msgs/Transition nav_msgs/OccupancyGrid builtin_interfaces/Duration""".split()


{"hashes": hashes, "actions": actions, "rosbags": rosbags, "cyclone": cyclone, "genpy": genpy, "services": services, "idl": idl}[sys.argv[1]]()
