"""Measures `ua-space page` with many topics at 10 Hz: how soon Chromium shows a view, what the server sends,
and how evenly Chromium draws it; then the memory of the server with browsers that never read. Runs in a network
of its own, in which it sets up loopback. Prints tables of Markdown."""

import argparse
import json
import os
import pathlib
import socket
import struct
import subprocess
import sys
import time
import urllib.request

from selenium import webdriver
from selenium.webdriver.support.ui import WebDriverWait

SOON = 60
TURNS = 5
PAGE = ("127.0.0.1", 8090)
GROUP = ("239.192.0.40", 4840)
TICKS = os.sysconf("SC_CLK_TCK")
# Counts the bytes of events and records the times of frames. It runs before the scripts of the page.
PROBE = """
const measured = { bytes: 0, events: 0, frames: [], first: null };
window.measured = measured;
const Plain = window.EventSource;
window.EventSource = class extends Plain {
  constructor(url) {
    super(url);
    for (const kind of ["view", "alive"]) {
      this.addEventListener(kind, (event) => { measured.bytes += event.data.length; measured.events += 1; });
    }
  }
};
const drawn = (time) => {
  measured.frames.push(time);
  if (measured.first === null && measured.events > 0 && document.querySelector("main h1")) {
    measured.first = performance.now();
  }
  requestAnimationFrame(drawn);
};
requestAnimationFrame(drawn);
"""
# Scrolls at the speed of a hand, up and down.
SCROLL = """
const began = performance.now();
const step = (time) => {
  const part = ((time - began) / 4000) % 2;
  window.scrollTo(0, (part < 1 ? part : 2 - part) * Math.min(12000, document.documentElement.scrollHeight));
  window.scrolling = requestAnimationFrame(step);
};
window.scrolling = requestAnimationFrame(step);
"""


def cpu_seconds(pid):
    """Returns the processor time of a process so far; 0 if it has ended."""
    try:
        fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / TICKS


def family(pid):
    """Returns a process and all its descendants."""
    parents = {}
    for entry in pathlib.Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
    found = {pid}
    while True:
        more = {child for child, parent in parents.items() if parent in found} - found
        if not more:
            return found
        found |= more


def shown(driver, url, view):
    """Loads a view, and returns the times of its document and of its first data in ms."""
    driver.get("about:blank")
    driver.get(f"{url}#/{view}")
    WebDriverWait(driver, SOON, 0.05).until(lambda _: driver.execute_script("return measured.first"))
    return driver.execute_script(
        "const page = performance.getEntriesByType('navigation')[0];"
        "return [page.loadEventEnd, measured.first]")


def measure(driver, server, seconds):
    """Returns the figures of the shown view."""
    browser = family(driver.service.process.pid)
    start = lambda: (time.monotonic(), cpu_seconds(server), {pid: cpu_seconds(pid) for pid in browser})
    driver.execute_script("measured.frames.length = 0; measured.bytes = 0; measured.events = 0")
    began, of_server, of_browser = start()
    time.sleep(seconds)
    bytes_, events, frames = driver.execute_script("return [measured.bytes, measured.events, measured.frames]")
    ended, server_end, browser_end = start()
    took = ended - began
    gaps = [after - before for before, after in zip(frames, frames[1:])]
    return {
        "events_per_s": events / took,
        "kb_per_s": bytes_ / took / 1000,
        "server_cpu": (server_end - of_server) / took,
        "browser_cpu": sum(max(0.0, browser_end[pid] - of_browser[pid]) for pid in browser) / took,
        "frames": len(gaps),
        "frames_per_s": len(gaps) / took,
        "late_frames": sum(gap > 50 for gap in gaps),
        "longest_ms": max(gaps, default=float("nan")),
    }


def send(topics, rate):
    """Sends each topic at a rate in Hz, in slices of at least 5 ms, until it is ended."""
    group = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    group.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
    # A NetworkMessage of ROS 1 (PublisherId 1, WriterGroupId 2) with one key frame of one Variant, a Double.
    head = [struct.pack("<BBHBHBHBHB", 0xF1, 1, 1, 1, 2, 1, topic, 1, 1, 11) for topic in range(1, topics + 1)]
    due, value = time.monotonic(), 0.0
    parts = max(1, 200 // rate)
    rounds = max(1, rate // 200)
    while True:
        for part in range(parts):
            for _ in range(rounds):
                value += 0.25
                for topic in range(part, topics, parts):
                    group.sendto(head[topic] + struct.pack("<d", value + topic), GROUP)
            due += 0.005
            late = time.monotonic() - due
            if late < 0:
                time.sleep(-late)
            elif late > 0.1:
                # A sender that is late does not catch up by a burst.
                due += late


def delivered():
    """Returns the number of values that the server has taken."""
    status = urllib.request.urlopen(f"http://{PAGE[0]}:{PAGE[1]}/status", timeout=SOON).read()
    return sum(topic["delivered"] for topic in json.loads(status)["topics"].values())


def resident(pid):
    """Returns the memory of a process in MB."""
    lines = pathlib.Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1000


def never_read(server, seconds):
    """Prints the memory of the server with browsers that open streams and never read."""
    print("\n100 browsers of 40 values that never read:\n\n| time | memory of the server | CPU of the server |\n|---|---|---|")

    def row(name, wait):
        began, before = time.monotonic(), cpu_seconds(server)
        time.sleep(wait)
        share = (cpu_seconds(server) - before) / (time.monotonic() - began)
        print(f"| {name} | {resident(server):.1f} MB | {share:.0%} |".replace("%", " %"), flush=True)

    row("before", seconds)
    idle = []
    for number in range(100):
        # The page admits 64 browsers of one address.
        browser = socket.create_connection(PAGE, source_address=(["127.0.0.1", "127.0.0.2"][number % 2], 0))
        browser.sendall(b"GET /events?view=values&count=40 HTTP/1.1\r\nhost: %s:%d\r\n\r\n" % (PAGE[0].encode(), PAGE[1]))
        idle.append(browser)
    for times in [1, 2, 3]:
        row(f"after {sum(range(times + 1)) * seconds:.0f} s", times * seconds)
    for browser in idle:
        browser.close()
    row("after they left", seconds)


def traced(binaries, server, seconds):
    """Prints the processor time of the server for each value, without a trace and with traces, in turns."""
    program = [binaries / "ua-space", "trace"]
    usual = ["--interface", "lo", "--seconds", "3600", "--metrics", f"http://{PAGE[0]}:{PAGE[1]}"]
    kinds = {"none": None, "`ua-space trace`, all values": [*program, *usual],
             "`ua-space trace ua_1_2_5`, one topic of 10": [*program, "ua_1_2_5", *usual]}
    each = {name: [] for name in kinds}
    for turn in range(TURNS):
        # Another order in each turn, so that a slower minute of the machine affects all.
        names = list(kinds)
        for name in names[turn % 3:] + names[:turn % 3]:
            trace = kinds[name] and subprocess.Popen(kinds[name], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            time.sleep(2)
            values, used = delivered(), scheduled(server)
            time.sleep(seconds)
            each[name].append((scheduled(server) - used) / (delivered() - values) * 1e6)
            if trace:
                trace.terminate()
                trace.wait(20)
    print(f"| trace | CPU per value, {TURNS} turns | median | ratio |\n|---|---|---|---|")
    usual = sorted(each["none"])[TURNS // 2]
    for name, turns in each.items():
        median = sorted(turns)[TURNS // 2]
        print(f"| {name} | {', '.join(f'{one:.2f}' for one in turns)} us | {median:.2f} us | {median / usual:.3f} |")


def scheduled(pid):
    """Returns the processor time of a process by the scheduler's count, in seconds."""
    threads = pathlib.Path(f"/proc/{pid}/task").iterdir()
    return sum(int((thread / "schedstat").read_text().split()[0]) for thread in threads) / 1e9


def browse(server, seconds):
    """Prints a row for each view that Chromium shows."""
    options = webdriver.ChromeOptions()
    for argument in ["--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1280,800"]:
        options.add_argument(argument)
    options.binary_location = "/usr/bin/chromium"
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService("/usr/bin/chromedriver"))
    url = f"http://{PAGE[0]}:{PAGE[1]}/"
    print("| view | page loaded | first values | events | from the server | CPU of the server | CPU of Chromium | frames per second "
          "| later than 50 ms | longest frame |\n|---|---|---|---|---|---|---|---|---|---|")

    def row(name, times, one):
        loaded, first = (f"{time:.0f} ms" if time else "-" for time in times)
        cells = [name, loaded, first, f"{one['events_per_s']:.1f} /s", f"{one['kb_per_s']:.1f} kB/s",
                 f"{one['server_cpu'] * 100:.0f} %", f"{one['browser_cpu'] * 100:.0f} %", f"{one['frames_per_s']:.1f}",
                 f"{one['late_frames']} of {one['frames']}", f"{one['longest_ms']:.0f} ms"]
        print(f"| {' | '.join(cells)} |", flush=True)

    try:
        driver.set_page_load_timeout(SOON)
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": PROBE})
        # The first load starts the processes of Chromium. An empty page shows what the machine can draw.
        shown(driver, url, "values")
        driver.get("about:blank")
        time.sleep(1)
        row("none, an empty page", (None, None), measure(driver, server, seconds))
        views = [("values", "values", False), ("values, while scrolling", "values", True), ("a topic", "topic/ua_1_2_5", False),
                 ("map", "map", False), ("programs", "programs", False)]
        for name, view, scrolls in views:
            times = shown(driver, url, view)
            if scrolls:
                driver.execute_script(SCROLL)
            time.sleep(1)
            row(name, times, measure(driver, server, seconds))
    finally:
        driver.quit()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binaries", type=pathlib.Path, required=True, help="the folder of ua-space")
    parser.add_argument("--topics", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=10, help="how long each view is measured")
    parser.add_argument("--trace", action="store_true", help="measure traces instead, with 10 topics at 1 kHz")
    parser.add_argument("--send", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.send:
        send(10 if arguments.trace else arguments.topics, 1000 if arguments.trace else 10)
    for command in ["link set lo up multicast on", "route replace 224.0.0.0/4 dev lo"]:
        subprocess.run(["ip", *command.split()], check=True)
    running = [subprocess.Popen([arguments.binaries / "ua-space", "page", "--interface", "lo"],
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)]
    try:
        running.append(subprocess.Popen([sys.executable, __file__, *sys.argv[1:], "--send"]))
        server = running[0].pid
        time.sleep(5)
        if arguments.trace:
            return traced(arguments.binaries, server, arguments.seconds)
        began, before, used = time.monotonic(), delivered(), cpu_seconds(server)
        time.sleep(arguments.seconds)
        took = time.monotonic() - began
        print(f"{arguments.topics} topics of one Double, {(delivered() - before) / took:.0f} values a second. Without a browser the server "
              f"takes {(cpu_seconds(server) - used) / took * 100:.0f} % of a core and {resident(server):.0f} MB.\n", flush=True)
        browse(server, arguments.seconds)
        never_read(server, arguments.seconds)
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(20)


if __name__ == "__main__":
    main()
