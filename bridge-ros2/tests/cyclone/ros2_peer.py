"""A ROS 2 publisher or subscriber on Cyclone DDS, for tests: one JSON object per line on stdout.

  ros2_peer.py sub --topic ua_1_2_3 --type std_msgs/String --count 1
  ros2_peer.py pub --topic ua_2_5_10 --type std_msgs/UInt32 --count 10000 --rate 1000
  ros2_peer.py pub --topic ua_2_5_10 --type std_msgs/String --value '"hello"'

Both first print {"matched_after": seconds}. `sub` then prints {"value": ..} for each sample (with --digest
{"length": .., "sha256": ..} for a String) and ends after --count of them or with exit code 1 after --timeout; `pub`
prints {"published": n} and stays for --linger seconds. The network interface is CYCLONEDDS_URI's business.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import sys
import time

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from cyclonedds.core import Policy, Qos, ReadCondition, SampleState, InstanceState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from ros2_types import TYPES, build


def say(**fields):
    print(json.dumps(fields), flush=True)


def qos(args):
    policies = [
        Policy.Reliability.BestEffort
        if args.best_effort
        else Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.Durability.TransientLocal if args.transient_local else Policy.Durability.Volatile,
        Policy.History.KeepLast(args.depth),
    ]
    if args.transient_local:
        policies.append(
            Policy.DurabilityService(duration(seconds=0), Policy.History.KeepLast(args.depth), -1, -1, -1)
        )
    return Qos(*policies)


def await_match(handles, timeout, started):
    while not handles():
        if time.monotonic() - started > timeout:
            say(error="no match")
            sys.exit(1)
        time.sleep(0.001)
    say(matched_after=round(time.monotonic() - started, 4))


def subscribe(args, participant, topic):
    started = time.monotonic()
    reader = DataReader(Subscriber(participant), topic, qos=qos(args))
    await_match(reader.get_matched_publications, args.timeout, started)
    condition = ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Alive)
    waiter = WaitSet(participant)
    waiter.attach(condition)
    received = 0
    while received < args.count:
        if time.monotonic() - started > args.timeout:
            say(error="timeout", received=received)
            sys.exit(1)
        waiter.wait(duration(milliseconds=100))
        for sample in reader.take(N=1000):
            if not isinstance(sample, TYPES[args.type]):
                continue  # a writer left
            received += 1
            show(args, sample)


def show(args, sample):
    if args.digest:
        data = sample.data.encode()
        say(length=len(data), sha256=hashlib.sha256(data).hexdigest())
    else:
        fields = dataclasses.asdict(sample)
        say(value=fields["data"] if list(fields) == ["data"] else fields)


def publish(args, participant, topic):
    started = time.monotonic()
    writer = DataWriter(Publisher(participant), topic, qos=qos(args))
    if not args.no_wait:
        await_match(writer.get_matched_subscriptions, args.timeout, started)
    begin = time.monotonic()
    for number in range(args.count):
        if args.rate:
            ahead = begin + number / args.rate - time.monotonic()
            if ahead > 0:
                time.sleep(ahead)
        if args.size:
            value = ("%d " % number).ljust(args.size, "x")
        elif args.value is not None:
            value = json.loads(args.value)
        else:
            value = number
        writer.write(build(args.type, value))
    say(published=args.count, took=round(time.monotonic() - begin, 3))
    time.sleep(args.linger)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["pub", "sub"])
    parser.add_argument("--topic", required=True, help="ROS name without the leading slash")
    parser.add_argument("--type", required=True, choices=sorted(TYPES))
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--timeout", type=float, default=10)
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--transient-local", action="store_true")
    parser.add_argument("--depth", type=int, default=10)
    parser.add_argument("--digest", action="store_true", help="sub: show length and hash of a String")
    parser.add_argument("--rate", type=float, help="pub: messages per second")
    parser.add_argument("--value", help="pub: JSON; without it the message's number")
    parser.add_argument("--size", type=int, help="pub: a String of this many characters")
    parser.add_argument("--linger", type=float, default=1, help="pub: seconds to stay afterwards")
    parser.add_argument("--no-wait", action="store_true", help="pub: do not wait for a subscriber")
    args = parser.parse_args()
    participant = DomainParticipant(args.domain)
    topic = Topic(participant, "rt/" + args.topic, TYPES[args.type])
    (publish if args.what == "pub" else subscribe)(args, participant, topic)


if __name__ == "__main__":
    main()
