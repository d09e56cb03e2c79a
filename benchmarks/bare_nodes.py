# Copyright 2026 The flock_follower developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Three rclpy nodes that only pass messages, for ``stack.py``, and odometry twice as often.

Each subscribes to the topics of the node of its name, with ordinary callbacks, and publishes the
same messages under ``bare/``, at the same rate and size. They compute nothing, check nothing, and
send no MAVLink. The three are a separate chain beside the real nodes.

A fourth node is not measured. The simulator publishes odometry at 100 Hz, ``OftenOdometry`` at
200 Hz: each message as it comes, and its prediction 5 ms later.
"""

from __future__ import annotations

from collections.abc import Callable
import sys
import time
from typing import Any

from geometry_msgs.msg import AccelWithCovarianceStamped, Transform, Twist
from nav_msgs.msg import Odometry
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header, String
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from flock_follower.geometry import (
    quaternion_multiply,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from flock_follower.messages import (
    set_quaternion,
    set_vector,
    stamp_to_nanoseconds,
    to_array,
)
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
FEW = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
TICK = 0.1  # s, of the planner
STATE = 0.5  # s between two words on the state of the bridge
HALF = 0.005  # s: half a period of the simulated odometry
EVERY = 4  # of 200 odometries a second, so many for one on mavlink/odom: 50 Hz


def nothing(_: Any) -> None:
    """Take a message."""


class BareRelativePose(Node):
    """Takes images, calibrations and odometry; publishes three messages for each image."""

    def __init__(self) -> None:
        super().__init__('bare_relative_pose')
        self.create_subscription(Image, 'image_raw', self._take_image, NEWEST)
        self.create_subscription(CameraInfo, 'camera_info', nothing, NEWEST)
        self.create_subscription(Odometry, 'odom', nothing, FEW)
        self._neighbors = self.create_publisher(Odometry, 'bare/neighbors', 10)
        self._accelerations = self.create_publisher(
            AccelWithCovarianceStamped, 'bare/neighbors/acceleration', 10)
        self._frames = self.create_publisher(Header, 'bare/neighbors/frames', 1)

    def _take_image(self, message: Image) -> None:
        self._accelerations.publish(AccelWithCovarianceStamped(header=message.header))
        self._neighbors.publish(Odometry(header=message.header, child_frame_id='leader'))
        self._frames.publish(message.header)


class BarePlanner(Node):
    """Takes odometry and what the one before publishes; publishes a command at 10 Hz."""

    def __init__(self) -> None:
        super().__init__('bare_planner')
        self.create_subscription(Odometry, 'odom', nothing, FEW)
        self.create_subscription(CameraInfo, 'camera_info', nothing, NEWEST)
        self.create_subscription(Odometry, 'bare/neighbors', nothing, FEW)
        self.create_subscription(
            AccelWithCovarianceStamped, 'bare/neighbors/acceleration', nothing, FEW)
        self.create_subscription(Header, 'bare/neighbors/frames', nothing, NEWEST)
        self.create_subscription(String, 'bare/mavlink_bridge/state', nothing, 1)
        self._commands = self.create_publisher(
            MultiDOFJointTrajectory, 'bare/command/trajectory', 1)
        self.create_timer(TICK, self._tick)

    def _tick(self) -> None:
        self._commands.publish(MultiDOFJointTrajectory(
            joint_names=['base_link'], points=[MultiDOFJointTrajectoryPoint(
                transforms=[Transform()], velocities=[Twist()], accelerations=[Twist()])]))


class BareBridge(Node):
    """Takes odometry and commands; publishes odometry at 50 Hz, and its state."""

    def __init__(self) -> None:
        super().__init__('bare_mavlink_bridge')
        self._count = 0
        self.create_subscription(Odometry, 'odom', self._take_odom, NEWEST)
        self.create_subscription(
            MultiDOFJointTrajectory, 'bare/command/trajectory', nothing, NEWEST)
        self._odometry = self.create_publisher(Odometry, 'bare/mavlink/odom', 10)
        self._states = self.create_publisher(String, 'bare/mavlink_bridge/state', 1)
        self.create_timer(STATE, self._publish_state)

    def _take_odom(self, message: Odometry) -> None:
        self._count += 1
        if self._count % EVERY == 0:
            self._odometry.publish(message)

    def _publish_state(self) -> None:
        self._states.publish(String(data='ACTIVE'))


class OftenOdometry(Node):
    """Publishes each odometry, and half a period later where it leads."""

    def __init__(self) -> None:
        super().__init__('often_odometry')
        self.create_subscription(Odometry, 'simulated/odom', self._take, 10)
        self._odometry = self.create_publisher(Odometry, 'odom', 10)

    def _take(self, message: Odometry) -> None:
        later = time.monotonic() + HALF
        self._odometry.publish(message)
        pose, twist = message.pose.pose, message.twist.twist
        q = pose.orientation
        attitude = [q.x, q.y, q.z, q.w]
        moved = HALF * quaternion_to_matrix(attitude) @ to_array(twist.linear)
        set_vector(pose.position, to_array(pose.position) + moved)
        set_quaternion(pose.orientation, quaternion_multiply(
            attitude, rotation_vector_to_quaternion(HALF * to_array(twist.angular))))
        message.header.stamp = nanoseconds_to_stamp(
            stamp_to_nanoseconds(message.header.stamp) + round(HALF * 1e9))
        time.sleep(max(0.0, later - time.monotonic()))
        self._odometry.publish(message)


NODES: dict[str, Callable[[], Node]] = {
    'relative_pose': BareRelativePose, 'planner': BarePlanner, 'mavlink_bridge': BareBridge,
    'often_odometry': OftenOdometry}


def main() -> None:
    """Run one of them until it is stopped."""
    try:
        rclpy.init()
        rclpy.spin(NODES[sys.argv[1]]())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
