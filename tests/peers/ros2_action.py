"""Runs a Cyclone DDS server or client of the Fibonacci action, as rmw_cyclonedds and rcl_action do.

`serve` accepts orders of 0 and more. It sends the numbers 1 up to the order as feedback and
succeeds with them. For an order of 100 and more it sends the numbers up to 3 and waits for a cancel
request, which it refuses if the order is odd. Order -1 is rejected, -2 is aborted.

`call` executes lines of standard input: `send ORDER`, `cancel N`, `cancel_all`, `cancel_unknown`,
`cancel_until N`, `result N`, `result_unknown` and `repeat N`, with N counting goals from 0. It
requests results by itself only with --results.
"""

import argparse
import os
import queue
import sys
import threading
import time
import uuid

from cyclonedds.core import Policy
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

import lifetime
import ros2_service_types as types
from ros2_service import Client, Server
from ros2_types import Time, matched

SEND = types.SERVICES["demo_msgs/Fibonacci_SendGoal"]
RESULT = types.SERVICES["demo_msgs/Fibonacci_GetResult"]
CANCEL = types.SERVICES["action_msgs/CancelGoal"]
ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = range(1, 7)
NAMES = ["UNKNOWN", "ACCEPTED", "EXECUTING", "CANCELING", "SUCCEEDED", "CANCELED", "ABORTED"]
CODES = ["NONE", "REJECTED", "UNKNOWN_GOAL_ID", "GOAL_TERMINATED"]
STATUS_QOS = types.qos(Policy.Durability.TransientLocal, 1)


def topics(participant, action, feedback=types.FibonacciFeedback):
    base = f"rt/{action.lstrip('/')}/_action"
    feedback = Topic(participant, f"{base}/feedback", feedback, qos=types.qos())
    return feedback, Topic(participant, f"{base}/status", types.GoalStatusArray, qos=STATUS_QOS)


def stamp():
    now = time.time_ns()
    return Time(sec=now // 10**9, nanosec=now % 10**9)


def nanos(time_):
    return time_.sec * 10**9 + time_.nanosec


def valid(reader):
    """Returns the samples of a reader, without notifications that a writer has left."""
    return [sample for sample in reader.take(N=1000) if sample.sample_info.valid_data]


class Goal:
    def __init__(self, goal_id, order):
        self.id, self.order, self.stamp = goal_id, order, stamp()
        self.status, self.sequence, self.waiting = ACCEPTED, [], []
        self.ended = None

    def info(self):
        return types.GoalInfo(goal_id=self.id, stamp=self.stamp)


class ActionServer:
    KINDS = (SEND, RESULT, types.FibonacciFeedback)

    def __init__(self, participant, args):
        base = f"{args.action}/_action"
        self.args = args
        send, result, feedback = self.KINDS
        self.send = Server(participant, f"{base}/send_goal", send)
        self.cancel = Server(participant, f"{base}/cancel_goal", CANCEL)
        self.result = Server(participant, f"{base}/get_result", result)
        feedback, status = topics(participant, args.action, feedback)
        self.feedback = DataWriter(participant, feedback, qos=types.qos())
        self.status = DataWriter(participant, status, qos=STATUS_QOS)
        self.goals = {}

    def publish(self):
        goals = self.goals.values()
        self.status.write(
            types.GoalStatusArray(status_list=[types.GoalStatus(goal_info=g.info(), status=g.status) for g in goals])
        )

    def turn(self):
        for request in valid(self.send.reader):
            self.goal(request)
        for request in valid(self.cancel.reader):
            self.cancel_goals(request)
        for request in valid(self.result.reader):
            self.ask(request)
        for goal in list(self.goals.values()):
            if goal.status < SUCCEEDED:
                self.work(goal)
            elif time.monotonic() > goal.ended + self.args.keep:
                del self.goals[bytes(goal.id.uuid)]

    def goal(self, request):
        accepted = request.order != -1 and bytes(request.goal_id.uuid) not in self.goals
        lifetime.say(goal=request.order, accepted=accepted)
        goal = Goal(request.goal_id, request.order)
        # Send feedback and a status before the response, which can happen with the threads of a
        # server.
        if self.args.hasty and accepted:
            self.goals[bytes(goal.id.uuid)] = goal
            self.step(goal)
            goal.status = EXECUTING
            self.publish()
            time.sleep(0.2)
        self.send.answer(request, self.send.kind(accepted=accepted, stamp=goal.stamp))
        if accepted:
            self.goals[bytes(goal.id.uuid)] = goal
            self.publish()

    def step(self, goal):
        numbers = goal.sequence
        numbers.append(sum(numbers[-2:]) if len(numbers) > 1 else 1)
        self.feedback.write(types.FibonacciFeedback(goal_id=goal.id, sequence=list(numbers)))

    def work(self, goal):
        if goal.status == ACCEPTED:
            goal.status = EXECUTING
            self.publish()
        if goal.status == CANCELING:
            self.end(goal, CANCELED)
        elif goal.order == -2:
            self.end(goal, ABORTED)
        elif len(goal.sequence) < min(goal.order, 3 if goal.order >= 100 else goal.order):
            self.step(goal)
        elif goal.order < 100:
            self.end(goal, SUCCEEDED)

    def end(self, goal, status):
        goal.status, goal.ended = status, time.monotonic()
        self.publish()
        for request in goal.waiting:
            self.answer(request, goal)

    def answer(self, request, goal):
        self.result.answer(request, self.result.kind(status=goal.status, sequence=goal.sequence))

    def ask(self, request):
        goal = self.goals.get(bytes(request.goal_id.uuid))
        if goal is None:
            self.result.answer(request, self.result.kind(status=0))
        elif goal.status >= SUCCEEDED:
            self.answer(request, goal)
        else:
            goal.waiting.append(request)
            lifetime.say(asked=goal.order)

    def cancel_goals(self, request):
        wanted, until = bytes(request.goal_info.goal_id.uuid), nanos(request.goal_info.stamp)
        code, found = 0, []
        if any(wanted) and not until:
            goal = self.goals.get(wanted)
            code = 2 if goal is None else 3 if goal.status > EXECUTING else 0
            found = [goal] if code == 0 else []
        else:
            for goal in self.goals.values():
                meant = not until or nanos(goal.stamp) <= until or bytes(goal.id.uuid) == wanted
                if goal.status <= EXECUTING and meant:
                    found.append(goal)
        agreed = [goal for goal in found if goal.order % 2 == 0]
        for goal in agreed:
            goal.status = CANCELING
        if found and not agreed:
            code = 1
        lifetime.say(cancel=[goal.order for goal in found], code=CODES[code])
        self.cancel.answer(
            request, self.cancel.kind(return_code=code, goals_canceling=[goal.info() for goal in agreed])
        )
        if agreed:
            self.publish()


def serve(args, participant):
    server = ActionServer(participant, args)
    lifetime.say(ready=args.action)
    while True:
        server.turn()
        time.sleep(0.002)


def lines():
    """Returns a queue with the lines of standard input."""
    waiting = queue.Queue()

    def read():
        for line in sys.stdin:
            waiting.put(line.split())

    threading.Thread(target=read, daemon=True).start()
    return waiting


class ActionClient:
    KINDS = (SEND, RESULT, types.FibonacciFeedback)

    def __init__(self, participant, args):
        base = f"{args.action}/_action"
        self.args = args
        send, result, feedback = self.KINDS
        self.send = Client(participant, f"{base}/send_goal", send)
        self.cancel = Client(participant, f"{base}/cancel_goal", CANCEL)
        self.result = Client(participant, f"{base}/get_result", result)
        feedback, status = topics(participant, args.action, feedback)
        self.feedback = DataReader(participant, feedback, qos=types.qos())
        self.status = DataReader(participant, status, qos=STATUS_QOS)
        self.goals, self.stamps, self.said = [], {}, {}
        self.pending = {}

    def wait(self, seconds):
        """Waits until a server has matched all endpoints, like `rcl_action_server_is_available`."""
        end = time.monotonic() + seconds
        services = (self.send, self.cancel, self.result)
        endpoints = [self.feedback, self.status]
        endpoints += [endpoint for service in services for endpoint in (service.reader, service.writer)]
        while not all(matched(endpoint) for endpoint in endpoints):
            if time.monotonic() > end:
                raise SystemExit("no server within the time")
            time.sleep(0.005)

    def number(self, goal_id):
        wanted = bytes(goal_id.uuid)
        return next((at for at, known in enumerate(self.goals) if bytes(known.uuid) == wanted), None)

    def ask(self, part, request, what, number):
        self.pending[(part, part.ask(request))] = (what, number)

    def ask_result(self, goal_id, number):
        self.ask(self.result, self.result.kind(goal_id=goal_id), "result", number)

    def ask_cancel(self, goal_id=None, stamp=None):
        info = types.GoalInfo(goal_id=goal_id or types.UUID(), stamp=stamp or Time())
        self.ask(self.cancel, self.cancel.kind(goal_info=info), "cancel", None)

    def run(self, words):
        unknown = types.UUID(uuid=list(uuid.uuid4().bytes))
        verb, number = words[0], int(words[1]) if len(words) > 1 else None
        if verb == "send":
            goal_id = types.UUID(uuid=list(uuid.uuid4().bytes))
            self.goals.append(goal_id)
            request = self.send.kind(goal_id=goal_id, order=number)
            self.ask(self.send, request, "goal", len(self.goals) - 1)
        elif verb == "repeat":
            request = self.send.kind(goal_id=self.goals[number], order=1)
            self.ask(self.send, request, "repeated", number)
        elif verb == "cancel":
            self.ask_cancel(self.goals[number])
        elif verb == "cancel_until":
            self.ask_cancel(stamp=self.stamps[number])
        elif verb == "cancel_all":
            self.ask_cancel()
        elif verb == "cancel_unknown":
            self.ask_cancel(unknown)
        elif verb == "result":
            self.ask_result(self.goals[number], number)
        elif verb == "result_unknown":
            self.ask_result(unknown, None)
        else:
            raise SystemExit(f"there is no {verb}")

    def answered(self, what, number, reply):
        if what in ("goal", "repeated"):
            lifetime.say(**{what: number, "accepted": reply.accepted})
            self.stamps[number] = reply.stamp
            if what == "goal" and reply.accepted and self.args.results:
                self.ask_result(self.goals[number], number)
        elif what == "result":
            lifetime.say(result=number, status=NAMES[reply.status], sequence=list(reply.sequence))
        else:
            goals = [self.number(info.goal_id) for info in reply.goals_canceling]
            lifetime.say(cancel=CODES[reply.return_code], goals=goals)

    def reported(self, number, sample):
        lifetime.say(feedback=number, sequence=list(sample.sequence))

    def turn(self):
        for part in (self.send, self.cancel, self.result):
            for count, reply in part.replies():
                known = self.pending.pop((part, count), None)
                if known:
                    self.answered(*known, reply)
        for sample in valid(self.feedback):
            number = self.number(sample.goal_id)
            if number is not None:
                self.reported(number, sample)
        for sample in valid(self.status):
            for status in sample.status_list:
                number = self.number(status.goal_info.goal_id)
                if number is not None and self.said.get(number) != status.status:
                    self.said[number] = status.status
                    lifetime.say(state=number, status=NAMES[status.status])


def call(args, participant):
    client = ActionClient(participant, args)
    client.wait(args.wait)
    lifetime.say(ready=args.action)
    told = lines()
    while True:
        client.turn()
        if not told.empty():
            client.run(told.get())
        time.sleep(0.002)


def status(args, participant):
    """Prints one line for each status, as a late subscriber."""
    topic = topics(participant, args.action)[1]
    reader = DataReader(participant, topic, qos=STATUS_QOS)
    lifetime.say(ready=args.action)
    while True:
        for sample in valid(reader):
            lifetime.say(list=[NAMES[goal.status] for goal in sample.status_list])
        time.sleep(0.002)


def garbage(args, participant):
    """Sends requests with the right type names that end too early, and feedback and a status of the
    same form."""
    base = args.action.lstrip("/") + "/_action"
    short = types.HEADER + [("data", types.uint8, 7)]
    writers = []
    for part, package, name in (
        ("send_goal", "demo_msgs/action", "Fibonacci_SendGoal"),
        ("get_result", "demo_msgs/action", "Fibonacci_GetResult"),
        ("cancel_goal", "action_msgs/srv", "CancelGoal"),
    ):
        kind = types.struct(f"{package}/{name}_Request", short)
        topic = Topic(participant, f"rq/{base}/{part}Request", kind, qos=types.qos())
        writers.append((DataWriter(participant, topic, qos=types.qos()), kind))
    for part, name, qos in (
        ("feedback", "demo_msgs/action/Fibonacci_FeedbackMessage", types.qos()),
        ("status", "action_msgs/msg/GoalStatusArray", STATUS_QOS),
    ):
        kind = types.struct(name, [("data", types.uint32, 7)])
        topic = Topic(participant, f"rt/{base}/{part}", kind, qos=qos)
        writers.append((DataWriter(participant, topic, qos=qos), kind))
    lifetime.say(ready=args.action)
    sent = set()
    while True:
        for at, (writer, kind) in enumerate(writers):
            if at not in sent and matched(writer):
                time.sleep(0.2)
                for _ in range(args.count):
                    writer.write(kind())
                sent.add(at)
        time.sleep(0.005)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=["serve", "call", "status", "garbage"])
    parser.add_argument("action")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--keep", type=float, default=10.0, help="how long the server keeps results")
    parser.add_argument("--hasty", action="store_true", help="the server's feedback comes before its answer")
    parser.add_argument("--results", action="store_true", help="the client asks for the result of what is accepted")
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--wait", type=float, default=20.0)
    parser.add_argument("--lease", type=int, help="seconds after which it counts as gone when nothing is heard of it")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    if args.lease:
        lease = f"<Discovery><LeaseDuration>{args.lease}s</LeaseDuration></Discovery>"
        more = f'<CycloneDDS><Domain id="any">{lease}</Domain></CycloneDDS>'
        os.environ["CYCLONEDDS_URI"] = os.environ.get("CYCLONEDDS_URI", "") + "," + more
    participant = DomainParticipant(args.domain)
    {"serve": serve, "call": call, "status": status, "garbage": garbage}[args.role](args, participant)


if __name__ == "__main__":
    main()
