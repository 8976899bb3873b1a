"""A ROS 2 node for own-node.yaml: a gripper with the service /close, of std_srvs/Trigger."""

import rclpy
from rclpy.executors import ExternalShutdownException
from std_srvs.srv import Trigger


def close(_request, response):
    print("closes", flush=True)
    response.success = True
    response.message = "closed"
    return response


def main():
    rclpy.init()
    node = rclpy.create_node("own_gripper")
    node.create_service(Trigger, "close", close)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


main()
