"""Counts how often a peer executes each request, and delays each execution."""

import collections
import json
import sys
import threading


class Counted:
    """Counts requests by case and number, and reports the counts for a line of standard input. The
    line `end` ends all delays."""

    def __init__(self, say, delay):
        self.say = say
        self.delay = delay
        self.lock = threading.Lock()
        self.ended = threading.Event()
        self.times = collections.Counter()
        self.running = 0
        self.most = 0

    def execute(self, case, kind, request, response):
        with self.lock:
            self.times[case, kind.key(request)] += 1
            self.running += 1
            self.most = max(self.most, self.running)
        if self.delay:
            self.ended.wait(self.delay)
        kind.answer(request, response)
        with self.lock:
            self.running -= 1
        return response

    def tell(self):
        """Reports the number of `executed` requests, the requests that were executed more than once
        (`twice`), and the largest number of requests at the same time (`most`)."""
        with self.lock:
            self.say(
                executed=sum(self.times.values()),
                different=len(self.times),
                twice=sorted(str(key) for key, times in self.times.items() if times > 1),
                most=self.most,
                running=self.running,
            )

    def listen(self):
        for line in sys.stdin:
            if line.strip() == "end":
                self.ended.set()
            self.tell()


class Asked:
    """Collects responses: right, wrong, or failed with the reason."""

    def __init__(self):
        self.lock = threading.Lock()
        self.right = 0
        self.wrong = []
        self.failed = []
        self.took = []

    def answered(self, right, text, took):
        with self.lock:
            self.took.append(took)
            if right:
                self.right += 1
            else:
                self.wrong.append(text[:300])

    def refused(self, why):
        with self.lock:
            self.failed.append(why[:300])

    def told(self, times=False):
        took = sorted(self.took) or [0.0]
        return {
            **({"ns": [int(one * 1e9) for one in self.took]} if times else {}),
            "right": self.right,
            "wrong": self.wrong[:5],
            "wrongs": len(self.wrong),
            "failed": self.failed[:5],
            "failures": len(self.failed),
            "p50": took[len(took) // 2],
            "p99": took[len(took) * 99 // 100],
            "longest": took[-1],
        }


def lines():
    for line in sys.stdin:
        yield json.loads(line)
