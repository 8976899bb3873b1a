"""Simulates the ROS 1 side of the assembly line: a Niryo Ned, its conveyor and storage.

With --more the graph also has the usual further parts of such a robot: logs, an action, transforms,
a camera, and a message type of its own.
"""

import argparse

import genpy.dynamic
import rospy
from std_srvs.srv import SetBool, SetBoolResponse

import lifetime
import ros1_messages

SHOWS = {
    "/conveyor/running": ("std_msgs/Bool", True),
    "/storage/covers": ("std_msgs/UInt32", 7),
    "/conveyor/covers": ("std_msgs/UInt32", 2),
    "/turtlebot3/covers": ("std_msgs/UInt32", 1),
}
TAKES = {
    "/conveyor/switch": "std_msgs/Bool",
    "/park/busy": "std_msgs/Bool",
    "/bucket/busy": "std_msgs/Bool",
}
MORE = {
    "/joint_states": "sensor_msgs/JointState",
    "/camera/image": "sensor_msgs/Image",
    "/tf": "tf2_msgs/TFMessage",
    "/move/goal": "actionlib/TestActionGoal",
    "/move/status": "actionlib_msgs/GoalStatusArray",
}
OWN = ("/storage/top_cover", "line_msgs/Cover", "uint8 colour\nfloat64 height\n")


def take(topic, kind):
    def heard(message):
        lifetime.say(heard=topic, value=message.data)

    return rospy.Subscriber(topic, ros1_messages.message_class(kind), heard, queue_size=None)


def switch(request):
    lifetime.say(heard="/conveyor/switch", value=request.data)
    return SetBoolResponse(True, "runs" if request.data else "stands still")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--more", action="store_true")
    parser.add_argument("--switch", action="store_true", help="the conveyor is switched by a service")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node("assembly_line", disable_rosout=not args.more)
    shown = []
    for topic, (kind, value) in SHOWS.items():
        kind = ros1_messages.message_class(kind)
        shown.append((rospy.Publisher(topic, kind, queue_size=10), ros1_messages.build(kind, value)))
    kept = [take(topic, kind) for topic, kind in TAKES.items()]
    if args.more:
        for topic, kind in MORE.items():
            kept.append(rospy.Publisher(topic, ros1_messages.message_class(kind), queue_size=1))
        topic, name, text = OWN
        kept.append(rospy.Publisher(topic, genpy.dynamic.generate_dynamic(name, text)[name], queue_size=1))
        kept.append(rospy.Service("/conveyor/start", SetBool, lambda _: SetBoolResponse(True, "")))
    if args.switch:
        kept.append(rospy.Service("/conveyor/switch", SetBool, switch))
    lifetime.say(ready="assembly line")
    rate = rospy.Rate(10)
    while not rospy.is_shutdown():
        for publisher, message in shown:
            publisher.publish(message)
        rate.sleep()


main()
