"""Runs a rospy publisher. Values come as JSON from --value or standard input; --numbered makes "0",
"1", ..."""

import argparse
import json
import time

import rospy

import lifetime
import ros1_messages


def arguments():
    parser = argparse.ArgumentParser()
    parser.add_argument("topic")
    parser.add_argument("type")
    parser.add_argument("--node", default="rospy_pub")
    parser.add_argument("--value", action="append")
    parser.add_argument("--numbered", type=int, help="send this many numbers instead of values")
    parser.add_argument("--warm-up", help="JSON value to send ten times a second until a line comes on standard input")
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--repeat", type=int, default=1, help="how often to send the values; 0: until told to end")
    parser.add_argument("--latch", action="store_true")
    parser.add_argument("--queue", type=int, default=20000)
    parser.add_argument("--wait-subscribers", type=int, default=0)
    parser.add_argument("--limit", type=float, default=120.0)
    parser.add_argument("--ports", type=int, nargs=2, default=(0, 0), help="of the slave API and of TCPROS; 0: any")
    return parser.parse_args()


def paced(values, rate, repeat):
    """Yields each value when it is due. A late value does not delay the values after it."""
    start = time.monotonic()
    sent = 0
    turn = 0
    while repeat == 0 or turn < repeat:
        for value in values:
            wait = start + sent / rate - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            if rospy.is_shutdown():
                return
            yield value
            sent += 1
        turn += 1


def main():
    args = arguments()
    lifetime.limit(args.limit)
    kind = ros1_messages.message_class(args.type)
    if args.numbered is not None:
        values = [str(number) for number in range(args.numbered)]
    else:
        values = lifetime.values_of(args)
    messages = [ros1_messages.build(kind, value) for value in values]

    xmlrpc, tcpros = args.ports
    rospy.init_node(args.node, disable_rosout=True, xmlrpc_port=xmlrpc, tcpros_port=tcpros)
    publisher = rospy.Publisher(
        args.topic, kind, queue_size=args.queue, latch=args.latch, tcp_nodelay=True
    )
    lifetime.say(ready=args.topic)
    while publisher.get_num_connections() < args.wait_subscribers and not rospy.is_shutdown():
        time.sleep(0.005)

    if args.warm_up is not None:
        told = lifetime.told()
        warm_up = ros1_messages.build(kind, json.loads(args.warm_up))
        while not told.wait(0.1) and not rospy.is_shutdown():
            publisher.publish(warm_up)

    sent = 0
    for message in paced(messages, args.rate, args.repeat):
        publisher.publish(message)
        sent += 1
    lifetime.say(sent=sent)
    rospy.spin()


main()
