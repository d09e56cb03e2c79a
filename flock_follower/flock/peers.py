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
Other vehicles that send messages: limits and noises, tracks, validity of messages, senders.

One-way messages say this about clocks: a message received before its stamp is from a clock that is
ahead by at least as much. A clock that is behind looks like a slow link: the least age of many
messages is the most by which it can be behind, and no more is known without an answer.

A vehicle whose odometry leaps has begun a new frame: its earlier messages are worthless. One that
leaps again and again is lost, or two vehicles have one name; these also send too often.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field
import math
from operator import attrgetter
import re
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, wrap_angle, yaw_from_quaternion
from flock_follower.messages import FASTEST, NANOSECONDS, OdometryState

#: A vehicle's name: it goes into frame ids, and comes from a namespace.
NAME = re.compile(r'[A-Za-z0-9_.-]{1,64}')


POSITION_STD_MAX = 0.5  # m: a frame or a position known worse is not used; as in the planner
YAW_STD_MAX = 0.1  # rad: likewise the yaw of a frame
MESSAGE_AGE_MAX = 1.0  # s up to which a received state is accepted and given out
CLOCK_TOLERANCE = 0.02  # s by which a message may be ahead of the own clock
SEEN_TIMEOUT = 0.5  # s after an own sighting in which received states of that vehicle are not used
POSITION_DRIFT = 0.025  # m/sqrt(s): random walk of the odometry of each vehicle
YAW_DRIFT = 0.0025  # rad/sqrt(s): likewise of its yaw
ODOMETRY_NOISE = 0.02  # m: noise of a position from odometry
SIGHTING_NOISE = 0.02  # m: slowly varying error of a sighting beyond its covariance
ATTITUDE_NOISE = 0.06  # rad: likewise of the yaw of a vehicle seen, as markers are mounted askew
ACCELERATION_STD = 0.5  # m/s^2: unknown acceleration of a received vehicle since its stamp
SENDERS_MAX = 32  # senders at most


def checked_name(name: str) -> str:
    """
    Return a vehicle's name.

    :raises ValueError: if it cannot be the name of a vehicle.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f'vehicle_name = {name!r}: must be 1 to 64 letters, digits, _ . '
                         'or -, unique in the flock; by default it is the namespace')
    return name


#: Variance of the yaw of an odometry within its own frame, rad^2.
OWN_YAW = 0.02 ** 2
HORIZON = 3 * NANOSECONDS
#: Track points further apart than this, ns, are not interpolated: at 10 Hz three may be lost.
LONGEST_GAP = 450_000_000
#: Extrapolation of the newest track point, ns, at most.
REACH = 50_000_000
#: A track point within this time, ns, after another replaces it.
SPACING = 18_000_000


class TrackPoint(NamedTuple):
    """
    A vehicle at one time, in some frame.

    ``stamp`` ns; ``position`` (3,), m, with ``covariance`` (3, 3); ``velocity`` (3,), m/s;
    ``yaw``, rad, with its variance, infinite if the yaw is unknown.
    """

    stamp: int
    position: Array
    velocity: Array
    covariance: Array
    yaw: float
    yaw_variance: float


def position_covariance(state: OdometryState, of_itself: bool) -> Array:
    """
    Return the covariance (3, 3) of a position within the frame of its sender.

    The drift of the sender's odometry belongs to its frame: its own position (``of_itself``) has
    a small covariance, whatever its odometry claims. A sighting has the covariance it came with.
    """
    noise = ODOMETRY_NOISE if of_itself else SIGHTING_NOISE
    covariance: Array = np.zeros((3, 3)) if of_itself else state.pose_covariance[:3, :3]
    return covariance + noise ** 2 * np.eye(3)


def track_point(state: OdometryState, of_itself: bool) -> TrackPoint:
    """Return the track point of a state, within the frame of its sender."""
    seen = float(state.pose_covariance[5, 5])
    variance = OWN_YAW if of_itself else (
        # Beyond a radian, or without covariance, it says nothing.
        seen + ATTITUDE_NOISE ** 2 if 0.0 < seen < 1.0 else math.inf)
    return TrackPoint(state.stamp, state.position, state.velocity,
                      position_covariance(state, of_itself),
                      yaw_from_quaternion(state.quaternion), variance)


class Track:
    """The track points of one vehicle in one frame, of the last ``HORIZON``."""

    def __init__(self) -> None:
        self._points: list[TrackPoint] = []

    def add(self, point: TrackPoint) -> None:
        """Add the newest point; one too soon after another replaces it."""
        points = self._points
        if points and point.stamp <= points[-1].stamp:
            points.clear()  # time has jumped back: the caller has made sure of that
        if len(points) > 1 and point.stamp - points[-2].stamp < SPACING:
            points.pop()
        points.append(point)
        if points[0].stamp < point.stamp - HORIZON:
            del points[:self._first(point.stamp - HORIZON // 2)]

    def at(self, stamp: int) -> TrackPoint | None:
        """Return the vehicle at a stamp, ns, or None if that is unknown."""
        k = self._first(stamp)
        if k == len(self._points):
            if not k or stamp - self._points[-1].stamp > REACH:
                return None
            newest = self._points[-1]
            ahead = (stamp - newest.stamp) / NANOSECONDS
            return newest._replace(
                stamp=stamp, position=newest.position + ahead * newest.velocity)
        after = self._points[k]
        if after.stamp == stamp:
            return after
        if k == 0 or after.stamp - self._points[k - 1].stamp > LONGEST_GAP:
            return None
        return _between(self._points[k - 1], after, stamp)

    def _first(self, stamp: int) -> int:
        """Return the index of the first point at or after a stamp."""
        return bisect_left(self._points, stamp, key=attrgetter('stamp'))


def _between(before: TrackPoint, after: TrackPoint, stamp: int) -> TrackPoint:
    """Return the point between two: a cubic through both positions, with both velocities."""
    gap = (after.stamp - before.stamp) / NANOSECONDS
    f = (stamp - before.stamp) / (after.stamp - before.stamp)
    rest = 1.0 - f
    position = (rest * rest * (1.0 + 2.0 * f) * before.position
                + f * f * (3.0 - 2.0 * f) * after.position
                + gap * f * rest * (rest * before.velocity - f * after.velocity))
    return TrackPoint(
        stamp, position, rest * before.velocity + f * after.velocity,
        rest * before.covariance + f * after.covariance,
        before.yaw + f * wrap_angle(after.yaw - before.yaw),
        max(before.yaw_variance, after.yaw_variance))


#: The frame of NAME is NAME/odom.
FRAME = '/odom'
#: Variances of a position, m^2, or a velocity, (m/s)^2, beyond this say nothing.
VAGUE = 25.0
#: Messages whose ages are kept, and the least age, s, that is reported.
AGES, SLOW = 50, 0.25
Refusal = tuple[str, str]
TOO_FAST = 'not finite, or too fast'
#: Refusal after which a sender is ignored for a while: all its stamps are wrong.
FUTURE = 'message from the future'


def sender_of(frame: str) -> str:
    """Return the vehicle of an odometry frame, '' if the frame is not ``NAME/odom``."""
    name = frame.removesuffix(FRAME)
    return name if name != frame and NAME.fullmatch(name) else ''


def too_fast(state: OdometryState) -> str:
    """Return the speed of a state that is faster than any vehicle, else ''."""
    speed = math.hypot(*state.velocity.tolist())
    return '' if speed <= FASTEST else f'{state.child}: {speed:.3g} m/s'  # NaN is too fast


def is_covariance(matrix: Array) -> bool:
    """Return whether a matrix (3, 3) is a valid and useful covariance."""
    variances = matrix.diagonal()
    # NaN, zeros and -1 are not known; written so that NaN fails.
    if not (np.all(variances > 0.0) and np.all(variances <= VAGUE)):
        return False
    slack = 1e-6 * float(variances.max())
    symmetric = np.all(np.abs(matrix - matrix.T) <= slack)
    return bool(symmetric and np.linalg.eigvalsh(matrix)[0] >= -slack)


def refusal(state: OdometryState, received: int) -> Refusal | None:
    """Return why a message of another vehicle, received at a time, ns, is refused, or None."""
    sender, age = sender_of(state.frame), (received - state.stamp) / NANOSECONDS
    known = state.child == sender or is_covariance(state.pose_covariance[:3, :3])
    fast = too_fast(state)
    return next(((reason, detail) for holds, reason, detail in (
        (not NAME.fullmatch(state.child), 'message of an unnamed vehicle',
         f'{sender}: child_frame_id {state.child[:70]!r}'),
        (fast, f'message {TOO_FAST}', f'{sender}: {fast}'),
        (age < -CLOCK_TOLERANCE, FUTURE,
         f'{sender}: stamped {-age:.3f} s in the future: its clock is ahead by at least that'),
        (age > MESSAGE_AGE_MAX, 'message too old',
         f'{sender}: {age:.2f} s: its clock is behind, or the way is slow'),
        (not known, 'message without a covariance', f'{sender} sends {state.child}')) if holds),
        None)


#: Odometry that is further from its prediction than this, m or rad, has jumped ...
LEAP, TURN = 0.25, 0.4
#: ... plus the motion of these, m/s^2 and rad/s, since its last message. After LONGEST, s, no
#: prediction is possible.
PUSH, SPIN, LONGEST = 3.0, 2.0, 3.0
#: After this many jumps within BAN, ns, the sender is ignored for BAN.
LEAPS, BAN = 3, 5 * NANOSECONDS
#: This many own states within this time, ns, come from two senders: one sends at 10 Hz.
OFTEN, TOO_SHORT = 20, 1_400_000_000
#: Relations refused in a row: from DOUBTED on nothing is taken from the sender, from WRONG on its
#: frame is aligned anew.
DOUBTED, WRONG = 2, 5


def leapt(before: OdometryState, now: OdometryState) -> str:
    """Return by how much an odometry leapt between two of its states, in words, or ''."""
    elapsed = (now.stamp - before.stamp) / NANOSECONDS
    if not 0.0 <= elapsed <= LONGEST:
        return ''
    expected = before.position + 0.5 * elapsed * (before.velocity + now.velocity)
    off = math.dist(expected, now.position)
    turn = abs(wrap_angle(yaw_from_quaternion(now.quaternion)
                          - yaw_from_quaternion(before.quaternion)))
    if off > LEAP + 0.5 * PUSH * elapsed ** 2:
        return f'by {off:.2f} m'
    return f'by {turn:.2f} rad' if turn > TURN + SPIN * elapsed else ''


class SenderStatus(NamedTuple):
    """
    Status of one sender.

    ``why`` says why its messages are not used, '' if they are. ``position_std``, m, and
    ``yaw_std``, rad, are of its frame; ``silent`` s since its last message; ``slow`` a warning if
    its messages arrive late.
    """

    name: str
    why: str
    position_std: float
    yaw_std: float
    silent: float
    slow: str


@dataclass
class Sender:
    """One vehicle that sends messages, and the newest states that it sent, by vehicle."""

    name: str
    states: dict[str, OdometryState] = field(default_factory=dict)
    ages: deque[float] = field(default_factory=lambda: deque(maxlen=AGES))
    """Ages of its last messages on reception, s."""
    doubted: set[str] = field(default_factory=set)
    """Vehicles whose newest states do not fit the alignment: the next ones will decide."""
    received: int = 0
    """When its last message was received, ns."""
    refused: int = 0
    """Relations of its frame refused in a row."""
    _leaps: deque[int] = field(default_factory=lambda: deque(maxlen=LEAPS))
    _sent: deque[int] = field(default_factory=lambda: deque(maxlen=OFTEN))
    _ban: tuple[int, str] = (0, '')

    @property
    def slow(self) -> str:
        """Return a warning if all of its last messages were old on reception, or ''."""
        least = min(self.ages, default=0.0)
        return '' if least < SLOW else (
            f'messages are {least:.2f} s old or more: a slow way, or its clock is behind')

    def leapt_at(self, received: int) -> None:
        """Note a leap of its odometry."""
        self._leaps.append(received)
        if len(self._leaps) == LEAPS and received - self._leaps[0] <= BAN:
            self.ban(received, f'leapt {LEAPS} times in {BAN // NANOSECONDS} s')
            self._leaps.clear()

    def sent_at(self, stamp: int, received: int) -> None:
        """Note the stamp of a state of itself."""
        self._sent.append(stamp)
        if len(self._sent) == OFTEN and stamp - self._sent[0] < TOO_SHORT:
            rate = (OFTEN - 1) * NANOSECONDS / max(stamp - self._sent[0], 1)
            self.ban(received, f'sends at {rate:.0f} Hz instead of 10 Hz')
            self._sent.clear()

    def ban(self, received: int, why: str) -> None:
        """Ignore it for a while."""
        self._ban = received + BAN, why

    def banned(self, now: int) -> str:
        """Return why it is ignored, or ''."""
        until, why = self._ban
        return why if now < until else ''


def aged(state: OdometryState, now: int) -> OdometryState:
    """
    Return a state with the covariances of its prediction to a time, ns.

    The receiver predicts the state with its velocity, without the vehicle's later acceleration.
    The stamp stays that of the state.
    """
    age = max((now - state.stamp) / NANOSECONDS, 0.0)
    pose, twist = state.pose_covariance.copy(), state.twist_covariance.copy()
    pose[:3, :3] += (age ** 2 * state.velocity_covariance
                     + (0.5 * ACCELERATION_STD * age ** 2) ** 2 * np.eye(3))
    twist[:3, :3] += (ACCELERATION_STD * age) ** 2 * np.eye(3)
    return state._replace(pose_covariance=pose, twist_covariance=twist)
