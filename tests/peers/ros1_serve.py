"""Runs a rospy server of std_srvs/SetBool: true succeeds, false raises. It prints one JSON line per
request."""

import argparse

import rospy
from std_srvs.srv import SetBool, SetBoolResponse

import lifetime


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("service")
    parser.add_argument("--node", default="rospy_server")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.limit(args.limit)

    def handle(request):
        header = request._connection_header
        lifetime.say(
            value=request.data,
            callerid=header.get("callerid"),
            persistent=header.get("persistent") == "1",
        )
        if not request.data:
            raise ValueError("the valve is stuck")
        return SetBoolResponse(True, "done")

    rospy.init_node(args.node, disable_rosout=True)
    service = rospy.Service(args.service, SetBool, handle)
    lifetime.say(ready=args.service)
    rospy.spin()
    service.shutdown()


main()
