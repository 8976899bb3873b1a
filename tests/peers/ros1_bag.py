"""Prints the content of a bag: one JSON line per connection, then one per message, read by the
definitions in the bag."""

import sys

import rosbag

import lifetime
import ros1_messages


def main():
    with rosbag.Bag(sys.argv[1]) as bag:
        for connection in bag._get_connections():
            lifetime.say(
                topic=connection.topic,
                type=connection.datatype,
                md5sum=connection.md5sum,
                definition=connection.msg_def,
                callerid=connection.header["callerid"].decode(),
                latching=connection.header["latching"].decode(),
            )
        for topic, message, _ in bag.read_messages():
            lifetime.say(message=topic, value=ros1_messages.plain(message))


main()
