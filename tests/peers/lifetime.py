"""What every peer shares: it ends on SIGTERM, and by itself when nobody ends it."""

import json
import os
import signal
import sys
import threading


def bound(seconds):
    """Ends the process on SIGTERM and SIGINT, and after `seconds` whatever it is doing."""

    def leave(*_):
        sys.stdout.flush()
        os._exit(0)

    signal.signal(signal.SIGTERM, leave)
    signal.signal(signal.SIGINT, leave)
    limit(seconds)


def limit(seconds):
    """Ends the process after `seconds`; signals stay as they are."""

    def too_late():
        sys.stderr.write(f"peer: its {seconds} s are over\n")
        sys.stderr.flush()
        os._exit(3)

    timer = threading.Timer(seconds, too_late)
    timer.daemon = True
    timer.start()


def say(**fields):
    """One JSON object on one line of standard output, at once."""
    sys.stdout.write(json.dumps(fields) + "\n")
    sys.stdout.flush()


def told():
    """An event that is set when a line comes on standard input."""
    event = threading.Event()

    def read():
        if sys.stdin.readline():
            event.set()

    threading.Thread(target=read, daemon=True).start()
    return event


def values_of(arguments):
    """The values to send: those of --value, or else the lines of standard input."""
    if arguments.value:
        return [json.loads(text) for text in arguments.value]
    return [json.loads(line) for line in sys.stdin if line.strip()]
