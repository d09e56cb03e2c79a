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
Poses of neighbors that other detectors measure: their checks, and their way into the tracker.

A pose waits until odometry reaches its stamp, as an image does. Then the tracker takes it like the
measurement of a marker. The stamps of the images that the other detector processes
(``frames_topic``) are passed on after the poses of these images: when a pose of the same or a
later image was used, or when a pose of this image would be late.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, normalize_quaternion, Transform
from flock_follower.messages import FARTHEST, SANE
from flock_follower.messages.poses import PoseState
from flock_follower.odometry.buffer import Missing
from flock_follower.odometry.static_frames import BASE, StaticFrames
from flock_follower.parameters.neighbors_file import PoseSource
from flock_follower.perception.look import Sighting
from flock_follower.perception.observed_wait import ObservedWait
from flock_follower.perception.range_tracking import Rejection
from flock_follower.perception.tracker import Tracker

#: A pose stamped up to this far ahead of the newest odometry, s, waits for it; beyond, clocks
#: differ.
AHEAD_OF_ODOMETRY = 0.3
#: A pose older than the newest odometry by more, s, is of another clock, or of no use.
OLDEST_POSE = 1.0
#: s: a pose and a frame whose stamps differ by less are of one image.
SAME_IMAGE = 1e-3
MOST_WAITING = 100  # poses, and frames: a bound on memory
#: m: a body that is nearer to its own frame, or in odom to this vehicle, is none: some detectors
#: send zeros if they find none.
NEAREST_POSE = 0.05
#: Variance, rad^2, of an attitude that is not used: the filter takes the axes of odom instead.
AXES_VARIANCE = 1e-4
LATE_POSE = 0.1  # s after its stamp: a larger median is reported
MANY_OUTLIERS = 0.02  # share of poses outside the gate that is reported

UNKNOWN_FRAME = 'pose in an unknown frame'
UNTIMELY = 'pose stamp repeated, too old or ahead of the odometry'
INVALID = 'pose not finite, at the own place or too far away'
NO_ATTITUDE = 'pose with a zero quaternion'
NO_COVARIANCE = 'pose without a covariance'
INVALID_COVARIANCE = 'pose with an invalid covariance'
TWO_PUBLISHERS = 'poses of one neighbor from several publishers'
UNPLACED = 'pose without odometry'
CROWDED = 'pose while too many wait for odometry'


class Sourced(NamedTuple):
    """The result of a pose: the neighbor's name, the stamp of the pose, ns, and the sighting."""

    name: str
    stamp: int
    sighting: Sighting


class _Waiting(NamedTuple):
    """A pose that waits for odometry of its stamp, s, and its time of arrival, s."""

    stamp: float
    name: str
    state: PoseState
    pose: Transform
    covariance: Array
    T_body_frame: Transform | None
    received: float


class _Frame(NamedTuple):
    """The stamp of an image, s and ns, and the arrival of its message, s."""

    stamp: float
    stamp_ns: int
    received: float


class PoseSources:
    """
    Takes poses and the stamps of frames; ``now`` is in seconds on a clock without jumps.

    ``frames`` has the optical frames of the ego cameras on the body, ``static`` those of
    ``/tf_static``.

    :param max_wait: the longest time for which a frame waits for its pose, s.
    """

    def __init__(self, tracker: Tracker, max_wait: float) -> None:
        config = tracker.config
        self.sources: Mapping[str, PoseSource] = {
            n.name: n.source for n in config.neighbors if n.source is not None}
        self.frames: dict[str, Transform] = {}
        self.static = StaticFrames()
        self._tracker, self._max_wait = tracker, max_wait
        self._with_frames = bool(config.frames_topic)
        self._wait = ObservedWait(max_wait, 1.0, needed=1)  # of frames for their poses
        self.restart()

    def place_cameras(self, placed: Iterable[tuple[str, Transform]]) -> None:
        """Take frame and pose of each camera on the body; a frame of two cameras is not used."""
        placed = [(stripped, pose) for name, pose in placed if (stripped := name.lstrip('/'))]
        names = [name for name, _ in placed]
        self.frames = {name: pose for name, pose in placed if names.count(name) == 1}

    def restart(self) -> None:
        """Forget all that waits."""
        self._newest = dict.fromkeys(self.sources, -math.inf)
        self._poses: list[_Waiting] = []
        self._frames: deque[_Frame] = deque(maxlen=MOST_WAITING)
        self._recent: deque[_Frame] = deque(maxlen=MOST_WAITING)  # waiting, or passed on
        self._shown = self._reached = -math.inf  # stamps of the newest frame, and pose, used, s

    @property
    def has_waiting(self) -> bool:
        """Return whether a pose or a frame waits."""
        return bool(self._poses or self._frames)

    def take(self, name: str, state: PoseState, stamp: float, now: float,
             odom_frame: str) -> Rejection | None:
        """
        Take a neighbor's pose for :meth:`due`; return why it is dropped, or None.

        :param stamp: its stamp, s, by the clock of the odometry.
        :param odom_frame: the frame of the odometry; '' if it is unknown.
        """
        source, newest = self.sources[name], self._tracker.newest_odometry
        if newest is None:
            return UNPLACED, name
        if not max(newest - OLDEST_POSE, self._newest[name]) < stamp <= newest + AHEAD_OF_ODOMETRY:
            return UNTIMELY, f'{name}: {stamp - newest:.2f} s after the odometry'
        frame = state.frame.lstrip('/')
        odom, T_body_frame = odom_frame.lstrip('/'), self.mounting(frame)
        # Without odometry the camera's frame is that of the odometry, on purpose.
        if not self._tracker.alone and frame in self.frames and frame in (BASE, odom):
            return UNKNOWN_FRAME, (f'{name}: frame {frame!r} is also that of a camera, whose axes '
                                   'are others: camera_info must have a frame of its own')
        if T_body_frame is None and (not frame or frame != odom):
            expected = odom_frame or 'that of the odometry'
            return UNKNOWN_FRAME, (
                f'{name}: frame {frame!r}: must be {expected}, {BASE}, a frame connected to it by '
                f'tf_static, or of a camera: {", ".join(self.frames) or "no camera_info yet"}')
        nearest, farthest = (0.0, SANE) if T_body_frame is None else (NEAREST_POSE, FARTHEST)
        if not nearest <= math.hypot(*state.position.tolist()) <= farthest:  # NaN fails
            return INVALID, f'{name}: position {state.position.tolist()}'
        attitude = _attitude(source, state)
        if isinstance(attitude, str):
            return attitude, name
        covariance = _covariance(source, state)
        if isinstance(covariance, str):
            return covariance, name
        self._newest[name] = stamp
        if len(self._poses) >= MOST_WAITING:
            return CROWDED, name
        insort(self._poses, _Waiting(
            stamp, name, state, Transform.from_quaternion(state.position, attitude),
            covariance, T_body_frame, now), key=lambda waiting: waiting.stamp)
        return None

    def take_frame(self, stamp_ns: int, stamp: float, now: float) -> None:
        """Take the stamp of an image that the other detector processes, in ns and s."""
        if self._frames and stamp < self._frames[-1].stamp:
            self._frames.clear()
        self._frames.append(_Frame(stamp, stamp_ns, now))
        self._recent.append(self._frames[-1])
        if any(abs(stamp - newest) < SAME_IMAGE for newest in self._newest.values()):
            self._wait.observe(0.0)  # the pose came before its frame

    def due(self, now: float) -> Iterator[Sourced | Rejection | int]:
        """Use every pose that odometry has reached; yield the results, and stamps of frames."""
        while self._poses:
            each = self._poses[0]
            missing = self._tracker.missing_odometry(each.stamp)
            if missing is Missing.TOO_NEW and now - each.received < self._max_wait:
                break
            self._poses.pop(0)
            if missing is not None:
                yield UNPLACED, f'{each.name}: {missing.value}'
                continue
            if not self._is_plausible(each):
                yield INVALID, f'{each.name}: position {each.state.position.tolist()}'
                continue
            self._observe_latency(each)
            yield Sourced(each.name, each.state.stamp, self._process(each))
            if not self._with_frames:
                yield from self._show(each.stamp, each.state.stamp)
        yield from self._due_frames(now)

    def _is_plausible(self, each: _Waiting) -> bool:
        """Return whether a pose in the frame of the odometry is in reach of the own place."""
        own = self._tracker.own_pose(each.stamp)
        if each.T_body_frame is not None or own is None:
            return True  # it was checked when it was taken
        apart = math.dist(each.state.position, own.translation)
        return NEAREST_POSE <= apart <= FARTHEST

    def _process(self, each: _Waiting) -> Sighting:
        pose, covariance, mounting = each.pose, each.covariance, each.T_body_frame
        if self.sources[each.name].position_only:
            own = self._tracker.own_pose(each.stamp)
            if mounting is not None and own is not None:  # the body has the axes of odom
                pose = Transform((own.rotation @ mounting.rotation).T, pose.translation)
        return self._tracker.process_pose(each.stamp, each.name, pose, covariance, mounting)

    def mounting(self, frame: str) -> Transform | None:
        """Return the pose of a frame on the ego body; None if no such frame is known."""
        if frame == BASE:
            return Transform()
        known = self.frames.get(frame)
        return known if known is not None else self.static.pose(frame, BASE)

    def _observe_latency(self, each: _Waiting) -> None:
        """Learn the delay from a frame to its pose; pass on this frame and earlier frames."""
        for frame in self._recent:
            if abs(frame.stamp - each.stamp) < SAME_IMAGE:
                self._wait.observe(max(each.received - frame.received, 0.0))
        self._reached = each.stamp

    def _due_frames(self, now: float) -> Iterator[int]:
        pending = [each.stamp for each in self._poses]
        while self._frames:
            frame = self._frames[0]
            used = frame.stamp <= self._reached + SAME_IMAGE and not (
                pending and pending[0] <= frame.stamp + SAME_IMAGE)
            if not used and now - frame.received < self._wait.limit:
                return
            self._frames.popleft()
            yield from self._show(frame.stamp, frame.stamp_ns)

    def _show(self, stamp: float, stamp_ns: int) -> Iterator[int]:
        """Yield the stamp of a frame if it is newer than the last one."""
        if stamp > self._shown:
            self._shown = stamp
            yield stamp_ns


def _attitude(source: PoseSource, state: PoseState) -> Array | str:
    """Return the attitude (x, y, z, w) of a pose, or why it is invalid."""
    if source.position_only:
        return np.array([0.0, 0.0, 0.0, 1.0])
    if not state.quaternion.any():
        return NO_ATTITUDE
    try:
        return normalize_quaternion(state.quaternion)
    except ValueError:
        return INVALID


def _covariance(source: PoseSource, state: PoseState) -> Array | str:
    """Return the covariance (6, 6) of a pose, or why there is none."""
    given = state.covariance
    rows = 3 if source.position_only else 6
    if given is None or not given.any():
        deviations = [source.position_std, AXES_VARIANCE**0.5 if source.position_only else
                      source.attitude_std]
        if None in deviations:
            return NO_COVARIANCE
        return np.diag(np.repeat(np.array(deviations, dtype=float), 3)**2)
    used = given[:rows, :rows]
    if not np.abs(used).max() <= SANE:  # NaN fails
        return INVALID_COVARIANCE
    used = 0.5 * (used + used.T)
    if not np.linalg.eigvalsh(used)[0] > 0.0:
        return INVALID_COVARIANCE
    covariance = AXES_VARIANCE * np.eye(6)
    covariance[:rows, :rows] = used
    return covariance
