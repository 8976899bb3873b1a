"""Drives a gripper for own-gripper.yaml: reads a start, reports progress and the result.

The gripper is simulated: it closes within a second.
"""

import json
import select
import sys
import time


def say(**message):
    print(json.dumps(message), flush=True)


def main():
    action = sys.argv[1]
    if action == "stop":
        # The place for the command that stops the machine, whatever it does.
        return
    start = json.loads(sys.stdin.readline())["start"]
    force = start["parameters"].get("Force", 0.0)
    say(step="Close" if action == "grasp" else "Open", note=f"force {force} N")
    for tenth in range(1, 11):
        # A line on standard input is {"halt": ...}; the end of the input means the same.
        if select.select([sys.stdin], [], [], 0)[0]:
            say(failed=f"halted at {tenth * 10} %")
            return
        time.sleep(0.1)
        say(progress=tenth / 10)
    say(result={"Gripped": True} if action == "grasp" else {})


main()
