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
The observations of a running system or of a bag, which the checks judge.

Stamps and arrivals are in s of the time of ROS; in a bag, of the time of recording.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from flock_follower.bags.schedule import MAX_GAP
from flock_follower.checks.pose_path import PosePath
from flock_follower.checks.processor import Load
from flock_follower.checks.reach import Reach
from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    R_FLU_OPTICAL,
)
from flock_follower.messages import OdometryState
from flock_follower.messages.topic_names import COMPRESSED_IMAGES, full_name, RAW_IMAGES
from flock_follower.odometry.reader import OdometrySource
from flock_follower.odometry.static_frames import StaticFrames
from flock_follower.perception.prints import Fault


class TopicEnd(NamedTuple):
    """A publisher of a topic; ``node`` is '' if unknown, as in bags."""

    node: str
    type: str


@dataclass
class TopicSeen:
    """A topic, with ``arrivals`` and ``stamps`` of its messages; 0 is a missing stamp."""

    publishers: list[TopicEnd] = field(default_factory=list)
    arrivals: list[float] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)

    @property
    def types(self) -> list[str]:
        """Return the types under which it is published."""
        return sorted({end.type for end in self.publishers})


@dataclass
class Picture:
    """
    An image that was searched for markers.

    ``brightness`` and ``contrast`` are mean and standard deviation of the gray levels. ``markers``
    maps the ids of detected markers to the length of their sides, px; markers of a neighbor only
    if they gave a measurement. ``outlines`` are the ids of the neighbor's other markers,
    ``misprints`` the reasons of their refusal. ``fault`` is the reason if the image cannot be
    decoded.
    """

    stamp: float
    width: int
    height: int
    encoding: str
    bytes: int
    brightness: float = 0.0
    contrast: float = 0.0
    markers: dict[int, float] = field(default_factory=dict)
    outlines: list[int] = field(default_factory=list)
    misprints: list[Fault] = field(default_factory=list)
    fault: str = ''


@dataclass
class NodeStatus:
    """The newest status of a node on /diagnostics; ``level`` 0 ok, 1 warning, 2 error, 3 stale."""

    level: int
    message: str
    values: dict[str, str] = field(default_factory=dict)


@dataclass
class Machine:
    """
    The computer during the observation.

    ``load`` is that of our nodes, None if unknown. ``shared_memory_free`` is the free space in
    /dev/shm, MB; ``dead_segments`` are the files of killed processes there. ``segment`` is the
    size, bytes, of the shared memory for images; 0 if there is none. ``reach``: which computers
    can reach our nodes on this computer, None if unknown; if 'check' finds no node of ours, which
    computers can reach 'check'.
    """

    load: Load | None = None
    shared_memory_free: float | None = None
    segment: int = 0
    domain: str = '0'
    reach: list[tuple[str, Reach | None]] = field(default_factory=list)
    dead_segments: int = 0


@dataclass
class OwnMotion:
    """
    The odometry, read as our nodes read it.

    ``lost`` is the number of messages without attitude or position, ``last_error`` the reason for
    the newest lost message.
    """

    source: OdometrySource
    states: list[OdometryState] = field(default_factory=list)
    lost: int = 0
    last_error: str = ''
    events: Counter[str] = field(default_factory=Counter)

    def take(self, message: Any, arrival: int) -> None:
        """Take an Odometry message that arrived at a time, ns."""
        try:
            state = self.source.take(message, arrival)
        except ValueError as problem:
            self.lost, self.last_error = self.lost + 1, str(problem)
            return
        self.events.update(reason for reason, _ in self.source.new_events())
        if state is not None:
            self.states.append(state)


@dataclass
class SourceSeen:
    """
    The poses of a neighbor by another detector, as relative_pose takes them.

    ``topic`` is '' for a frame on /tf; ``frame`` is the frame of the newest pose. Numbers of
    poses: ``taken`` in all, ``refused`` by reason, ``used`` by the filter, ``outliers`` outside
    the filter's gate, ``outside`` of their camera's field of view, ``tilted`` far from upright.
    ``path`` compares all poses with each other. ``on_body``: whether poses are in a frame of the
    ego body, not in the frame of odom.
    """

    topic: str
    frame: str = ''
    taken: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    used: int = 0
    outliers: int = 0
    outside: int = 0
    tilted: int = 0
    path: PosePath = field(default_factory=PosePath)
    on_body: bool = True


@dataclass
class Observations:
    """
    All observations.

    ``names`` maps our names of topics to their full names. ``calibration`` is the newest
    CameraInfo. ``shifts`` are rows of image motion, see ``image_motion.fit_axes``; ``sightings``
    are rows of markers, see ``Collector.finish``. ``parameters`` holds the parameters of each of
    our nodes, by its name without namespace.
    """

    live: bool = True
    source: str = ''
    """Path of the bag."""
    duration: float = 0.0
    namespace: str = ''
    names: dict[str, str] = field(default_factory=dict)
    topics: dict[str, TopicSeen] = field(default_factory=dict)
    nodes: list[str] = field(default_factory=list)
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    own: OwnMotion | None = None
    calibration: Any = None
    dictionary: str = ''
    marker_sides: dict[int, float] = field(default_factory=dict)
    """The configured length of the sides of each neighbor's marker, m, by its id."""
    sources: dict[str, SourceSeen] = field(default_factory=dict)
    """The poses by another detector, by neighbor."""
    frames_topic: str = ''
    """Topic of the images that another detector processes; '' without such a topic."""
    static: StaticFrames = field(default_factory=StaticFrames)
    """The frames of tf_static."""
    pictures: list[Picture] = field(default_factory=list)
    shifts: list[list[float]] = field(default_factory=list)
    sightings: list[list[float]] = field(default_factory=list)
    statuses: dict[str, NodeStatus] = field(default_factory=dict)
    """Newest status by the full name of the node, without its first slash."""
    files: dict[str, list[str]] = field(default_factory=dict)
    """The parameter files by the name of the node, as for ``statuses``."""
    machine: Machine = field(default_factory=Machine)
    incomplete: str = ''
    """Why a bag was never finished."""
    gaps: list[tuple[float, float, bool]] = field(default_factory=list)
    """Steps in the times of a bag: s after its start, s of the step, whether it interrupts images
    or odometry."""
    set_back: float = 0.0
    """By how much the clock was set back during the recording of a bag, s."""
    unreadable: dict[str, str] = field(default_factory=dict)
    """Topics of a bag that cannot be read, and why."""

    @property
    def has_markers(self) -> bool:
        """Return whether a neighbor has a marker: then images are needed."""
        return bool(self.marker_sides) or not self.sources

    def status(self, node: str) -> NodeStatus | None:
        """Return the newest status of one of our nodes, by its name without namespace, or None."""
        return self.statuses.get(full_name(node, self.namespace).lstrip('/'))

    @property
    def busy(self) -> bool:
        """Return whether the computer was too busy to judge rates and latencies."""
        return self.machine.load is not None and self.machine.load.busy

    def topic(self, name: str) -> TopicSeen:
        """Return the observation of one of our topics; empty if there is none."""
        return self.topics.get(self.names.get(name, ''), TopicSeen())

    @property
    def image_name(self) -> str:
        """Return our name of the images in use: raw, or compressed."""
        transport = self.value('relative_pose', 'image_transport', 'raw')
        wanted, other = ((COMPRESSED_IMAGES, RAW_IMAGES) if self.live and transport == 'compressed'
                         else (RAW_IMAGES, COMPRESSED_IMAGES))
        return other if self.topic(other).publishers and (
            not self.topic(wanted).publishers) else wanted

    def rate(self, topic: TopicSeen) -> float:
        """Return the rate of messages, Hz, without gaps of a bag; 0 if fewer than two came."""
        periods = np.diff(topic.arrivals)
        if self.gaps:
            periods = periods[np.abs(periods) <= MAX_GAP]
        span = float(periods.sum())
        return len(periods) / span if span > 0.0 else 0.0

    def value(self, node: str, parameter: str, default: Any = None) -> Any:
        """Return the value of a parameter of one of our nodes."""
        return self.parameters.get(node, {}).get(parameter, default)

    @property
    def camera_rpy(self) -> Any:
        """Return the configured roll, pitch and yaw of the camera on base_link, rad."""
        return self.value('relative_pose', 'camera_rpy', [0.0, 0.0, 0.0])

    @property
    def camera_rotation(self) -> Array:
        """Return the configured rotation (3, 3) from the camera's optical frame to base_link."""
        return quaternion_to_matrix(quaternion_from_rpy(*self.camera_rpy)) @ R_FLU_OPTICAL
