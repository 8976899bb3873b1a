"""Converts ROS 1 messages from and to plain JSON values."""

import base64

import genpy
import roslib.message


def message_class(type_name):
    found = roslib.message.get_message_class(type_name)
    if found is None:
        raise SystemExit(f"no ROS 1 message type {type_name} on this machine")
    return found


def build(kind, value):
    """Returns a message of class `kind`. A value that is not an object is the value of the field
    `data`."""
    message = kind()
    fields = value if isinstance(value, dict) else {"data": value}
    genpy.message.fill_message_args(message, [fields])
    return message


def plain(value):
    """Returns the JSON form: messages are objects, bytes base64 text, times secs and nsecs."""
    if isinstance(value, genpy.Message):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, genpy.rostime.TVal):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, (bytes, bytearray)):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value
