"""Checks simulators of devices by their makers' tables: registers by pymodbus, process data by
plain HTTP.

Each observation is one JSON line. The codecs of the bridge are not used.
"""

import argparse
import json
import time
import urllib.error
import urllib.request

from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

import lifetime


def client_of(line):
    scheme, _, rest = line.partition(":")
    if scheme == "serial":
        path, _, baud = rest.partition("@")
        return ModbusSerialClient(path, framer=FramerType.RTU, baudrate=int(baud or 115200), timeout=2)
    host, _, port = rest.removeprefix("//").rpartition(":")
    framer = FramerType.RTU if scheme == "rtu+tcp" else FramerType.SOCKET
    return ModbusTcpClient(host, port=int(port), framer=framer, timeout=2)


def robotiq(line):
    """Reads and writes registers by chapters 4.3 to 4.5 of the 2F-85 manual: outputs from 1000,
    inputs from 2000, high byte first."""
    with client_of(line) as client:

        def status():
            words = client.read_holding_registers(2000, count=3, device_id=9).registers
            flat = [byte for word in words for byte in (word >> 8, word & 0xFF)]
            return {
                "gACT": flat[0] & 1, "gGTO": flat[0] >> 3 & 1, "gSTA": flat[0] >> 4 & 3, "gOBJ": flat[0] >> 6,
                "gFLT": flat[2] & 0x0F, "gPR": flat[3], "gPO": flat[4],
            }

        def write(action, position=0, speed=0, force=0):
            words = [action << 8, position, speed << 8 | force]
            answer = client.write_registers(1000, words, device_id=9)
            assert not answer.isError(), answer

        def until(what, is_so):
            end = time.monotonic() + 10
            while not is_so(now := status()):
                assert time.monotonic() < end, (what, now)
                time.sleep(0.01)
            lifetime.say(what=what, **now)

        write(0)
        until("reset", lambda now: now["gSTA"] == 0)
        write(0x09, 255, 255, 0)
        lifetime.say(what="told to go too early", **status())
        write(0)
        write(1)
        until("activated", lambda now: now["gSTA"] == 3)
        write(0x09, 255, 255, 128)
        moving = status()
        lifetime.say(what="moving", **moving)
        until("closed", lambda now: now["gOBJ"] != 0)
        write(0x09, 0, 255, 128)
        until("opened", lambda now: now["gOBJ"] != 0 and now["gPO"] < 10)
        lifetime.say(what="exceptions", **{
            "register 3000": client.read_holding_registers(3000, count=1, device_id=9).exception_code,
            "coil": client.read_coils(0, count=1, device_id=9).exception_code,
            "write 2000": client.write_registers(2000, [1], device_id=9).exception_code,
        })
        both = client.readwrite_registers(
            read_address=2000, read_count=1, write_address=1000, values=[0x0100], device_id=9)
        lifetime.say(what="read and written", status=both.registers[0] >> 8)


def converter(line):
    with client_of(line) as client:
        end = time.monotonic() + 10
        while (millivolts := client.read_input_registers(0, count=1, device_id=1).registers[0]) == 0:
            assert time.monotonic() < end
            time.sleep(0.05)
        # The voltage is measured behind a divider of 10k and 1.5k.
        lifetime.say(what="volts", volts=round(millivolts / 1000 * 11.5 / 1.5, 1))


def schmalz(url):
    """Uses the IO-Link JSON interface: 4 bytes of process data in, 2 bytes out."""
    base = f"{url}/iolink/v1/devices/master1port1"

    def ask(path, body=None):
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(path, data=data, headers={"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=2) as answer:
                text = answer.read()
                return answer.status, json.loads(text) if text else None
        except urllib.error.HTTPError as error:
            return error.code, json.loads(error.read())

    def status():
        flags, _, high, low = ask(f"{base}/processdata/getdata/value?format=byteArray")[1]["ioLink"]["value"]
        return {"present": flags & 1, "in_range": flags >> 1 & 1, "detached": flags >> 5 & 1, "mbar": high << 8 | low}

    def out(flags):
        return ask(f"{base}/processdata/value", {"ioLink": {"valid": True, "value": [flags, 0]}})[0]

    def until(what, is_so):
        end = time.monotonic() + 10
        while not is_so(now := status()):
            assert time.monotonic() < end, (what, now)
            time.sleep(0.01)
        lifetime.say(what=what, **now)

    lifetime.say(what="at first", **status())
    lifetime.say(what="vacuum", code=out(1))
    until("held", lambda now: now["present"])
    out(2)
    until("let go", lambda now: not now["present"])
    lifetime.say(what="wrong", code=ask(f"{base}/processdata/value", {"value": 1})[0])
    lifetime.say(what="elsewhere", code=ask(f"{url}/iolink/v1/devices/nobody/processdata/getdata/value")[0])


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("device", choices=["robotiq", "converter", "schmalz"])
    parser.add_argument("at")
    parser.add_argument("--limit", type=float, default=60)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    {"robotiq": robotiq, "converter": converter, "schmalz": schmalz}[args.device](args.at)


main()
