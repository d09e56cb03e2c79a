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

"""Inputs of relative_pose from other detectors: poses, frames of ``/tf``, and processed images."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
import statistics
import time
from typing import Any

from rclpy.qos import QoSProfile

from flock_follower.messages import stamp_age
from flock_follower.messages.poses import from_pose, POSE_TYPES, stamp_of, TRANSFORMS
from flock_follower.nodes.support.conversions import message_class
from flock_follower.nodes.support.diagnostics import ERROR, Problem, STEADY, WARN
from flock_follower.nodes.support.inputs import (
    best_effort,
    for_each,
    StaticTransforms,
    TRANSFORMS_BYTES_MAX,
)
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.perception.neighbor_filter import UpdateOutcome
from flock_follower.perception.pending_images import Perceiver
from flock_follower.perception.pose_sources import (
    LATE_POSE,
    MANY_OUTLIERS,
    Sourced,
    TWO_PUBLISHERS,
)

INVALID_FRAME = 'invalid frame of another detector'
LOOK_PERIOD = 0.5  # s between two looks at the publishers of the topics
N_POSES_JUDGED = 50  # newest poses whose latency and outliers are judged


class PoseInputs:
    """
    Subscribes each topic once its type is known, and passes on what arrives.

    :param process: is called after each message.
    :raises ValueError: if ``tf_frame`` is set and tf2_msgs is not installed, or a topic has two
        uses.
    """

    def __init__(self, node: FlockNode, perceiver: Perceiver, process: Callable[[], None],
                 own_frames: frozenset[str]) -> None:
        self._node, self._perceiver, self._process = node, perceiver, process
        sources = perceiver.sources.sources
        self._names = {node.resolve_topic_name(source.topic): name
                       for name, source in sources.items() if source.topic}
        self._transforms = {source.tf_frame: name for name, source in sources.items()
                            if source.tf_frame}
        self._judged: dict[str, deque[tuple[float, bool]]] = {
            name: deque(maxlen=N_POSES_JUDGED) for name in sources}
        self._waiting = dict.fromkeys(self._names, '')
        """Why each topic gives no poses now, or ''."""
        self._contested: set[str] = set()
        """Topics with several publishers: their poses are refused."""
        self._subscribed: set[str] = set()
        self._frames_fault = ''
        """Why the topic of the frames cannot be used, or ''."""
        frames = perceiver.tracker.config.frames_topic
        self._frames = node.resolve_topic_name(frames) if frames else ''
        topics = [node.resolve_topic_name(s.topic) for s in sources.values() if s.topic]
        if twice := sorted(t for t in topics if topics.count(t) > 1 or t == self._frames):
            raise ValueError(f'neighbors_file: {twice[0]} is the topic of two neighbors, or also '
                             'frames_topic: each neighbor must have a pose_topic of its own')
        if self._transforms:
            self._subscribe_transforms(own_frames)
        perceiver.sources.static = StaticTransforms(node).frames
        node.diagnostics.checks.append(self._problem)
        node.create_timer(LOOK_PERIOD, self.subscribe_available, clock=STEADY)
        self.subscribe_available()

    def _subscribe_transforms(self, own_frames: frozenset[str]) -> None:
        if own := own_frames.intersection(self._transforms):
            raise ValueError(f'tf_frame = {min(own)!r}: relative_pose itself publishes it: set '
                             'publish_tf to false')
        self._node.subscribe(message_class(TRANSFORMS), '/tf', self._take_transforms,
                             best_effort(100), required=False, largest=TRANSFORMS_BYTES_MAX)

    def subscribe_available(self) -> None:
        """Subscribe the topics that have a publisher now; count the publishers of each."""
        for topic, name in self._names.items():
            ends = self._node.get_publishers_info_by_topic(topic)
            self._waiting[topic] = '' if ends else 'no publisher'
            self._contested.discard(topic)
            if len(ends) > 1:
                self._contested.add(topic)
                self._waiting[topic] = f'{len(ends)} publishers'
            types = {end.topic_type for end in ends}
            if topic in self._subscribed or not types:
                continue
            usable = next((each for each in POSE_TYPES if each in types), None)
            if usable is None:
                self._waiting[topic] = f'has type {min(types)}'
                continue
            self._node.subscribe(message_class(usable), topic, partial(self._take, topic, name),
                                 best_effort(10), required=False)
            self._subscribed.add(topic)
        if self._frames and self._frames not in self._subscribed:
            for end in self._node.get_publishers_info_by_topic(self._frames):
                try:
                    self._subscribe_frames(end.topic_type)
                    self._frames_fault = ''
                except ValueError as error:
                    self._frames_fault = str(error)
                break

    def _subscribe_frames(self, msgtype: str) -> None:
        kind = message_class(msgtype)
        first = next(iter(kind.get_fields_and_field_types().values()), '')
        if first != 'std_msgs/Header' and msgtype != 'std_msgs/msg/Header':
            raise ValueError(f'frames_topic {self._frames} has type {msgtype}, without a header')
        # Raw: an image need not be read for its stamp.
        self._node.create_subscription(
            kind, self._frames, self._take_frame, QoSProfile(
                depth=10, reliability=best_effort().reliability), raw=True)
        self._subscribed.add(self._frames)

    def _take_frame(self, data: bytes) -> None:
        try:
            stamp = stamp_of(data)
        except ValueError as error:
            self._node.diagnostics.reject(INVALID_FRAME, str(error))
            return
        self._perceiver.take_frame(stamp, time.monotonic())
        self._process()

    def _take_transforms(self, message: Any) -> None:
        for_each((stamped for stamped in message.transforms
                  if stamped.child_frame_id.lstrip('/') in self._transforms), self._take_transform)

    def _take_transform(self, stamped: Any) -> None:
        self._use(self._transforms[stamped.child_frame_id.lstrip('/')], stamped)

    def _take(self, topic: str, name: str, message: Any) -> None:
        if topic in self._contested:
            self._node.diagnostics.reject(TWO_PUBLISHERS, f'{name}: {topic}')
        else:
            self._use(name, message)

    def _use(self, name: str, message: Any) -> None:
        state = from_pose(message)
        refused = self._perceiver.take_pose(name, state, time.monotonic())
        if refused is not None:
            self._node.diagnostics.reject(*refused)
        self._process()

    def judge(self, outcome: Sourced) -> None:
        """Record the outcome of a pose, for the reports of latency and outliers."""
        refused = any(reason == UpdateOutcome.OUTLIER.value
                      for reason, _ in outcome.sighting.rejections)
        now = self._node.get_clock().now().nanoseconds
        self._judged[outcome.name].append((stamp_age(outcome.stamp, now), refused))

    def _problem(self, now: float) -> Problem | None:
        if self._frames_fault:
            return ERROR, self._frames_fault
        for topic, reason in self._waiting.items():
            if reason:
                return WARN, f'poses of {self._names[topic]} are not used: {topic}: {reason}'
        for name, judged in self._judged.items():
            if len(judged) < N_POSES_JUDGED:
                continue
            latency = statistics.median(age for age, _ in judged)
            outliers = statistics.fmean(refused for _, refused in judged)
            if LATE_POSE < latency < 10.0:  # beyond, a bag is replayed on another clock
                return WARN, f'poses of {name} come {latency:.2f} s after their stamps'
            if outliers > MANY_OUTLIERS:
                return WARN, f'{outliers:.0%} of the poses of {name} are outliers'
        return None
