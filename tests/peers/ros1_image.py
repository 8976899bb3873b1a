"""Publishes or checks large images by rospy: `pub` sends numbered images, `sub` checks the bytes of
each received image.

The number is the height of the image; byte k of image n is (n + k) % 251.
"""

import argparse
import time

import rospy
from sensor_msgs.msg import Image

import lifetime


def pattern(number, size):
    start = number % 251
    turns = (start + size) // 251 + 1
    return (bytes(range(251)) * turns)[start : start + size]


def publish(args):
    publisher = rospy.Publisher(args.topic, Image, queue_size=50, tcp_nodelay=True)
    lifetime.say(ready=args.topic)
    while publisher.get_num_connections() == 0 and not rospy.is_shutdown():
        time.sleep(0.005)
    start = time.monotonic()
    for number in range(args.count):
        image = Image(height=number, width=1, encoding="mono8", step=1)
        image.header.frame_id = "camera"
        image.data = pattern(number, args.size)
        wait = start + number / args.rate - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        publisher.publish(image)
    lifetime.say(sent=args.count)
    rospy.spin()


def subscribe(args):
    def heard(image):
        right = image.data == pattern(image.height, args.size)
        lifetime.say(number=image.height, right=right)

    # With a small buffer, rospy reads ten megabytes in many small pieces.
    subscriber = rospy.Subscriber(
        args.topic, Image, heard, queue_size=None, buff_size=1 << 24, tcp_nodelay=True
    )
    lifetime.say(ready=args.topic)
    rospy.spin()
    subscriber.unregister()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["pub", "sub"])
    parser.add_argument("topic")
    parser.add_argument("--size", type=int, default=10_000_000)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--rate", type=float, default=5.0)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)
    rospy.init_node(f"rospy_image_{args.what}", disable_rosout=True)
    if args.what == "pub":
        publish(args)
    else:
        subscribe(args)


main()
