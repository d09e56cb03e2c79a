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

Times are s: stamps and arrivals in the time of ROS (of a bag, of its recording).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from flock_follower.checks.topic_names import COMPRESSED_IMAGES, RAW_IMAGES
from flock_follower.messages import OdometryState, SANE, stamp_to_nanoseconds
from flock_follower.odometry.reader import OdometrySource

#: The nodes of a follower.
OURS: Final = ('relative_pose', 'planner', 'mavlink_bridge')


@dataclass
class TopicEnd:
    """Who publishes or subscribes to a topic; ``node`` is '' where not known, as in bags."""

    node: str
    type: str
    reliable: bool = True
    latched: bool = False
    """Transient local."""


@dataclass
class TopicSeen:
    """A topic; ``arrivals`` and ``stamps`` of the messages heard; a stamp of 0 is none."""

    publishers: list[TopicEnd] = field(default_factory=list)
    subscribers: list[TopicEnd] = field(default_factory=list)
    arrivals: list[float] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Return how often messages came, Hz; 0 before the second."""
        span = self.arrivals[-1] - self.arrivals[0] if self.arrivals else 0.0
        return (len(self.arrivals) - 1) / span if span > 0.0 else 0.0

    @property
    def types(self) -> list[str]:
        """Return the types under which it is published."""
        return sorted({end.type for end in self.publishers})


@dataclass
class Picture:
    """
    An image that was looked at for markers.

    ``brightness`` and ``contrast`` are mean and deviation of its grey levels; ``markers`` maps the
    ids of the markers found to the length of their sides, px; ``repeated`` are those found more
    than once; ``fault`` says why it is none.
    """

    stamp: float
    width: int
    height: int
    encoding: str
    bytes: int
    brightness: float = 0.0
    contrast: float = 0.0
    markers: dict[int, float] = field(default_factory=dict)
    repeated: list[int] = field(default_factory=list)
    fault: str = ''


@dataclass
class Told:
    """The newest status of a node on /diagnostics; ``level`` 0 ok, 1 warning, 2 error, 3 stale."""

    level: int
    message: str
    values: dict[str, str] = field(default_factory=dict)


@dataclass
class Machine:
    """
    The computer while we listened.

    ``idle``: share of the processors that nobody used, 0 to 1, None where it is not told;
    ``shared_memory_free``: MB in /dev/shm; ``dead_segments`` of killed processes there.
    ``shares_memory``: whether images may come through
    shared memory; ``segment``: its size, bytes.
    """

    processors: int = 0
    idle: float | None = None
    shared_memory_free: float | None = None
    shares_memory: bool = False
    segment: int = 512 * 1024
    domain: str = '0'
    reach: str = ''
    """ROS_AUTOMATIC_DISCOVERY_RANGE."""
    open_nodes: list[str] = field(default_factory=list)
    """Our nodes on this computer that everybody on the network can talk to; where theirs cannot be
    read, ``check`` if its own environment is so."""
    dead_segments: int = 0


@dataclass
class OwnMotion:
    """The odometry, read as our nodes read it."""

    source: OdometrySource
    states: list[OdometryState] = field(default_factory=list)
    lost: int = 0
    """Messages without attitude or position."""
    why: str = ''
    """Of the newest message that was lost."""
    events: Counter[str] = field(default_factory=Counter)

    def take(self, message: Any, arrival: int) -> None:
        """Take an Odometry message that arrived at a time, ns."""
        try:
            state = self.source.take(message, arrival)
        except ValueError as problem:
            self.lost, self.why = self.lost + 1, str(problem)
            return
        self.events.update(reason for reason, _ in self.source.told())
        if state is not None:
            self.states.append(state)


@dataclass
class Observations:
    """
    All that was seen.

    ``names`` maps our names of topics to those they have there. ``odometry`` and ``autopilot``
    are rows of :func:`odometry_row`, of ``odom`` and ``mavlink/odom``; ``frames`` the header's and
    the child frame of the former, once for each change. ``calibration`` holds the fields of the
    newest CameraInfo, ``shifts`` rows of how images moved, see ``checks.image_motion``, and
    ``sightings`` rows of where markers were seen, see ``checks.sightings``.
    ``parameters`` are those of each of our nodes, by its plain name.
    """

    live: bool = True
    source: str = ''
    """The bag."""
    duration: float = 0.0
    namespace: str = ''
    names: dict[str, str] = field(default_factory=dict)
    topics: dict[str, TopicSeen] = field(default_factory=dict)
    nodes: list[str] = field(default_factory=list)
    clock: bool = False
    """Whether somebody publishes /clock."""
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    file_parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Those that a file of parameters sets, where one was named."""
    file_problems: list[str] = field(default_factory=list)
    odometry: list[list[float]] = field(default_factory=list)
    own: OwnMotion | None = None
    """The odometry of a bag, instead of rows: its parameters are known beforehand."""
    frames: list[list[str]] = field(default_factory=list)
    static_child: list[float] = field(default_factory=list)
    """Position (3), m, and (x, y, z, w) of odom's child frame on base_link by tf_static, or []."""
    autopilot: list[list[float]] = field(default_factory=list)
    calibration: dict[str, Any] = field(default_factory=dict)
    dictionary: str = ''
    wanted_markers: dict[int, str] = field(default_factory=dict)
    """Whose marker it is, by its id."""
    marker_sides: dict[int, float] = field(default_factory=dict)
    """How long its sides are told to be, m, by its id."""
    pictures: list[Picture] = field(default_factory=list)
    strangers: dict[str, list[int]] = field(default_factory=dict)
    """Markers of other dictionaries, by the dictionary, where none of ours was found."""
    shifts: list[list[float]] = field(default_factory=list)
    sightings: list[list[float]] = field(default_factory=list)
    told: dict[str, Told] = field(default_factory=dict)
    """By the full name of the node, without the slash before it."""
    machine: Machine = field(default_factory=Machine)
    incomplete: str = ''
    """Why a bag was never finished."""
    unreadable: dict[str, str] = field(default_factory=dict)
    """Topics of a bag that cannot be read, and why."""

    def topic(self, name: str) -> TopicSeen:
        """Return what was seen of a topic of ours; an empty one where there is none."""
        return self.topics.get(self.names.get(name, ''), TopicSeen())

    @property
    def nothing_there(self) -> bool:
        """Return whether nobody at all is seen of a running system."""
        return self.live and not self.nodes and not self.topics

    @property
    def image_name(self) -> str:
        """Return our name of the images in use: raw, or compressed."""
        transport = self.value('relative_pose', 'image_transport', 'raw')
        wanted, other = ((COMPRESSED_IMAGES, RAW_IMAGES) if self.live and transport == 'compressed'
                         else (RAW_IMAGES, COMPRESSED_IMAGES))
        return other if self.topic(other).publishers and (
            not self.topic(wanted).publishers) else wanted

    def value(self, node: str, parameter: str, default: Any = None) -> Any:
        """Return the value of a parameter of one of our nodes."""
        return self.parameters.get(node, {}).get(parameter, default)


def odometry_row(message: Any, arrival: float) -> list[float]:
    """
    Return an Odometry message as numbers, which :func:`odometry_message` turns back.

    Arrival, stamp; position (3), attitude (x, y, z, w), velocity (3), rates (3); the variances of
    pose (6) and twist (6), NaN where the rest of that covariance is absurd.
    """
    pose, twist = message.pose.pose, message.twist.twist
    p, q, v, w = pose.position, pose.orientation, twist.linear, twist.angular
    row = [arrival, stamp_to_nanoseconds(message.header.stamp) * 1e-9, p.x, p.y, p.z,
           q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z]
    for covariance in (message.pose.covariance, message.twist.covariance):
        matrix = np.asarray(covariance, dtype=float).reshape(6, 6)
        sane = bool(np.all(np.abs(matrix) < SANE))  # refuses NaN, too
        row += matrix.diagonal().tolist() if sane else [float('nan')] * 6
    return [float(number) for number in row]


def odometry_message(row: list[float], frame: str, child: str) -> Any:
    """Return the message of a row, of its covariances only the diagonals."""
    seconds = round(row[1] * 1e9)
    pose = SimpleNamespace(position=_vector(row[2:5]), orientation=SimpleNamespace(
        x=row[5], y=row[6], z=row[7], w=row[8]))
    twist = SimpleNamespace(linear=_vector(row[9:12]), angular=_vector(row[12:15]))
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=frame, stamp=SimpleNamespace(
            sec=seconds // 10**9, nanosec=seconds % 10**9)),
        child_frame_id=child,
        pose=SimpleNamespace(pose=pose, covariance=np.diag(row[15:21]).ravel()),
        twist=SimpleNamespace(twist=twist, covariance=np.diag(row[21:27]).ravel()))


def _vector(numbers: list[float]) -> Any:
    return SimpleNamespace(x=numbers[0], y=numbers[1], z=numbers[2])
