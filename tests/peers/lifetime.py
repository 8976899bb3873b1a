"""Provides functions for all peers: a peer ends on SIGTERM, and by itself after a time limit."""

import json
import os
import signal
import sys
import threading


def bound(seconds):
    """Ends the process on SIGTERM and SIGINT, and unconditionally after `seconds`."""

    def leave(*_):
        sys.stdout.flush()
        os._exit(0)

    signal.signal(signal.SIGTERM, leave)
    signal.signal(signal.SIGINT, leave)
    limit(seconds)


def limit(seconds):
    """Ends the process after `seconds`; signal handlers stay as they are."""

    def too_late():
        sys.stderr.write(f"peer: its {seconds} s are over\n")
        sys.stderr.flush()
        os._exit(3)

    timer = threading.Timer(seconds, too_late)
    timer.daemon = True
    timer.start()


def say(**fields):
    """Prints one JSON object as one line of standard output, and flushes it."""
    sys.stdout.write(json.dumps(fields) + "\n")
    sys.stdout.flush()


def told():
    """Returns an event that is set when a line comes on standard input."""
    event = threading.Event()

    def read():
        if sys.stdin.readline():
            event.set()

    threading.Thread(target=read, daemon=True).start()
    return event


def values_of(arguments):
    """Returns the values to send: the values of --value, or else the lines of standard input."""
    if arguments.value:
        return [json.loads(text) for text in arguments.value]
    return [json.loads(line) for line in sys.stdin if line.strip()]
