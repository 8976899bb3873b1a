"""Simulates a robot by rospy: it moves to setpoints and publishes its position. It does not reach
setpoints above 100."""

import argparse

import rospy
from std_msgs.msg import Float64

import lifetime


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("setpoint")
    parser.add_argument("reached")
    parser.add_argument("--limit", type=float, default=300.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node("arm", disable_rosout=True)
    reached = rospy.Publisher(args.reached, Float64, queue_size=100, tcp_nodelay=True)

    def move(message):
        lifetime.say(setpoint=message.data)
        if message.data <= 100:
            reached.publish(message)

    rospy.Subscriber(args.setpoint, Float64, move, queue_size=None, tcp_nodelay=True)
    lifetime.say(ready=True)
    rospy.spin()


main()
