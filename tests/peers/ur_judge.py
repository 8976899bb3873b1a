"""Checks the simulator of a robot: RTDE by ur_rtde, a client of another maker; the secondary
interface by the maker's table."""

import argparse
import math
import socket
import struct
import time

import rtde_io
import rtde_receive

import lifetime


def state_of(stream):
    """Returns the next robot state message of the secondary interface: mode and position."""

    def exactly(count):
        data = b""
        while len(data) < count:
            part = stream.recv(count - len(data))
            assert part, "the robot has closed the connection"
            data += part
        return data

    while True:
        (length,) = struct.unpack("!I", exactly(4))
        body = exactly(length - 4)
        if body[0] != 16:
            continue
        found, at = {}, 1
        while at < len(body):
            size, kind = struct.unpack_from("!IB", body, at)
            part = body[at + 5 : at + size]
            if kind == 0:
                flags = struct.unpack_from("!7?", part, 8)
                mode, _, fraction = struct.unpack_from("!BBd", part, 15)
                found.update(powered=flags[2], protective=flags[4], running=flags[5], mode=mode, fraction=fraction)
            if kind == 4:
                found["place"] = struct.unpack_from("!6d", part)
            at += size
        return found


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("host")
    parser.add_argument("--secondary", type=int, default=30002)
    parser.add_argument("--limit", type=float, default=60)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    heard = rtde_receive.RTDEReceiveInterface(args.host, 125.0)
    told = rtde_io.RTDEIOInterface(args.host)
    lifetime.say(what="at first", pose=[round(part, 3) for part in heard.getActualTCPPose()], mode=heard.getRobotMode(),
                 safety=heard.getSafetyMode(), connected=heard.isConnected())
    stream = socket.create_connection((args.host, args.secondary), timeout=5)
    lifetime.say(what="secondary", **state_of(stream))

    def send(x, number):
        script = (f"def judge():\n  movel(p[{x}, 0.1, 0.4, 0, {math.pi / 2}, 0], a=1.0, v=0.25)\n"
                  f"  write_output_integer_register(12, {number})\nend\n")
        stream.sendall(script.encode())

    fastest, began = 0.0, time.monotonic()
    send(0.2, 7)
    while heard.getOutputIntRegister(12) != 7:
        fastest = max(fastest, math.hypot(*heard.getActualTCPSpeed()[:3]))
        assert time.monotonic() < began + 20
        time.sleep(0.004)
    lifetime.say(what="moved", pose=[round(part, 4) for part in heard.getActualTCPPose()], fastest=round(fastest, 3),
                 seconds=round(time.monotonic() - began, 3))

    # At half the speed the motion takes twice as long.
    told.setSpeedSlider(0.5)
    end = time.monotonic() + 5
    while abs(heard.getSpeedScaling() - 0.5) > 1e-6:
        assert time.monotonic() < end
        time.sleep(0.01)
    began = time.monotonic()
    send(0.4, 8)
    while heard.getOutputIntRegister(12) != 8:
        assert time.monotonic() < began + 20
        time.sleep(0.004)
    lifetime.say(what="moved slowly", seconds=round(time.monotonic() - began, 3))

    told.setSpeedSlider(0.0)
    while heard.getSpeedScaling() > 1e-6:
        time.sleep(0.01)
    send(0.2, 9)
    time.sleep(0.3)
    before = heard.getActualTCPPose()
    time.sleep(0.2)
    lifetime.say(what="stands", still=heard.getActualTCPPose() == before, register=heard.getOutputIntRegister(12),
                 program=heard.getRuntimeState())
    told.setSpeedSlider(1.0)
    heard.disconnect()
    told.disconnect()


main()
