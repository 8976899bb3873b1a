"""The bridge of a ROS 2 domain.

ros2 launch ua_bridge bridge.launch.py mapping:=/etc/ua-bridge/cell.yaml interface:=eth0
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration


def generate_launch_description():
    """Return the arguments and the process of the bridge."""
    arguments = [
        DeclareLaunchArgument(
            "mapping",
            default_value="/etc/ua-bridge/cell.yaml",
            description="The mapping of the cell",
        ),
        DeclareLaunchArgument(
            "interface",
            default_value="",
            description="The network interface of the PubSub group, by name or address",
        ),
        DeclareLaunchArgument(
            "metrics",
            default_value="127.0.0.1:9102",
            description="The address of counters and status",
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=bridge)])


def bridge(context):
    """Return the process of the bridge with the values of the arguments."""

    def value(name):
        return LaunchConfiguration(name).perform(context)

    command = ["bridge-ros2", "--metrics", value("metrics"), value("mapping")]
    if value("interface"):
        command += ["--interface", value("interface")]
    return [
        ExecuteProcess(
            cmd=command,
            name="bridge-ros2",
            output="screen",
            respawn=True,
            respawn_delay=1.0,
        )
    ]
