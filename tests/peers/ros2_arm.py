"""Simulates a robot by rclpy: it moves to setpoints and publishes its position. It does not reach
setpoints above 100."""

import argparse

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64

import lifetime


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("setpoint")
    parser.add_argument("reached")
    parser.add_argument("--limit", type=float, default=300.0)
    args = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    lifetime.bound(args.limit)
    node = rclpy.create_node("arm")
    reached = node.create_publisher(Float64, args.reached, 10)

    def move(message):
        lifetime.say(setpoint=message.data)
        if message.data <= 100:
            reached.publish(message)

    node.create_subscription(Float64, args.setpoint, move, 10)
    lifetime.say(ready=True)
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        pass


main()
