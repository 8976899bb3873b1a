"""Calls by `ua-space call`, whose path is an argument: the orders of ros1_asker.py, with a topic or
the name of a call as `service`."""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
from calls.cases import CASES
from calls.counting import Asked, lines


def ask(program, order):
    kind = CASES[order["case"]]
    asked = Asked()
    first = order.get("first", 0)
    for number in range(first, first + order.get("count", 1)):
        request = SimpleNamespace(**kind.takes)
        kind.ask(request, number)
        given = [f"{name}={value if isinstance(value, str) else json.dumps(value)}" for name, value in vars(request).items()]
        times = ["--wait", str(order.get("wait", 20)), "--timeout", str(order.get("patience", 40))]
        start = time.monotonic()
        command = [program, "call", order["service"], *given, "--json", "--no-wait", "--interface", "lo", *times]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if not ended.stdout:
            asked.refused(ended.stderr)
            continue
        fields = json.loads(ended.stdout.splitlines()[0], object_hook=lambda some: SimpleNamespace(**some)).fields
        asked.answered(kind.right(fields, number), str(fields), time.monotonic() - start)
    return asked.told()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("program")
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    lifetime.say(ready="asker")
    for order in lines():
        lifetime.say(id=order.get("id"), answer=ask(args.program, order))


main()
