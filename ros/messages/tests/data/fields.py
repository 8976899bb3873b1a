"""Makes random values of messages, and the fields that a bridge has to make of them.

The rules of the crate's documentation are implemented here a second time. `schema` and `made` are
defined in serializers.py.
"""
import struct
from fractions import Fraction

BUILTIN = {
    "bool": "Boolean", "int8": "SByte", "uint8": "Byte", "int16": "Int16", "uint16": "UInt16", "int32": "Int32",
    "uint32": "UInt32", "int64": "Int64", "uint64": "UInt64", "float32": "Float", "float64": "Double",
    "string": "String", "wstring": "String", "time": "DateTime", "duration": "Double", "byte": "Byte",
}  # fmt: skip
WORDS = ["", "a", "map", "base_link", "Grüße", "odometry/filtered", "日本"]


def value(kind, rng):
    """Returns a value that all implementations print alike."""
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
    if kind == "byte":  # of ROS 2; rosbags reads it as signed
        return rng.randrange(0, 128)
    bits = int(kind.lstrip("uint"))
    return rng.randrange(0, 2**bits) if kind[0] == "u" else rng.randrange(-(2 ** (bits - 1)), 2 ** (bits - 1))


def few(rng):
    return rng.randrange(0, 3)


def make(schema, name, rng, value=value, count=few):
    made = {}
    for field, kind, length in schema[name]:
        one = (lambda: make(schema, kind, rng, value, count)) if kind in schema else (lambda: value(kind, rng))
        if (name, field) == ("std_msgs/Header", "seq"):
            made[field] = 0  # not transported, so no other value returns
        elif length is None:
            made[field] = one()
        else:
            number = length if length >= 0 else count(rng)
            made[field] = [one() for _ in range(number if length >= -1 else min(number, -1 - length))]
    return made


def walk(schema, name, made, inside=False):
    """Yields the output of a bridge, in order: (event, kind or type, value or number)."""
    for field, kind, length in schema[name]:
        v = made[field]
        if (name, field) == ("std_msgs/Header", "seq"):
            continue
        if kind in schema:
            if length is None:
                yield from walk(schema, kind, v, inside)
            elif inside:
                yield "array", None, len(v)
                for each in v:
                    yield from walk(schema, kind, each, True)
            else:
                yield "structures", kind, len(v)
                for each in v:
                    yield "begin", kind, None
                    yield from walk(schema, kind, each, True)
                    yield "end", None, None
        elif length is None:
            yield "scalar", kind, v
        elif kind in ("uint8", "byte"):
            yield "bytes", kind, bytes(each % 256 for each in v)
        elif kind in ("string", "wstring", "time", "duration"):
            yield "array", kind, len(v)
            for each in v:
                yield "element", kind, each
        else:
            yield "packed", kind, v


def ticks(time):
    """Returns ticks of 100 ns since 1601."""
    return (time[0] + 11644473600) * 10**7 + time[1] // 100


def millis(duration):
    return float(Fraction(duration[0] * 10**9 + duration[1], 10**6))


def show(kind, v):
    if kind == "bool":
        return "true" if v else "false"
    if kind == "time":
        return str(ticks(v))
    return repr(millis(v)) if kind == "duration" else str(v)


def events(schema, name, made):
    """Yields one line for each event."""
    for what, kind, v in walk(schema, name, made):
        if what in ("scalar", "element"):
            yield f"{what} {BUILTIN[kind]} {show(kind, v)}"
        elif what == "bytes":
            yield f"scalar ByteString {v.hex()}"
        elif what == "packed":
            yield " ".join(["packed", BUILTIN[kind], str(len(v))] + [show(kind, each) for each in v])
        elif what == "array":
            yield f"array {BUILTIN[kind] if kind else 'ExtensionObject'} {v}"
        else:
            yield " ".join(str(part) for part in (what, kind, v) if part is not None)


FORMATS = {
    "bool": "?", "int8": "b", "uint8": "B", "byte": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip


def one(kind, v):
    if kind in ("string", "wstring"):
        text = v.encode()
        return struct.pack("<I", len(text)) + text
    if kind == "byte":  # rosbags reads it as signed
        return struct.pack("B", v % 256)
    if kind == "time":
        return struct.pack("<q", ticks(v))
    return struct.pack("<d", millis(v)) if kind == "duration" else struct.pack("<" + FORMATS[kind], v)


def packed(schema, name, made):
    """Returns the events in binary form: a letter, then the value in little endian, or the number
    as 4 bytes."""
    out = []
    for what, kind, v in walk(schema, name, made):
        if what in ("scalar", "element"):
            out += [b"S" if what == "scalar" else b"E", one(kind, v)]
        elif what == "bytes":
            out.append(b"O" + struct.pack("<I", len(v)) + v)
        elif what == "packed":
            out.append(b"P" + struct.pack(f"<I{len(v)}{FORMATS[kind]}", len(v), *v))
        elif what in ("array", "structures"):
            out.append({"array": b"A", "structures": b"T"}[what] + struct.pack("<I", v))
        else:
            out.append({"begin": b"B", "end": b"N"}[what])
    return b"".join(out)
