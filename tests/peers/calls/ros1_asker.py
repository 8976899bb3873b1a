"""Runs a rospy client with orders on standard input, such as {"case": "bundled", "service": "/s",
"first": 0, "count": 10, "at_once": 4}."""

import argparse
import sys
import threading
import time
from pathlib import Path

import rospy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import lifetime
from calls import ros1_services
from calls.cases import CASES
from calls.counting import Asked, lines


def ask(order):
    kind = CASES[order["case"]]
    made = ros1_services.service_class(kind.type)
    try:
        rospy.wait_for_service(order["service"], timeout=order.get("wait", 20))
    except rospy.ROSException:
        return {"absent": True}
    asked = Asked()
    numbers = iter(range(order.get("first", 0), order.get("first", 0) + order.get("count", 1)))
    lock = threading.Lock()

    def run():
        proxy = rospy.ServiceProxy(order["service"], made, persistent=order.get("persistent", False))
        while True:
            with lock:
                number = next(numbers, None)
            if number is None:
                return
            request = made._request_class()
            kind.ask(request, number)
            start = time.monotonic()
            try:
                response = proxy(request)
            except (rospy.ServiceException, rospy.exceptions.TransportException) as error:
                asked.refused(str(error))
            else:
                asked.answered(kind.right(response, number), str(response), time.monotonic() - start)

    threads = [threading.Thread(target=run) for _ in range(order.get("at_once", 1))]
    start = time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return {**asked.told(order.get("times")), "seconds": time.monotonic() - start}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    rospy.init_node("asker", disable_rosout=True, disable_signals=True)
    lifetime.bound(args.limit)
    lifetime.say(ready="asker")
    for order in lines():
        lifetime.say(id=order.get("id"), answer=ask(order))


main()
