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

"""What the simulator node publishes: images, odometry, and where the vehicles truly are."""

from __future__ import annotations

from array import array
from collections import deque
import math

from geometry_msgs.msg import PointStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, Range

from flock_desk.closed_loop.real_time_flight import RenderedImage
from flock_desk.sensors.vio import Odometry as Motion
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry
from flock_follower.nodes.support.diagnostics import Rate

ODOM_FRAME, BODY_FRAME, LEADER, CAMERA_FRAME = (
    'odom', 'base_link', 'leader', 'camera_optical_frame')
MOTION_PERIOD_NS = 20_000_000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class SimulatorOutputs:
    """
    Publishes, with stamps in ns; images are kept until they have been under way for long enough.

    :param info: the camera's calibration.
    :param rate: of images sent.
    """

    def __init__(self, node: Node, info: CameraInfo, rate: Rate) -> None:
        self._info, self._rate = info, rate
        self._info.header.frame_id = CAMERA_FRAME
        self._pending: deque[tuple[int, RenderedImage]] = deque()
        self._odometry = node.create_publisher(Odometry, 'odom', 10)
        self._images = node.create_publisher(Image, 'image_raw', qos_profile_sensor_data)
        self._infos = node.create_publisher(CameraInfo, 'camera_info', qos_profile_sensor_data)
        self._ranges = node.create_publisher(Range, 'ranges', qos_profile_sensor_data)
        self._true_own = node.create_publisher(Odometry, 'truth/odom', 10)
        self._armed_at = node.create_publisher(
            PointStamped, 'mavlink_bridge/armed_at', LATCHED)
        self._true_leader = node.create_publisher(Odometry, 'truth/neighbors', 10)
        self._motion = node.create_publisher(Odometry, 'truth/motion', 10)
        self._motion_sent = 0

    def armed_below(self) -> None:
        """Publish that the vehicle was armed on the ground, at height 0 of the odometry."""
        message = PointStamped()
        message.header.frame_id = ODOM_FRAME
        self._armed_at.publish(message)

    def motion(self, stamp_ns: int, true: Motion) -> None:
        """Publish the vehicle's true motion at 50 Hz, where another simulator wants it."""
        if stamp_ns - self._motion_sent >= MOTION_PERIOD_NS and (
                self._motion.get_subscription_count()):
            self._motion_sent = stamp_ns
            self._motion.publish(_message(stamp_ns, BODY_FRAME, true))

    def odometry(self, stamp_ns: int, estimate: Motion) -> None:
        """Publish odometry."""
        self._odometry.publish(_message(stamp_ns, BODY_FRAME, estimate))

    def range(self, stamp_ns: int, distance: float) -> None:
        """Publish a measured distance to the leader, m."""
        message = Range(range=distance)
        message.header.frame_id = LEADER
        message.header.stamp = nanoseconds_to_stamp(stamp_ns)
        self._ranges.publish(message)

    def image(self, stamp_ns: int, frame: RenderedImage) -> None:
        """Publish the truth of an image, and keep the image until it is due."""
        self._true_own.publish(_message(stamp_ns, BODY_FRAME, frame.follower))
        if frame.leader is not None:
            self._true_leader.publish(_message(stamp_ns, LEADER, frame.leader))
        self._pending.append((stamp_ns, frame))

    @property
    def next_image(self) -> float:
        """Return when an image is due, s since the start; infinity without one."""
        return self._pending[0][1].due_ns * 1e-9 if self._pending else math.inf

    def send_images(self, now: float, start: float) -> None:
        """Publish the images that are due, s on the monotonic clock, ``start`` the flight's."""
        while start + self.next_image <= now:
            stamp_ns, frame = self._pending.popleft()
            height, width = frame.pixels.shape
            message = Image(height=height, width=width, encoding='mono8', step=width,
                            data=array('B', frame.pixels.tobytes()))
            message.header.frame_id = CAMERA_FRAME
            message.header.stamp = nanoseconds_to_stamp(stamp_ns)
            self._info.header.stamp = message.header.stamp
            self._infos.publish(self._info)
            self._images.publish(message)
            self._rate.tick(now)


def _message(stamp_ns: int, child: str, motion: Motion) -> Odometry:
    return to_odometry(
        nanoseconds_to_stamp(stamp_ns), ODOM_FRAME, child, motion.position, motion.quaternion,
        motion.linear, motion.angular, motion.pose_covariance, motion.twist_covariance)
