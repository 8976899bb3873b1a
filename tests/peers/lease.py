"""Holds a lease on a file: an open of the file waits in the kernel until a line comes on standard
input. Reports the first open. The kernel ends a lease by itself after 45 s
(/proc/sys/fs/lease-break-time)."""

import argparse
import fcntl
import os
import signal
import threading

import lifetime


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("file")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    waits = threading.Event()
    signal.signal(signal.SIGIO, lambda *_: waits.set())
    held = os.open(args.file, os.O_RDONLY)
    fcntl.fcntl(held, fcntl.F_SETLEASE, fcntl.F_WRLCK)
    told = lifetime.told()
    lifetime.say(ready=args.file)
    waits.wait()
    lifetime.say(waits=args.file)
    told.wait()
    fcntl.fcntl(held, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    lifetime.say(released=args.file)
    threading.Event().wait()


main()
