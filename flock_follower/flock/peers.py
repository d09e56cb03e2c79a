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
States that vehicles send: names, validity, tracks, jumps of odometry, prediction.

If a message arrives before the time of its stamp, the sender's clock is ahead by at least the
difference. A clock that is behind has the same effect as a slow link.
"""

from __future__ import annotations

from bisect import bisect_left
import math
from operator import attrgetter
import re
from typing import NamedTuple, TypeVar

import numpy as np

from flock_follower.geometry import Array, wrap_angle, yaw_from_quaternion
from flock_follower.messages import FASTEST, NANOSECONDS, OdometryState
from flock_follower.messages.jumps import jump, ODOMETRY_JUMP

#: A vehicle's name: it goes into frame ids, and comes from a namespace. Its frame is NAME/odom.
NAME = re.compile(r'[A-Za-z0-9_.-]{1,64}')
FRAME = '/odom'

MESSAGE_AGE_MAX = 1.0  # s up to which a received state is accepted and given out
CLOCK_TOLERANCE = 0.02  # s by which a message may be ahead of the ego clock
ODOMETRY_NOISE = 0.02  # m: noise of a position from odometry
OWN_YAW_NOISE = 0.02  # rad: likewise of its yaw
SIGHTING_NOISE = 0.02  # m: slowly varying error of a sighting beyond its covariance
ATTITUDE_NOISE = 0.06  # rad: likewise of the yaw of a vehicle seen, as markers are mounted askew
ACCELERATION_STD = 0.5  # m/s^2: unknown acceleration of a received vehicle since its stamp
VAGUE = 25.0  # m^2 or (m/s)^2: a larger variance is no information


def checked_name(name: str) -> str:
    """
    Return a vehicle's name.

    :raises ValueError: if the name is not valid for a vehicle.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f'vehicle_name = {name!r}: must be 1 to 64 letters, digits, _ . '
                         'or -, unique in the flock; by default it is the namespace')
    return name


def sender_of(frame: str) -> str:
    """Return the vehicle of an odometry frame, '' if the frame is not ``NAME/odom``."""
    name = frame.removesuffix(FRAME)
    return name if name != frame and NAME.fullmatch(name) else ''


def too_fast(state: OdometryState) -> str:
    """Return the speed of a state as text if it is faster than any vehicle, else ''."""
    speed = math.hypot(*state.velocity.tolist())
    return '' if speed <= FASTEST else f'{state.child}: {speed:.3g} m/s'  # NaN is too fast


def is_covariance(matrix: Array) -> bool:
    """Return whether a matrix (3, 3) is a valid covariance, and not too large."""
    variances = matrix.diagonal()
    # NaN, zeros and -1 are not known; written so that NaN fails.
    if not (np.all(variances > 0.0) and np.all(variances <= VAGUE)):
        return False
    slack = 1e-6 * float(variances.max())
    symmetric = np.all(np.abs(matrix - matrix.T) <= slack)
    return bool(symmetric and np.linalg.eigvalsh(matrix)[0] >= -slack)


#: Refusal after which a sender is ignored for a while: all its stamps are wrong.
FROM_FUTURE = 'message from the future'


def refusal(state: OdometryState, received: int) -> tuple[str, str] | None:
    """Return why a message of another vehicle, received at a time, ns, is refused, or None."""
    sender, age = sender_of(state.frame), (received - state.stamp) / NANOSECONDS
    known = state.child == sender or is_covariance(state.pose_covariance[:3, :3])
    fast = too_fast(state)
    return next(((reason, f'{sender}: {detail}') for holds, reason, detail in (
        (not NAME.fullmatch(state.child), 'message of an unnamed vehicle', repr(state.child[:70])),
        (fast, 'message not finite, or too fast', fast),
        (age < -CLOCK_TOLERANCE, FROM_FUTURE, f'its clock is ahead by {-age:.3f} s or more'),
        (age > MESSAGE_AGE_MAX, 'message too old',
         f'{age:.2f} s: its clock is behind, or the way is slow'),
        (not known, 'message without a covariance', state.child)) if holds), None)


def rank(state: OdometryState) -> tuple[object, ...]:
    """Return a key of a message, equal only for equal messages."""
    arrays = (state.position, state.quaternion, state.velocity, state.angular_velocity,
              state.pose_covariance, state.twist_covariance, state.twist_rotation)
    return (state.frame, state.child != sender_of(state.frame), state.stamp, state.child,
            *(each.tobytes() for each in arrays))


Kept = TypeVar('Kept')


def in_order(by_name: dict[str, Kept]) -> list[Kept]:
    """Return values sorted by name, independent of the order of their arrival."""
    return [by_name[name] for name in sorted(by_name)]


# Odometry has leapt if it is farther from its prediction than ODOMETRY_JUMP or TURN, plus the
# motion by MAX_PUSH and MAX_SPIN since its last message.
TURN = 0.4  # rad
MAX_PUSH = 3.0  # m/s^2
MAX_SPIN = 2.0  # rad/s
PREDICTION_TIME = 3.0  # s after its last message without which no prediction is possible


def leapt(before: OdometryState, now: OdometryState) -> str:
    """
    Return the jump of an odometry between two of its states, as text, or ''.

    States of other vehicles may be seconds apart, so the tolerance allows for the motion between
    two states. A jump of the yaw alone also rotates the frames against each other.
    """
    elapsed = (now.stamp - before.stamp) / NANOSECONDS
    if not 0.0 <= elapsed <= PREDICTION_TIME:
        return ''
    turn = abs(wrap_angle(yaw_from_quaternion(now.quaternion)
                          - yaw_from_quaternion(before.quaternion)))
    if by := jump(before, now, elapsed, ODOMETRY_JUMP + 0.5 * MAX_PUSH * elapsed ** 2):
        return f'by {by:.2f} m'
    return f'by {turn:.2f} rad' if turn > TURN + MAX_SPIN * elapsed else ''


class TrackPoint(NamedTuple):
    """
    A vehicle at one time, in a given frame.

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

    The drift of the sender's odometry is an error of the sender's frame. So the sender's own
    position (``of_itself``) has a small covariance in this frame, whatever its odometry reports. A
    sighting keeps its covariance.
    """
    noise = ODOMETRY_NOISE if of_itself else SIGHTING_NOISE
    covariance: Array = np.zeros((3, 3)) if of_itself else state.pose_covariance[:3, :3]
    return covariance + noise ** 2 * np.eye(3)


def track_point(state: OdometryState, of_itself: bool) -> TrackPoint:
    """Return the track point of a state, within the frame of its sender."""
    seen = float(state.pose_covariance[5, 5])
    variance = OWN_YAW_NOISE ** 2 if of_itself else (
        # Beyond a radian, or without covariance, it is no information.
        seen + ATTITUDE_NOISE ** 2 if 0.0 < seen < 1.0 else math.inf)
    return TrackPoint(state.stamp, state.position, state.velocity,
                      position_covariance(state, of_itself),
                      yaw_from_quaternion(state.quaternion), variance)


#: Track points are kept for this time, ns.
HORIZON = 3 * NANOSECONDS
#: Track points further apart than this, ns, are not interpolated: at 10 Hz three may be lost.
INTERPOLATED = 450_000_000
#: Extrapolation of the newest track point, ns, at most.
REACH = 50_000_000
#: A track point within this time, ns, after another replaces it.
SPACING = 18_000_000


class Track:
    """The track points of one vehicle in one frame, of the last ``HORIZON``."""

    def __init__(self) -> None:
        self._points: list[TrackPoint] = []

    def add(self, point: TrackPoint) -> None:
        """Add the newest point; if too soon after the last point, in its place."""
        points = self._points
        if points and point.stamp <= points[-1].stamp:
            points.clear()  # time has jumped back: the caller has checked that
        if len(points) > 1 and point.stamp - points[-2].stamp < SPACING:
            points.pop()
        points.append(point)
        if points[0].stamp < point.stamp - HORIZON:
            del points[:self._first_index(point.stamp - HORIZON // 2)]

    def point_at(self, stamp: int) -> TrackPoint | None:
        """Return the vehicle at a stamp, ns; None if the track does not cover the stamp."""
        k = self._first_index(stamp)
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
        if k == 0 or after.stamp - self._points[k - 1].stamp > INTERPOLATED:
            return None
        return _interpolate(self._points[k - 1], after, stamp)

    def _first_index(self, stamp: int) -> int:
        """Return the index of the first point at or after a stamp."""
        return bisect_left(self._points, stamp, key=attrgetter('stamp'))


def _interpolate(before: TrackPoint, after: TrackPoint, stamp: int) -> TrackPoint:
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


def age_covariances(state: OdometryState, now: int) -> OdometryState:
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
