"""Simulates a TurtleBot3: the topics of turtlebot3_node and of its lidar, with their types, rates
and QoS.

Every velocity that it receives is one JSON line on standard output.
"""

import argparse
import itertools
import math
import time
from dataclasses import dataclass, field

from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, float32, float64, sequence, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import lifetime
import ros2_types
from ros2_types import Header, JointState, Time


@dataclass
@final
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
@final
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
@final
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
@final
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
@final
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
@final
class TwistStamped(IdlStruct, typename="geometry_msgs.msg.dds_.TwistStamped_"):
    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
@final
class PoseWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    pose: Pose = field(default_factory=Pose)
    covariance: array[float64, 36] = field(default_factory=lambda: [0.0] * 36)


@dataclass
@final
class TwistWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovariance_"):
    twist: Twist = field(default_factory=Twist)
    covariance: array[float64, 36] = field(default_factory=lambda: [0.0] * 36)


@dataclass
@final
class Odometry(IdlStruct, typename="nav_msgs.msg.dds_.Odometry_"):
    header: Header = field(default_factory=Header)
    child_frame_id: str = "base_footprint"
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass
@final
class Imu(IdlStruct, typename="sensor_msgs.msg.dds_.Imu_"):
    header: Header = field(default_factory=Header)
    orientation: Quaternion = field(default_factory=Quaternion)
    orientation_covariance: array[float64, 9] = field(default_factory=lambda: [0.0] * 9)
    angular_velocity: Vector3 = field(default_factory=Vector3)
    angular_velocity_covariance: array[float64, 9] = field(default_factory=lambda: [0.0] * 9)
    linear_acceleration: Vector3 = field(default_factory=Vector3)
    linear_acceleration_covariance: array[float64, 9] = field(default_factory=lambda: [0.0] * 9)


@dataclass
@final
class BatteryState(IdlStruct, typename="sensor_msgs.msg.dds_.BatteryState_"):
    header: Header = field(default_factory=Header)
    voltage: float32 = 0.0
    temperature: float32 = math.nan
    current: float32 = math.nan
    charge: float32 = math.nan
    capacity: float32 = math.nan
    design_capacity: float32 = 1.8
    percentage: float32 = 0.0
    power_supply_status: uint8 = 0
    power_supply_health: uint8 = 0
    power_supply_technology: uint8 = 2
    present: bool = True
    cell_voltage: sequence[float32] = field(default_factory=list)
    cell_temperature: sequence[float32] = field(default_factory=list)
    location: str = ""
    serial_number: str = ""


@dataclass
@final
class LaserScan(IdlStruct, typename="sensor_msgs.msg.dds_.LaserScan_"):
    header: Header = field(default_factory=Header)
    angle_min: float32 = 0.0
    angle_max: float32 = 6.25
    angle_increment: float32 = 0.0174
    time_increment: float32 = 0.0
    scan_time: float32 = 0.2
    range_min: float32 = 0.12
    range_max: float32 = 3.5
    ranges: sequence[float32] = field(default_factory=list)
    intensities: sequence[float32] = field(default_factory=list)


class TurtleBot3:
    def __init__(self, domain, stamped):
        self.participant = DomainParticipant(domain)
        self.odom = self.writer("/odom", Odometry)
        self.joint_states = self.writer("/joint_states", JointState)
        self.imu = self.writer("/imu", Imu)
        self.battery_state = self.writer("/battery_state", BatteryState)
        # Sensor data is published best effort: lost samples are not repeated.
        self.scan = self.writer("/scan", LaserScan, Policy.Reliability.BestEffort)
        kind = TwistStamped if stamped else Twist
        topic = Topic(self.participant, "rt/cmd_vel", kind, qos=self.qos())
        self.cmd_vel = DataReader(self.participant, topic, qos=self.qos())
        self.news = WaitSet(self.participant)
        any_new = SampleState.NotRead | ViewState.Any | InstanceState.Any
        self.condition = ReadCondition(self.cmd_vel, any_new)
        self.news.attach(self.condition)

    @staticmethod
    def qos(reliability=None):
        return Qos(
            reliability or Policy.Reliability.Reliable(duration(seconds=10)),
            Policy.Durability.Volatile,
            Policy.History.KeepLast(10),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )

    def writer(self, name, kind, reliability=None):
        qos = self.qos(reliability)
        return DataWriter(self.participant, Topic(self.participant, "rt" + name, kind, qos=qos), qos=qos)

    def tick(self, turn):
        now = time.time()
        header = Header(Time(int(now), int(now % 1 * 1e9)), "odom")
        pose = Pose(Point(1.5, -0.25, 0.0))
        twist = Twist(Vector3(0.125), Vector3(z=-0.5))
        self.odom.write(Odometry(header, pose=PoseWithCovariance(pose), twist=TwistWithCovariance(twist)))
        names = ["wheel_left_joint", "wheel_right_joint"]
        self.joint_states.write(JointState(header, names, [0.5, 0.75], [1.0, 1.0], []))
        self.imu.write(Imu(header, linear_acceleration=Vector3(z=9.75)))
        self.battery_state.write(BatteryState(header, voltage=12.25, percentage=0.5))
        if turn % 4 == 0:
            self.scan.write(LaserScan(header, ranges=[n / 256 for n in range(360)], intensities=[0.0] * 360))

    def told(self, until):
        while (rest := until - time.monotonic()) > 0:
            self.news.wait(duration(milliseconds=max(1, int(rest * 1000))))
            for sample in self.cmd_vel.take(N=10):
                if sample.sample_info.valid_data:
                    lifetime.say(cmd_vel=ros2_types.plain(sample))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--domain", type=int, default=30)
    parser.add_argument("--plain", action="store_true", help="velocities without header, as on Humble")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    robot = TurtleBot3(args.domain, not args.plain)
    lifetime.say(ready="turtlebot3")
    start = time.monotonic()
    for turn in itertools.count():
        robot.tick(turn)
        robot.told(start + (turn + 1) * 0.05)


main()
