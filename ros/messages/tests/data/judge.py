"""Runs a foreign serializer for `tests/foreign.rs`.

    python3 judge.py genpy|rosbags1|rosbags2|cyclone

Stdin and stdout carry frames: 4 bytes length, little endian, then the content. The first frame is
JSON, [[name, definition text]] of all types; the response is JSON, {name: md5}, with the MD5 if the
library knows it. Then each request is JSON:

    {"make": name, "seed": text, "count": n}    response: n random messages
    {"read": name, "count": n}                  then a frame of n times 4 bytes length and message;
                                                response: the fields that were read of each, and its
                                                bytes when written again

A response is one frame: for each message the bytes that the library writes, and its fields as
fields.py packs them, each after 4 bytes of length.
"""
import json
import math
import random
import struct
import sys

from fields import make, packed
from serializers import Cyclone, Genpy, Rosbags

FLOATS = [math.nan, math.inf, -math.inf, -0.0, 5e-324, 1e-45, 3.4028234663852886e38, 1.7976931348623157e308]
LETTERS = "abc xyz_/0189äßé→日本語🤖\U0010ffff"
BITS = {"int8": "b", "uint8": "B", "byte": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q",
        "uint64": "Q", "float32": "f", "float64": "d"}  # fmt: skip


def value_of(lib, name):
    """Returns a function for random values of a type, often with values at the limits."""
    early = 0 if lib.dialect == 1 else -(2**31)
    late = 2**32 if name == "genpy" else 2**31  # rosbags reads a time of ROS 1 as signed
    signed = name.startswith("rosbags")  # rosbags reads a `byte` of ROS 2 as signed

    def value(kind, rng):
        if kind == "bool":
            return rng.random() < 0.5
        if kind in ("string", "wstring"):
            return "".join(rng.choices(LETTERS, k=rng.choice((0, 0, 1, 2, 3, 5, 9, 40))))
        if kind == "time":
            return rng.randrange(early, late), rng.randrange(0, 10**7) * 100
        if kind == "duration":  # up to 99 days return to the nanosecond
            return rng.randrange(-8_589_934, 8_589_934), rng.randrange(0, 10**9)
        if kind == "byte" and signed:
            return rng.randrange(0, 128)
        form = "<" + BITS[kind]
        if kind.startswith("float") and rng.random() < 0.2:
            picked = rng.choice(FLOATS)
            return picked if kind == "float64" or abs(picked) < 3.5e38 or math.isinf(picked) else 1e-45
        if rng.random() < 0.2:
            bits = rng.choice((b"\0", b"\xff", b"\x7f")) * struct.calcsize(form)
        else:
            bits = rng.randbytes(struct.calcsize(form))
        (made,) = struct.unpack(form, bits)
        return math.nan if made != made else made

    return value


def some(rng):
    return rng.choice((0, 0, 1, 1, 2, 3, 3, 4, 7))


def library(name, texts):
    if name == "genpy":
        return Genpy(Genpy.defined(texts))
    own = [(each, text) for each, text in texts if each.startswith("judge_msgs/")]
    if name == "cyclone":
        return Cyclone({each.split("/")[0] for each, _ in texts}, own)
    return Rosbags(int(name[-1]), own)


def frame():
    size = sys.stdin.buffer.read(4)
    return sys.stdin.buffer.read(*struct.unpack("<I", size)) if size else None


def answer(data):
    sys.stdout.buffer.write(struct.pack("<I", len(data)) + data)
    sys.stdout.buffer.flush()


def blob(data):
    return struct.pack("<I", len(data)) + data


def messages(data):
    at = 0
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        yield data[at + 4 : at + 4 + size]
        at += 4 + size


def main(name):
    texts = json.loads(frame())
    lib = library(name, texts)
    md5 = {}
    for each, _ in texts:
        if each in lib.schema:
            md5[each] = lib.classes[each]._md5sum if name == "genpy" else None
    if name == "genpy":  # a package of Debian takes precedence over the definition
        for package in {each.split("/")[0] for each in md5}:
            try:
                own = Genpy.installed([package])
            except ImportError:
                continue
            md5.update({each: cls._md5sum for each, cls in own.items() if each in md5})
    answer(json.dumps(md5).encode())
    value = value_of(lib, name)
    while question := frame():
        question = json.loads(question)
        out = []
        if of := question.get("make"):
            rng = random.Random(f"{of} {question['seed']}")
            for _ in range(question["count"]):
                made = make(lib.schema, of, rng, value, some)
                out += [blob(lib.write(of, lib.build(of, made))), blob(packed(lib.schema, of, made))]
        else:
            of = question["read"]
            for each in messages(frame()):
                message = lib.read(of, each)
                out += [blob(lib.write(of, message)), blob(packed(lib.schema, of, lib.made(of, message)))]
        answer(b"".join(out))


main(sys.argv[1])
