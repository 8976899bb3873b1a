"""A device with an HTTP interface for own-device.yaml: a gripper that closes within a second.

POST /grasp and /release start the work, POST /stop stops it, and GET /state shows its state.
"""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

LOCK = threading.Lock()
# The state of the newest work: its number, its name, its start and its end.
WORK = {"number": 0, "name": "", "began": 0.0, "stopped": False}


def state():
    with LOCK:
        passed = min(time.monotonic() - WORK["began"], 1.0)
        if WORK["number"] == 0:
            return {"state": "idle"}
        if WORK["stopped"]:
            return {"state": "aborted", "message": "stopped"}
        done = {"progress": passed, "step": WORK["name"], "gripped": WORK["name"] == "grasp", "heat": 21.5 + passed}
        return {"state": "done" if passed >= 1.0 else "running", **done}


class Device(BaseHTTPRequestHandler):
    def answer(self, status, message):
        body = json.dumps(message).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def do_GET(self):
        self.answer(200, state())

    def do_POST(self):
        length = int(self.headers.get("Content-Length", 0))
        body = json.loads(self.rfile.read(length) or b"{}")
        name = self.path.strip("/")
        if name == "stop":
            with LOCK:
                WORK["stopped"] = True
            self.answer(200, {})
        elif state()["state"] == "running":
            self.answer(409, {"message": "busy"})
        else:
            with LOCK:
                WORK.update(number=WORK["number"] + 1, name=name, began=time.monotonic(), stopped=False)
            print(name, body, flush=True)
            self.answer(202, {})

    def log_message(self, *_arguments):
        """Prints nothing for the requests of polling."""


ThreadingHTTPServer(("127.0.0.1", 8080), Device).serve_forever()
