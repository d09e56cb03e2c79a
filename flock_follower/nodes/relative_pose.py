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
The perception node: images and one's own odometry in, the neighbours' states out.

Subscribes ``image_raw`` (or ``image_raw/compressed``), ``camera_info`` and ``odom``; publishes
one ``neighbors`` message per neighbour measured in an image, stamped like the image. The
mathematics is in ``flock_follower.perception``.
"""

from __future__ import annotations

from collections import deque
import sys
import time
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from flock_follower.nodes.conversions import (
    from_odometry,
    NANOSECONDS,
    ODOM_TWIST_FRAME,
    stamp_to_nanoseconds,
    to_odometry,
)
from flock_follower.nodes.diagnostics import ERROR, Problem, WARN
from flock_follower.nodes.parameters import Spec
from flock_follower.nodes.runtime import FlockNode, run
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import decode, decode_compressed, GrayImage
from flock_follower.perception.neighbor_filter import Estimate, FilterParams
from flock_follower.perception.neighbors import load
from flock_follower.perception.odometry import Missing, OdometryParams, OdometrySample
from flock_follower.perception.tracker import camera_mounting, Tracker
from flock_follower.resources import resource

# Best effort takes what reliable and best-effort publishers send alike.
IMAGE_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
# A frame's processing must not lose odometry: 50 messages are 0.25 s at 200 Hz.
ODOM_QOS = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
NEIGHBORS_QOS = QoSProfile(depth=10)

MAX_PENDING = 4  # images waiting for odometry; more means it lags too far behind
UNSEEN_TIMEOUT = 2.0  # s without a neighbour, or without an image processed, that is reported
FILTER, ODOMETRY = FilterParams(), OdometryParams()

SPECS = [
    Spec('neighbors_file', '', 'YAML file of the neighbours and their markers; empty: '
         'config/neighbors.yaml of this package', read_only=True),
    Spec('camera_position', [0.10, 0.0, 0.0], 'place of the camera on the body, FLU', 'm',
         fixed_length=True, read_only=True),
    Spec('camera_rpy', [0.0, 0.0, 0.0], 'roll, pitch, yaw of the camera on the body; zeros look '
         'ahead', 'rad', fixed_length=True, read_only=True),
    Spec('image_transport', 'raw', 'subscribe image_raw or image_raw/compressed',
         choices=('raw', 'compressed'), read_only=True),
    Spec('rectified', False, 'the images are undistorted already: use P of camera_info',
         read_only=True),
    ODOM_TWIST_FRAME,
    Spec('max_wait', 0.05, 'how long an image waits for odometry of its stamp', 's', 0.0, 1.0,
         read_only=True),
    Spec('max_extrapolation', ODOMETRY.max_extrapolation, 'how far odometry is carried past its '
         'newest stamp after that', 's', 0.0, 0.2, read_only=True),
    Spec('acceleration_noise', FILTER.acceleration_noise, 'how much a neighbour accelerates, as '
         'white noise', 'm/s^2/sqrt(Hz)', 0.01, 100.0, read_only=True),
    Spec('angular_noise', FILTER.angular_noise, 'how much it turns, as white noise',
         'rad/s^2/sqrt(Hz)', 0.01, 100.0, read_only=True),
    Spec('attitude_noise', FILTER.attitude_noise, 'deviation of the own attitude at an image',
         'rad', 0.0, 1.0, read_only=True),
]


def build(values: dict[str, Any]) -> Tracker:
    """Return the tracker of the parameters; ValueError where they or the file are wrong."""
    path = values['neighbors_file'] or resource('config/neighbors.yaml')
    return Tracker(
        load(path), camera_mounting(values['camera_position'], values['camera_rpy']),
        FilterParams(**{name: values[name] for name in (
            'acceleration_noise', 'angular_noise', 'attitude_noise')}),
        OdometryParams(max_extrapolation=values['max_extrapolation']))


class RelativePose(FlockNode):
    """Holds images back until odometry reaches their stamps, and hands both to the tracker."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('relative_pose', **kwargs)
        parameters = self.declare(SPECS, build)
        self._tracker, self._values = parameters.current, parameters.values
        self._camera: CameraModel | None = None
        self._camera_fault = 'none came yet'
        self._calibration: tuple[Any, ...] = ()
        self._epoch: int | None = None
        self._frame = ''
        self._pending: deque[tuple[float, Image | CompressedImage]] = deque()
        now = time.monotonic()
        self._processed = now
        self._dropping_since: float | None = None
        self._last_rejection = ''
        self._seen = {n.name: now for n in self._tracker.config.neighbors}
        self._other_ids: dict[int, float] = {}

        compressed = self._values['image_transport'] == 'compressed'
        image_topic = 'image_raw/compressed' if compressed else 'image_raw'
        self._other_topic = 'image_raw' if compressed else 'image_raw/compressed'
        self.subscribe(CompressedImage if compressed else Image, image_topic, self._take_image,
                       IMAGE_QOS)
        self.subscribe(CameraInfo, 'camera_info', self._take_camera_info, IMAGE_QOS)
        self.subscribe(Odometry, 'odom', self._take_odom, ODOM_QOS)
        self._images = self.diagnostics.rates[f'{image_topic}_hz']
        self._neighbors = self.create_publisher(Odometry, 'neighbors', NEIGHBORS_QOS)
        self.diagnostics.checks += [
            self._transport_problem, self._processing_problem, self._sight_problem]
        self._overdue = self.create_timer(
            max(self._values['max_wait'], 0.001), self._process_overdue,
            clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._overdue.cancel()

    def _take_camera_info(self, message: CameraInfo) -> None:
        roi = message.roi
        window = (roi.x_offset, roi.y_offset, roi.width or message.width,
                  roi.height or message.height, max(message.binning_x, 1),
                  max(message.binning_y, 1))
        calibration = (tuple(message.k), tuple(message.d), tuple(message.p),
                       message.distortion_model, message.width, message.height, window)
        if calibration == self._calibration:
            return
        self._camera, self._calibration = None, ()
        try:
            self._camera = CameraModel.from_calibration(
                message.k, message.d, message.distortion_model, message.width, message.height,
                message.p, rectified=self._values['rectified']).scaled(*window)
        except ValueError as error:
            self._camera_fault = str(error)
            raise
        self._calibration = calibration
        self.diagnostics.values['camera'] = (
            f'{self._camera.width}x{self._camera.height} {self._camera.model}')
        self.get_logger().info(f'camera: {self.diagnostics.values["camera"]}')
        self._process_pending()

    def _take_odom(self, message: Odometry) -> None:
        state = from_odometry(message, self._values['odom_twist_frame'])
        self._frame = state.frame
        jumped = self._tracker.feed_odometry(OdometrySample(
            self._seconds(state.stamp), state.position, state.quaternion, state.velocity,
            state.angular_velocity))
        if jumped:
            self._pending.clear()
            self.diagnostics.reject('time jumped back', 'every track starts anew')
        self._process_pending()

    def _take_image(self, message: Image | CompressedImage) -> None:
        self._pending.append((time.monotonic(), message))
        if len(self._pending) > MAX_PENDING:
            self._pending.popleft()
            self._reject('odometry lags behind the images')
        self._process_pending()

    def _seconds(self, nanoseconds: int) -> float:
        """Return seconds since the first stamp: near zero, floats resolve a nanosecond."""
        if self._epoch is None:
            self._epoch = nanoseconds
        return (nanoseconds - self._epoch) * 1e-9

    def _process_overdue(self) -> None:
        self._overdue.cancel()
        self._process_pending()

    def _process_pending(self) -> None:
        """Process every image whose camera and odometry are there, or that waited long enough."""
        while self._pending:
            received, message = self._pending[0]
            stamp = self._seconds(stamp_to_nanoseconds(message.header.stamp))
            awaited = self._camera is None or self._tracker.missing(stamp) in (
                Missing.TOO_NEW, Missing.EMPTY)
            if awaited and time.monotonic() - received < self._values['max_wait']:
                self._overdue.reset()
                return
            self._pending.popleft()
            try:
                self._process(stamp, message)
            except ValueError as error:
                self._reject('invalid image', str(error))
            except Exception as error:  # also called by a timer, where it would end the node
                self._last_rejection = f'{type(error).__name__}: {error}'
                self.diagnostics.internal_error('on an image', error)

    def _process(self, stamp: float, message: Image | CompressedImage) -> None:
        if self._camera is None:
            self._reject('no usable camera_info', self._camera_fault)
            return
        start = time.monotonic()
        sighting = self._tracker.process_image(stamp, _decoded(message), self._camera)
        for reason, detail in sighting.rejections:
            self._reject(reason, detail)
        for name, estimate in sighting.estimates.items():
            self._publish(name, estimate, message)
        now = time.monotonic()
        self.diagnostics.latency('processing').add(now - start)
        if not any(reason in _NO_ODOMETRY for reason, _ in sighting.rejections):
            self._processed, self._dropping_since = now, None
            processed = self.diagnostics.rate('processed')
            processed.tick(now)
            self.diagnostics.values['images_processed'] = processed.count
        self._other_ids.update(dict.fromkeys(sighting.other_ids, now))
        self._seen.update(dict.fromkeys(sighting.estimates, now))

    def _publish(self, name: str, estimate: Estimate, image: Image | CompressedImage) -> None:
        twist = estimate.child_twist
        self._neighbors.publish(to_odometry(
            image.header.stamp, self._frame, name, estimate.position, estimate.quaternion,
            twist[:3], twist[3:], estimate.pose_covariance, estimate.child_twist_covariance))
        self.diagnostics.rate(name).tick(time.monotonic())
        age = self.get_clock().now().nanoseconds - stamp_to_nanoseconds(image.header.stamp)
        if abs(age) < 10 * NANOSECONDS:  # else a bag is replayed on another clock
            self.diagnostics.latency('stamp_to_estimate').add(age / NANOSECONDS)

    def _reject(self, reason: str, detail: str = '') -> None:
        self._last_rejection = f'{reason}: {detail}' if detail else reason
        self._dropping_since = self._dropping_since or time.monotonic()
        self.diagnostics.reject(reason, detail)

    def _transport_problem(self, now: float) -> Problem | None:
        """Point to the other image topic where only that one is published."""
        if self._images.count or not self.count_publishers(self._other_topic):
            return None
        other = 'raw' if self._other_topic == 'image_raw' else 'compressed'
        return WARN, (f'{self.resolve_topic_name(self._other_topic)} is published: set '
                      f'image_transport to {other}')

    def _processing_problem(self, now: float) -> Problem | None:
        if self._dropping_since is None or now - self._dropping_since < UNSEEN_TIMEOUT:
            return None
        return ERROR, (f'no image processed for {now - self._dropping_since:.0f} s: '
                       f'{self._last_rejection}')

    def _sight_problem(self, now: float) -> Problem | None:
        if now - self._processed > UNSEEN_TIMEOUT:
            return None  # nothing can be seen without images
        unseen = [f'{n.name} (marker {n.marker_id} of {self._tracker.config.dictionary})'
                  for n in self._tracker.config.neighbors
                  if now - self._seen[n.name] > UNSEEN_TIMEOUT]
        if not unseen:
            return None
        others = sorted(i for i, seen in self._other_ids.items() if now - seen < UNSEEN_TIMEOUT)
        instead = f'; in sight are markers {", ".join(map(str, others))}' if others else ''
        return WARN, f'not in sight: {", ".join(unseen)}{instead}'


_NO_ODOMETRY = frozenset(missing.value for missing in Missing)


def _decoded(message: Image | CompressedImage) -> GrayImage:
    if isinstance(message, CompressedImage):
        return decode_compressed(message.data)
    return decode(message.encoding, message.height, message.width, message.step,
                  bool(message.is_bigendian), message.data)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(RelativePose, args)


if __name__ == '__main__':
    sys.exit(main())
