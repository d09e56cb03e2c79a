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
The perception node: images and ego odometry in, the neighbors' states out.

The node subscribes ``odom``, ``image_raw`` (or ``image_raw/compressed``) and ``camera_info``; with
several cameras (parameter ``cameras``) the images and calibration of each; with other detectors
their poses (``pose_topic``, ``tf_frame`` and ``frames_topic`` of the neighbors' file).

For each neighbor measured in an image the node publishes, with the stamp of the image,
``neighbors``, ``neighbors/acceleration``, the measured pose in the camera's optical frame as
``neighbors/NAME/pose``, and on ``/tf`` the pose in the frame of ``odom`` if tf2_msgs is installed.
A second object with the marker of NAME has the name NAME/duplicate. ``neighbors/frames`` has one
message for each processed image, with or without a neighbor. While ``~/debug_image`` (with several
cameras ``~/debug_image/NAME``) has a subscriber, the node draws the measurements into each image.
The mathematics is in ``flock_follower.perception``.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import partial
import sys
import time
from typing import Any

from geometry_msgs.msg import AccelWithCovarianceStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Range
from std_msgs.msg import Header

from flock_follower.messages import DUPLICATE, MOTION_TOPIC, NANOSECONDS, OdometryState, read_stamp
from flock_follower.messages.poses import (
    child_frame,
    from_range,
    pose_topic,
    TRANSFORMS,
    transforms,
)
from flock_follower.messages.state_reader import from_odometry
from flock_follower.nodes.support.conversions import make, message_class, nanoseconds_to_stamp
from flock_follower.nodes.support.diagnostics import ERROR, Problem, STEADY, WARN
from flock_follower.nodes.support.inputs import best_effort, OwnOdometry
from flock_follower.nodes.support.pose_inputs import PoseInputs
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.parameters.cameras import cameras, CameraValues
from flock_follower.perception.camera import CameraModel, marked_rectified
from flock_follower.perception.images import compute_in_one_thread
from flock_follower.perception.neighbor_filter import Estimate
from flock_follower.perception.overlay import annotate
from flock_follower.perception.parameter_table import RELATIVE_POSE as SPECS
from flock_follower.perception.parameter_table import tracker
from flock_follower.perception.pending_images import JUMPED, ODOMETRY_LAGS, Perceiver, Processed
from flock_follower.perception.pose_sources import Sourced
from flock_follower.perception.prints import Fault
from flock_follower.perception.range_tracking import Ranged
from flock_follower.perception.tracker import Sighting

POLL_PERIOD = 0.1  # s between two looks at odometry if no image comes
LOOK_AGAIN = 0.02  # s after which waiting images are looked at if no odometry comes
UNSEEN_TIMEOUT = 2.0  # s without a neighbor, or without an image processed, that is reported


class _Camera:
    """One camera of the node: its topics, and the faults of its images."""

    def __init__(self, node: RelativePose, values: CameraValues, transport: str) -> None:
        self.name = values.name
        self.of = f' of camera {values.name}' if values.name else ''
        self.dropping_since: float | None = None
        self._last_rejection = ''
        self._node = node
        self._images = node.resolve_topic_name(values.images(transport))
        if node.marked:
            node.subscribe(
                CompressedImage if transport == 'compressed' else Image, values.images(transport),
                partial(node.take_image, self), best_effort(), largest=None)
        node.subscribe(CameraInfo, values.camera_info, partial(node.take_camera_info, self),
                       best_effort(), required=node.marked)
        self.debug_images = node.create_publisher(
            Image, f'~/debug_image/{values.name}' if values.name else '~/debug_image',
            best_effort())
        self._camera_info = node.resolve_topic_name(values.camera_info)
        node.diagnostics.checks += [self._processing_problem, self._rectified_problem,
                                    self._calibration_problem]

    def reject(self, reason: str, detail: str = '') -> None:
        """Count that an image, or something in it, was dropped."""
        self._last_rejection = f'{reason}: {detail}' if detail else reason
        self.dropping_since = self.dropping_since or time.monotonic()
        self._node.diagnostics.reject(f'{reason}{self.of}', detail)

    def _processing_problem(self, now: float) -> Problem | None:
        if self.dropping_since is None or now - self.dropping_since < UNSEEN_TIMEOUT:
            return None
        return ERROR, (f'no image{self.of} processed for {now - self.dropping_since:.0f} s: '
                       f'{self._last_rejection}')

    def _rectified_problem(self, now: float) -> Problem | None:
        model = self._node.camera_model(self.name)
        if model is None or not model.distortion.any() or not marked_rectified(self._images):
            return None  # a rectified camera has no distortion
        return ERROR, (f'{self._images} is marked as rectified, its camera_info has distortion: '
                       'start relative_pose and planner with rectified:=true')

    def _calibration_problem(self, now: float) -> Problem | None:
        count = self._node.count_publishers(self._camera_info)
        return (ERROR, f'{count} publishers on {self._camera_info}: images have the calibration '
                'of any one, and wrong distances; end all but one') if count > 1 else None


class RelativePose(FlockNode):
    """Feeds the perceiver from topics, publishes its estimates, and reports dropped messages."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('relative_pose', **kwargs)
        parameters = self.declare(SPECS, tracker)
        self._tracker, self._values = parameters.current, parameters.values
        self._perceiver = Perceiver(self._tracker, max_wait=self._values['max_wait'])
        now = time.monotonic()
        self._processed = now
        self._seen = {n.name: now for n in self._tracker.config.neighbors}
        self._other_ids: dict[int, float] = {}
        self._duplicates: dict[str, tuple[float, Estimate]] = {}
        self._misprints: dict[str, tuple[float, Fault]] = {}

        self.marked = any(n.markers for n in self._tracker.config.neighbors)
        """Whether a neighbor has a marker; without markers no image is needed."""
        self._cameras = {camera.name: _Camera(self, camera, self._values['image_transport'])
                         for camera in cameras(self._values)}
        self._polls: list[Callable[[], None]] = []
        """Process the received odometry, and before it the received motion without odometry."""
        if not self._tracker.alone:
            self._own = OwnOdometry(
                self, self._values, self._use_odometry, awaited=self._awaited)
            self._polls = [
                self.poll(Odometry, MOTION_TOPIC, self._take_motion, best_effort(200),
                          required=False, awaited=self._awaited), self._own.poll]
        self.create_timer(POLL_PERIOD, self.poll_odom, clock=STEADY)
        self.subscribe(Range, 'ranges', self._take_range, best_effort(50), required=False)
        self._neighbors = self.create_publisher(Odometry, 'neighbors', QoSProfile(depth=10))
        self._accelerations = self.create_publisher(
            AccelWithCovarianceStamped, 'neighbors/acceleration', QoSProfile(depth=10))
        self._poses = {pose_topic(n.name): self.create_publisher(
            PoseWithCovarianceStamped, pose_topic(n.name), QoSProfile(depth=10))
            for n in self._tracker.config.neighbors}
        self._transforms = self._transform_publisher() if self._values['publish_tf'] else None
        self._frames = self.create_publisher(Header, 'neighbors/frames', QoSProfile(depth=1))
        self.diagnostics.checks += [self._sight_problem, self._duplicate_problem]
        self.diagnostics.sources.append(self._learned)
        self._overdue = self.create_timer(
            max(min(self._values['max_wait'], LOOK_AGAIN), 0.001), self._process_pending,
            clock=STEADY)
        self._overdue.cancel()
        own_frames = frozenset(child_frame(n.name, self.get_namespace())
                               for n in self._tracker.config.neighbors)
        self._sources = PoseInputs(
            self, self._perceiver, self._use_sources,
            own_frames if self._transforms is not None else frozenset()) if (
                self._perceiver.sources.sources) else None

    def _transform_publisher(self) -> Publisher | None:
        """Return the publisher of /tf; None if tf2_msgs is not installed, as in PyPI's runtime."""
        try:
            return self.create_publisher(message_class(TRANSFORMS), '/tf', QoSProfile(depth=100))
        except ValueError:
            self.get_logger().info('tf2_msgs is not installed: nothing is published on /tf')
            return None

    def take_camera_info(self, camera: _Camera, message: CameraInfo) -> None:
        """Take the calibration of a camera."""
        if self._perceiver.take_camera_info(message, camera.name):
            model = self._perceiver.model(camera.name)
            assert model is not None
            key = _diagnostics_key('camera', camera.name)
            size = f'{model.width}x{model.height} {model.model}'
            self.diagnostics.values[key] = size
            self.get_logger().info(f'{key}: {size}')
            self._process_pending()

    def camera_model(self, name: str) -> CameraModel | None:
        """Return the model of a camera, None before its calibration."""
        return self._perceiver.model(name)

    def _awaited(self) -> bool:
        """Return whether an image, a range or a pose waits for odometry."""
        return self._perceiver.overdue is not None or (
            self._tracker.ranging.waiting or self._perceiver.sources.has_waiting)

    def poll_odom(self) -> None:
        """Process the received ego motion."""
        for poll in self._polls:
            poll()

    def _take_motion(self, message: Odometry, arrival: int) -> None:
        self._use_odometry(from_odometry(message), arrival)

    def _use_odometry(self, state: OdometryState, arrival: int) -> None:
        if self._perceiver.take_odometry(state):
            self.diagnostics.reject(*JUMPED)
        self._process_pending()

    def take_image(self, camera: _Camera, message: Image | CompressedImage) -> None:
        """Take an image of a camera."""
        self.poll_odom()
        stamp = read_stamp(message.header.stamp)
        dropped = self._perceiver.take_image(message, stamp, time.monotonic(), camera.name)
        if dropped is not None:
            self._cameras[dropped.camera].reject(ODOMETRY_LAGS)
        self._process_pending()

    def _take_range(self, message: Range) -> None:
        self.poll_odom()
        if (rejection := self._perceiver.take_range(from_range(message))) is not None:
            self.diagnostics.reject(*rejection)
        self._use_ranges()

    def _use_ranges(self) -> None:
        """Publish the states of neighbors out of sight, from the ranges."""
        for outcome in self._tracker.ranging.due():
            if isinstance(outcome, Ranged):
                state, acceleration = self._perceiver.messages(
                    make, outcome.stamp, outcome.name, outcome.estimate)
                self._accelerations.publish(acceleration)
                self._neighbors.publish(state)
            else:
                self.diagnostics.reject(*outcome)

    def _process_pending(self) -> None:
        """Process every image whose odometry has arrived or is overdue."""
        self._overdue.cancel()
        try:
            while (seen := self._perceiver.process(
                    time.monotonic(), time.monotonic, self._shown)) is not None:
                self._publish(seen.image.stamp_ns, seen.sighting)
                for topic, pose in self._perceiver.poses(make, seen, self._has_subscriber):
                    self._poses[topic].publish(pose)
                if seen.usable:  # after the estimates: the planner has them when it receives this
                    self._frames.publish(Header(
                        stamp=seen.image.message.header.stamp, frame_id=self._perceiver.frame))
                self._count(seen)
        except Exception as error:  # counts as a dropped image; the next one may do better
            self.diagnostics.internal_error('on an image', error)
        self._use_ranges()
        self._use_sources()
        if self._perceiver.overdue is not None:
            self._overdue.reset()

    def _publish(self, stamp: int, sighting: Sighting) -> None:
        """Publish the states of the neighbors measured at a stamp, ns."""
        states = []
        for name, estimate in (*sighting.estimates.items(), *sighting.duplicates.items()):
            state, acceleration = self._perceiver.messages(make, stamp, name, estimate)
            self._accelerations.publish(acceleration)  # first: the state needs it
            self._neighbors.publish(state)
            states += [state] if name in sighting.estimates else []
        if states and self._transforms is not None:
            self._transforms.publish(transforms(make, states, self.get_namespace()))

    def _use_sources(self) -> None:
        """Use the poses of other detectors whose odometry has arrived."""
        if self._sources is None:
            return
        now = time.monotonic()
        for outcome in self._perceiver.sources.due(now):
            if isinstance(outcome, int):
                self._frames.publish(Header(
                    stamp=nanoseconds_to_stamp(outcome), frame_id=self._perceiver.frame))
                self._processed = now
                self.diagnostics.rate('processed').tick(now)
            elif isinstance(outcome, Sourced):
                self._publish(outcome.stamp, outcome.sighting)
                self._sources.judge(outcome)
                for rejection in outcome.sighting.rejections:
                    self.diagnostics.reject(*rejection)
                self._see(outcome.sighting, outcome.stamp, now)
            else:
                self.diagnostics.reject(*outcome)
        if self._perceiver.sources.has_waiting:
            self._overdue.reset()

    def _see(self, sighting: Sighting, stamp: int, now: float) -> None:
        """Update rate and latency of the neighbors measured at a stamp, ns."""
        age = self.get_clock().now().nanoseconds - stamp
        for name in sighting.estimates:
            self.diagnostics.rate(name).tick(now)
            if abs(age) < 10 * NANOSECONDS:  # else a bag is replayed on another clock
                self.diagnostics.latency('stamp_to_estimate').append(age / NANOSECONDS)
        self._seen.update(dict.fromkeys(sighting.estimates, now))
        self._duplicates.update({name: (now, e) for name, e in sighting.duplicates.items()})

    def _has_subscriber(self, topic: str) -> bool:
        return self._poses[topic].get_subscription_count() > 0

    def _shown(self, name: str) -> bool:
        return self._cameras[name].debug_images.get_subscription_count() > 0

    def _count(self, seen: Processed) -> None:
        """Update the diagnostics with the result of an image; draw it if a viewer subscribes."""
        image, sighting, camera = seen.image, seen.sighting, self._cameras[seen.image.camera]
        now = time.monotonic()
        for reason, detail in sighting.rejections:
            camera.reject(reason, detail)
        self._see(sighting, image.stamp_ns, now)
        self.diagnostics.latency('processing').append(seen.decoding + seen.perception)
        if seen.usable:
            self._processed, camera.dropping_since = now, None
            self.diagnostics.rate('processed').tick(now)
        self._other_ids.update(dict.fromkeys(sighting.other_ids, now))
        self._misprints.update({name: (now, f) for name, f in sighting.misprints.items()})
        if seen.pixels is not None and image.model is not None and self._shown(camera.name):
            drawn = annotate(seen.pixels, image.model, sighting, self._tracker.config)
            height, width, _ = drawn.shape
            camera.debug_images.publish(Image(
                header=image.message.header, height=height, width=width, encoding='bgr8',
                step=3 * width, data=array('B', drawn.tobytes())))

    def _learned(self, now: float) -> dict[str, object]:
        """Return the estimates of clock offsets, noise and range errors for /diagnostics."""
        values: dict[str, object] = {'images_processed': self.diagnostics.rate('processed').count}
        for name, camera in self._tracker.cameras.items():
            values |= {
                _diagnostics_key('time_offset', name): camera.time_offset.describe,
                _diagnostics_key('attitude_noise_rad', name): f'{camera.noise.attitude:.5f}',
                _diagnostics_key('distance_noise_percent', name):
                    f'{100.0 * camera.noise.distance:.2f}'}
        for name, bias in self._tracker.ranging.biases.items():
            values |= {f'range_bias_{name}_m': f'{bias.value:.3f}',
                       f'range_outliers_{name}_percent': f'{100.0 * bias.gate.outliers:.1f}'}
        return values

    def _sight_problem(self, now: float) -> Problem | None:
        if now - self._processed > UNSEEN_TIMEOUT:
            return None  # nothing can be seen without images
        unseen = [f'{n.name} (marker {", ".join(str(m.marker_id) for m in n.markers)} of '
                  f'{self._tracker.config.dictionary})' if n.source is None else
                  f'{n.name} (poses of {n.source.topic or n.source.tf_frame})'
                  for n in self._tracker.config.neighbors
                  if now - self._seen[n.name] > UNSEEN_TIMEOUT]
        for name, (found, fault) in self._misprints.items():
            if now - found < UNSEEN_TIMEOUT < now - self._seen[name]:
                return ERROR, f'{name} is not used: {fault.seen}; {fault.remedy}'
        others = sorted(i for i, seen in self._other_ids.items() if now - seen < UNSEEN_TIMEOUT)
        instead = f'; in sight are markers {", ".join(map(str, others))}' if others else ''
        return (WARN, f'not in sight: {", ".join(unseen)}{instead}') if unseen else None

    def _duplicate_problem(self, now: float) -> Problem | None:
        for name, (seen, estimate) in self._duplicates.items():
            if now - seen < UNSEEN_TIMEOUT:
                x, y, z = estimate.position.tolist()
                neighbor, _, _ = name.partition(DUPLICATE)
                return WARN, (f'the marker of {neighbor} is in sight twice: a second one is at '
                              f'({x:.1f}, {y:.1f}, {z:.1f}) m in odom; cover it, or give '
                              f'{neighbor} another id')
        return None


def _diagnostics_key(value: str, camera: str) -> str:
    """
    Return the diagnostics key of a value.

    It ends with the camera's name if there are several cameras.
    """
    return f'{value} {camera}' if camera else value


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    compute_in_one_thread()
    return run(RelativePose, args)


if __name__ == '__main__':
    sys.exit(main())
