"""Provides service classes of ROS 1: installed classes, and classes made of their definition."""

import hashlib

import genpy.dynamic
import roslib.message

# A `byte` of ROS 2 is a uint8; ROS 1 has a type `byte` too, which is an int8.
BASIC = """bool bool_value
uint8 byte_value
char char_value
float32 float32_value
float64 float64_value
int8 int8_value
uint8 uint8_value
int16 int16_value
uint16 uint16_value
int32 int32_value
uint32 uint32_value
int64 int64_value
uint64 uint64_value
string string_value"""

STATE = "uint8 id\nstring label"
TEXTS = {
    "test_msgs/BasicTypes": (BASIC, BASIC, {}),
    "lifecycle_msgs/GetAvailableStates": (
        "",
        "lifecycle_msgs/State[] available_states",
        {"lifecycle_msgs/State": STATE},
    ),
}


def md5_text(text, others):
    """Returns the text for the MD5 sum of ROS 1, in which the MD5 sum of a message replaces its
    type."""
    rows = []
    for row in text.splitlines():
        kind, name = row.split()
        element = kind.split("[")[0]
        if element in others:
            kind = hashlib.md5(others[element].encode()).hexdigest()
        rows.append(f"{kind} {name}")
    return "\n".join(rows)


def service_class(name):
    if name not in TEXTS:
        return roslib.message.get_service_class(name)
    request, response, others = TEXTS[name]
    tail = "".join(f"\n{'=' * 80}\nMSG: {other}\n{text}" for other, text in others.items())
    made = {}
    for part, text in (("Request", request), ("Response", response)):
        classes = genpy.dynamic.generate_dynamic(name + part, text + "\n" + tail)
        made[part] = classes[name + part]
        made.update(classes)
    whole = md5_text(request, others) + md5_text(response, others)
    kind = type(
        name.rsplit("/", 1)[1],
        (),
        {
            "_type": name,
            "_md5sum": hashlib.md5(whole.encode()).hexdigest(),
            "_request_class": made["Request"],
            "_response_class": made["Response"],
            "others": {other: made[other] for other in others},
        },
    )
    return kind
