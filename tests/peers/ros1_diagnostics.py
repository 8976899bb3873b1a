"""Publishes diagnostic_msgs/DiagnosticArray as a robot of ROS 1 does, five times a second.

Each line of standard input is a JSON list of statuses: level, name, message, hardware_id, and
values as an object. The last list is published. With `--hear` the peer subscribes instead, and
prints each status.
"""

import json
import sys
import threading

import genpy.dynamic
import rospy

import lifetime

RULE = "=" * 80
DEFINITION = f"""std_msgs/Header header
diagnostic_msgs/DiagnosticStatus[] status
{RULE}
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
{RULE}
MSG: diagnostic_msgs/DiagnosticStatus
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
{RULE}
MSG: diagnostic_msgs/KeyValue
string key
string value
"""
ARRAY = "diagnostic_msgs/DiagnosticArray"


def main():
    lifetime.limit(120)
    classes = genpy.dynamic.generate_dynamic(ARRAY, DEFINITION)
    status, pair = classes["diagnostic_msgs/DiagnosticStatus"], classes["diagnostic_msgs/KeyValue"]
    latest = []

    def read():
        for line in sys.stdin:
            statuses = []
            for one in json.loads(line):
                values = [pair(key=key, value=value) for key, value in one.pop("values", {}).items()]
                statuses.append(status(values=values, **one))
            latest[:] = [statuses]

    def heard(array):
        for one in array.status:
            values = {pair.key: pair.value for pair in one.values}
            lifetime.say(level=one.level, name=one.name, message=one.message, hardware_id=one.hardware_id, values=values)

    rospy.init_node("robot_diagnostics", disable_rosout=True)
    if "--hear" in sys.argv:
        rospy.Subscriber(sys.argv[1], classes[ARRAY], heard)
        lifetime.say(ready=True)
        rospy.spin()
        return
    publisher = rospy.Publisher(sys.argv[1], classes[ARRAY], queue_size=1)
    threading.Thread(target=read, daemon=True).start()
    lifetime.say(ready=True)
    rate = rospy.Rate(5)
    while not rospy.is_shutdown():
        for statuses in latest:
            array = classes[ARRAY](status=statuses)
            array.header.stamp = rospy.Time.now()
            publisher.publish(array)
        rate.sleep()


main()
