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

"""Where one vehicle was in one frame of odometry, remembered for a moment and interpolated."""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

from flock_follower.geometry import Array, wrap_angle, yaw_from_quaternion
from flock_follower.messages import NANOSECONDS, OdometryState

HORIZON = 3 * NANOSECONDS
#: Moments further apart than this, ns, are not interpolated: at 10 Hz three words may be lost.
LONGEST_GAP = 450_000_000
#: How far, ns, the newest is carried on.
REACH = 50_000_000
#: Moments nearer to each other than this, ns, are not needed.
SPACING = 18_000_000


class Moment(NamedTuple):
    """
    Where a vehicle was, in some frame.

    ``stamp`` ns; ``position`` (3,), m, with ``covariance`` (3, 3); ``velocity`` (3,), m/s;
    ``yaw``, rad, with its variance, infinite where the yaw is not known.
    """

    stamp: int
    position: Array
    velocity: Array
    covariance: Array
    yaw: float
    yaw_variance: float

    def carried(self, stamp: int) -> Moment:
        """Return where it is at another stamp, ns, if it goes on as it did."""
        ahead = (stamp - self.stamp) / NANOSECONDS
        return self._replace(stamp=stamp, position=self.position + ahead * self.velocity)


def moment(state: OdometryState, covariance: Array, yaw_variance: float) -> Moment:
    """Return the moment of a state, with another covariance (3, 3), and variance of the yaw."""
    return Moment(state.stamp, state.position, state.velocity, covariance,
                  yaw_from_quaternion(state.quaternion), yaw_variance)


class ToldTrack:
    """The moments of one vehicle in one frame, of the last ``HORIZON``."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._moments: list[Moment] = []

    @property
    def newest(self) -> Moment | None:
        """Return the newest moment, or None while there is none."""
        return self._moments[-1] if self._moments else None

    def add(self, moment: Moment) -> None:
        """Remember a moment, the newest; one that comes too soon after another takes its place."""
        if self._stamps and moment.stamp <= self._stamps[-1]:
            self._stamps.clear()  # time has jumped back: whoever hands it in has seen to that
            self._moments.clear()
        if len(self._stamps) > 1 and moment.stamp - self._stamps[-2] < SPACING:
            self._stamps[-1], self._moments[-1] = moment.stamp, moment
            return
        self._stamps.append(moment.stamp)
        self._moments.append(moment)
        if self._stamps[0] < moment.stamp - HORIZON:
            first = bisect_left(self._stamps, moment.stamp - HORIZON // 2)
            del self._stamps[:first], self._moments[:first]

    def at(self, stamp: int) -> Moment | None:
        """Return where the vehicle was at a stamp, ns, or None where that is not known."""
        k = bisect_left(self._stamps, stamp)
        if k == len(self._stamps):
            near = bool(k) and stamp - self._stamps[-1] <= REACH
            return self._moments[-1].carried(stamp) if near else None
        after = self._moments[k]
        if after.stamp == stamp:
            return after
        if k == 0 or after.stamp - self._stamps[k - 1] > LONGEST_GAP:
            return None
        return _between(self._moments[k - 1], after, stamp)


def _between(before: Moment, after: Moment, stamp: int) -> Moment:
    """Return the moment between two: a cubic through both positions, with both velocities."""
    gap = (after.stamp - before.stamp) / NANOSECONDS
    f = (stamp - before.stamp) / (after.stamp - before.stamp)
    rest = 1.0 - f
    position = (rest * rest * (1.0 + 2.0 * f) * before.position
                + f * f * (3.0 - 2.0 * f) * after.position
                + gap * f * rest * (rest * before.velocity - f * after.velocity))
    return Moment(
        stamp, position, rest * before.velocity + f * after.velocity,
        rest * before.covariance + f * after.covariance,
        before.yaw + f * wrap_angle(after.yaw - before.yaw),
        max(before.yaw_variance, after.yaw_variance))
