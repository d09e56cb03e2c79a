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
The topics of the simulator node: images, odometry, and the true poses of the vehicles.

Stamps are in ns. The vehicle of another simulator node can be the leader of this one.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Sequence
import contextlib
import math

from geometry_msgs.msg import PointStamped
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, Range

from flock_desk.closed_loop.flown import ExternalLeader
from flock_desk.closed_loop.real_time_flight import RenderedImage
from flock_desk.external.external_motion import ExternalMotion, Motion
from flock_desk.sensors.vio import Odometry as TrueMotion
from flock_follower.geometry import normalize_quaternion
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import odometry
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp
from flock_follower.nodes.support.diagnostics import Rate
from flock_follower.nodes.support.runtime import FlockNode

ODOM_FRAME, BODY_FRAME, LEADER, CAMERA_FRAME = (
    'odom', 'base_link', 'leader', 'camera_optical_frame')
MOTION_PERIOD_NS = 20_000_000
SILENT_NS = 500_000_000

LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ODOMETRY, OWN_TRUTH, LEADER_TRUTH, MOTION = (
    'odom', 'truth/odom', 'truth/neighbors', 'truth/motion')
#: The vehicle of each topic of odometry, by the name of its frame.
_VEHICLES = {ODOMETRY: BODY_FRAME, OWN_TRUTH: BODY_FRAME, LEADER_TRUTH: LEADER, MOTION: BODY_FRAME}


class SimulatorOutputs:
    """
    Publishes the outputs; each image is kept until its latency is over.

    :param info: the camera's calibration.
    :param rate: of images sent.
    """

    def __init__(self, node: FlockNode, info: CameraInfo, rate: Rate) -> None:
        self._info, self._rate = info, rate
        self._info.header.frame_id = CAMERA_FRAME
        self._pending: deque[tuple[int, RenderedImage]] = deque()
        self._odometry = {topic: node.create_publisher(Odometry, topic, 10)
                          for topic in _VEHICLES}
        self._images, self._infos, self._ranges = (
            node.create_publisher(kind, topic, qos_profile_sensor_data) for kind, topic in (
                (Image, 'image_raw'), (CameraInfo, 'camera_info'), (Range, 'ranges')))
        self._armed_at = node.create_publisher(PointStamped, 'mavlink_bridge/armed_at',
                                               LATCHED_QOS)
        self._motion_sent = 0

    def armed_below(self) -> None:
        """Publish that the vehicle was armed on the ground, at height 0 of the odometry."""
        message = PointStamped()
        message.header.frame_id = ODOM_FRAME
        self._armed_at.publish(message)

    def publish_odometry(self, topic: str, stamp_ns: int, motion: TrueMotion) -> None:
        """Publish odometry, or a true motion."""
        self._odometry[topic].publish(odometry(
            make, stamp_ns, ODOM_FRAME, _VEHICLES[topic], *motion[1:]))

    def publish_motion(self, stamp_ns: int, true: TrueMotion) -> None:
        """Publish the vehicle's true motion at 50 Hz, if another simulator subscribes."""
        if stamp_ns - self._motion_sent >= MOTION_PERIOD_NS and (
                self._odometry[MOTION].get_subscription_count()):
            self._motion_sent = stamp_ns
            self.publish_odometry(MOTION, stamp_ns, true)

    def publish_range(self, stamp_ns: int, distance: float) -> None:
        """Publish a measured distance to the leader, m."""
        message = Range(range=distance)
        message.header.frame_id = LEADER
        message.header.stamp = nanoseconds_to_stamp(stamp_ns)
        self._ranges.publish(message)

    def take_image(self, stamp_ns: int, frame: RenderedImage) -> None:
        """Publish the truth of an image, and keep the image until it is due."""
        self.publish_odometry(OWN_TRUTH, stamp_ns, frame.follower)
        if frame.leader is not None:
            self.publish_odometry(LEADER_TRUTH, stamp_ns, frame.leader)
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


class VehicleAhead:
    """Receives the true motion of the vehicle of another simulator node on a topic."""

    def __init__(self, node: FlockNode, topic: str) -> None:
        self._motion = ExternalMotion()
        node.subscribe(Odometry, topic, self._take, QoSProfile(depth=10))

    def left(self, now_ns: int) -> int | None:
        """Return the time of the last motion, ns, if the vehicle is silent since, or None."""
        newest = self._motion.newest
        return newest if newest is not None and now_ns - newest > SILENT_NS else None

    def leader(self, epoch_ns: int, offset: Sequence[float]) -> ExternalLeader:
        """
        Return this vehicle as the leader of a flight that begins at ``epoch_ns`` of ROS time.

        :param offset: (3,), m, where the odom frame of that vehicle begins in ours.
        """
        return ExternalLeader(self._motion, epoch_ns, np.asarray(offset, dtype=float))

    def _take(self, message: Odometry) -> None:
        state = from_odometry(message)
        with contextlib.suppress(ValueError):  # not normalizable: no attitude
            self._motion.add(Motion(
                state.stamp, state.position, state.velocity,
                normalize_quaternion(state.quaternion), state.angular_velocity))
