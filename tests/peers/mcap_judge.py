"""Reads an MCAP file with the library of its makers, and decodes ROS messages by their schemas: one
JSON line per channel."""

import sys

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import lifetime
from mcap_values import plain


def decoded(schema, channel, message):
    if channel.message_encoding != "cdr":
        return message.data.decode()
    return plain(DecoderFactory().decoder_for("cdr", schema)(message.data))


def main():
    with open(sys.argv[1], "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = {}
        for schema, channel, message in reader.iter_messages():
            line = found.setdefault(channel.topic, {
                "topic": channel.topic,
                "encoding": channel.message_encoding,
                "schema": schema.name,
                "schema_encoding": schema.encoding,
                "metadata": dict(channel.metadata),
                "first": decoded(schema, channel, message),
                "count": 0,
                "late": 0,
            })
            line["count"] += 1
            line["late"] += message.log_time < message.publish_time
        for line in found.values():
            lifetime.say(**line)
        counted = summary.statistics.message_count
        lifetime.say(messages=counted, chunks=len(summary.chunk_indexes))


main()
