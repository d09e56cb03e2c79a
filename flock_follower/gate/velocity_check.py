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
Compares the vehicle's motion by odometry and by the autopilot; chooses the velocity to use.

A velocity is used while it is fresh and plausible, and no other source contradicts it: braking on
a wrong velocity accelerates the vehicle. Three comparisons find a contradiction:

- yaws: whether the frames of both sources are rotated against each other;
- velocities, averaged over AVERAGING_TIME: if they differ, neither source is known to be right;
- displacements over the last DISPLACEMENT_WINDOW seconds, which reveal small velocity errors. A
  position jump that does not agree with the source's velocity is removed from the displacement,
  because estimators correct their position in jumps.

Vectors are ENU. Time is an argument; no clock is read.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
import math
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.obstacle import Obstacle, Refusal
from flock_follower.geometry import Array, wrap_angle, yaw_from_quaternion
from flock_follower.messages import (
    FASTEST_OWN,
    FUTURE_TOLERANCE,
    OdometryState,
    POSITION_JUMP,
    SANE,
)
from flock_follower.planner.limits import limit_norm
from flock_follower.ranges import first_reason

#: The stream stops this long, s, after a velocity that still arrives became invalid. If none
#: arrives at all, the whole computer may have stalled: then ``blind_timeout`` applies.
LOSS_TIMEOUT: Final[float] = 0.6
#: ``brake_time`` and ``speed_horizon`` allow for velocities of up to this age, s.
USUAL_AGE: Final[float] = 0.05
#: Age beyond that lengthens both by this factor times it. Braking on a velocity that is d late is
#: the loop v' = -v(t - d) / T: it swings for ever at T = 2 d / pi, and not at all from T = e d on.
LATE_FACTOR: Final[float] = math.e
ODOM: Final[str] = 'odom'
AUTOPILOT: Final[str] = 'autopilot'


class Velocity(NamedTuple):
    """A velocity that is fresh, finite, and at most ``FASTEST_OWN``."""

    vector: Array
    """Velocity (3,), m/s."""
    margin: float
    """Increase of time constants because of the age of the velocity, s."""


class MotionReport(NamedTuple):
    """The vehicle's motion in one message of a source."""

    velocity: ArrayLike
    """Velocity (3,), m/s."""
    yaw: float = math.nan
    """Yaw, rad; NaN if unknown."""
    position: ArrayLike | None = None
    """Position (3,), m, in the frame of the source."""
    std: float = 0.0
    """Standard deviation of the position, m."""

    @classmethod
    def from_odometry(cls, state: OdometryState) -> MotionReport:
        """Return the motion in a message of odometry."""
        variance = float(state.pose_covariance[:3, :3].trace())
        return cls(state.velocity, yaw_from_quaternion(state.quaternion), state.position,
                   math.sqrt(max(variance, 0.0)))


class SourceMotion(NamedTuple):
    """The newest motion by one source; an age is infinite before its first message."""

    velocity: ArrayLike = (0.0, 0.0, 0.0)
    """Velocity (3,), m/s."""
    velocity_age: float = math.inf
    """s."""
    yaw: float = 0.0
    """Yaw, rad."""
    yaw_age: float = math.inf
    """s."""

    def fresh_velocity(self, limits: GateLimits) -> Velocity | None:
        """Return the velocity; None if it is not fresh, or not plausible."""
        if not fresh(self.velocity_age, limits.odom_timeout):
            return None
        vector = plausible_velocity(self.velocity)
        margin = LATE_FACTOR * max(self.velocity_age - USUAL_AGE, 0.0)
        return None if vector is None else Velocity(vector, margin)

    def fresh_yaw(self, limits: GateLimits) -> float | None:
        """Return the yaw, rad; None if it is not fresh, or not finite."""
        usable = fresh(self.yaw_age, limits.odom_timeout) and math.isfinite(self.yaw)
        return self.yaw if usable else None


class KnownMotion(NamedTuple):
    """The known motion of the vehicle, and the velocity that may be used."""

    source: str
    """'odom' or 'autopilot': source of the velocity that is required for commands."""
    velocity: Velocity | None
    """Velocity by the source; None if it is not fresh."""
    never: bool
    """Whether the source has not sent a velocity yet."""
    braking: Velocity | None
    """The velocity for braking; None if no velocity is fresh, or if two disagree."""
    contradiction: Obstacle | None
    """The contradiction between odom and the autopilot, if any."""
    blind: bool
    """Whether every velocity has been invalid for too long, after a valid velocity."""
    turned: float | None
    """Yaw of odom minus that of the autopilot, rad; None if a yaw is not fresh."""
    difference: Array | None
    """Velocity of odom minus that of the autopilot (3,), m/s, if odom is the source and both are
    fresh; else None."""


def known_motion(limits: GateLimits, odom: SourceMotion, autopilot: SourceMotion, source: str,
                 disagreeing_for: float = -math.inf,
                 distrusted_for: float = -math.inf) -> KnownMotion:
    """
    Return the known motion by both sources.

    :param source: 'odom' or 'autopilot'.
    :param disagreeing_for: time since the velocities began to disagree, s; negative: they agree.
    :param distrusted_for: time since the velocity of the autopilot became invalid, s.
    """
    by_odom, by_autopilot = odom.fresh_velocity(limits), autopilot.fresh_velocity(limits)
    first, velocity, other = (odom, by_odom, by_autopilot) if source == ODOM else (
        autopilot, by_autopilot, by_odom)
    contradiction: Obstacle | None = None
    braking = velocity or other
    yaw, own = odom.fresh_yaw(limits), autopilot.fresh_yaw(limits)
    turned = None if yaw is None or own is None else wrap_angle(yaw - own)
    if turned is not None and abs(turned) > limits.yaw_disagreement:
        # The frames are rotated against each other: braking would accelerate. The autopilot obeys
        # in its own frame.
        braking, contradiction = by_autopilot or by_odom, Obstacle.YAWS_DISAGREE
    elif disagreeing_for >= 0.0:
        # One of them is wrong: braking on that one would speed the vehicle up.
        braking, contradiction = None, Obstacle.VELOCITIES_DISAGREE
    difference = None
    if source == ODOM and by_odom is not None and by_autopilot is not None:
        difference = by_odom.vector - by_autopilot.vector
    # On the ground no velocity may have been known yet.
    ages = [age for age in (odom.velocity_age, autopilot.velocity_age) if math.isfinite(age)]
    lost = bool(ages) and min(ages) > limits.odom_timeout + limits.blind_timeout
    unusable = disagreeing_for > LOSS_TIMEOUT or distrusted_for > LOSS_TIMEOUT
    return KnownMotion(source, velocity, math.isinf(first.velocity_age), braking, contradiction,
                       braking is None and (lost or unusable), turned, difference)


def fresh(age: float, timeout: float) -> bool:
    """Return whether an age, s, is neither too old, nor in the future, nor NaN."""
    return -FUTURE_TOLERANCE <= age <= timeout


def refusal(age: float, timeout: float) -> str:
    """Return why an input of an age, s, is refused, or ''."""
    return first_reason((not math.isfinite(age), 'not finite'), (age > timeout, 'too old'),
                        (age < -FUTURE_TOLERANCE, 'from the future'))


def finite_vector(value: ArrayLike | None) -> Array | None:
    """Return a copy as an array (3,), None if it is not three finite numbers."""
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return vector if vector.shape == (3,) and all(map(math.isfinite, vector.tolist())) else None


def plausible_velocity(value: ArrayLike) -> Array | None:
    """Return a velocity as an array (3,), m/s; None if not finite, or faster than FASTEST_OWN."""
    vector = finite_vector(value)
    return vector if vector is not None and math.hypot(*vector.tolist()) <= FASTEST_OWN else None


#: The difference is averaged over this time, s. In flights on real autopilots' simulators single
#: ones were up to 0.32 m/s, averaged 0.13 m/s; one wrong sample must not end a flight.
AVERAGING_TIME: Final[float] = 0.3
#: Samples further apart than this, s, have the weight of this time.
HEAVIEST_STEP: Final[float] = 0.1
#: A difference is clipped to this many times the tolerance.
LARGEST: Final[float] = 3.0
#: A disagreement of this long, s, lasts until the next flight: a wrong frame shows only at speed.
#: With 0.3 s a healthy PX4 was landed twice, after 24 and 26 minutes.
LATCH_TIME: Final[float] = 0.6


class VelocityComparison:
    """Averages the difference of two velocities, and measures for how long it is too large."""

    def __init__(self) -> None:
        self._average: Array = np.zeros(3)
        self._time = -math.inf
        self._since = math.inf

    def take(self, difference: Array | None, tolerance: float, flying: bool, now: float) -> None:
        """
        Take the velocity of odom minus that of the autopilot (3,), m/s, at ``now``, s.

        :param difference: None if one of the velocities is not fresh.
        :param tolerance: largest average difference, m/s.
        :param flying: whether the vehicle flies with these velocities; else nothing is stored.
        """
        if difference is not None:
            first = math.isinf(self._time)
            step = 0.0 if first else min(now - self._time, HEAVIEST_STEP)
            share = 1.0 - math.exp(-step / AVERAGING_TIME)
            difference = limit_norm(difference, LARGEST * tolerance)
            self._average = self._average + share * (difference - self._average)
            self._time = now
            if self.difference > tolerance:
                self._since = min(self._since, now)
                return
        if not flying or now - self._since < LATCH_TIME:
            self._since = math.inf

    @property
    def difference(self) -> float:
        """Return the average difference, m/s."""
        return math.sqrt(self._average.dot(self._average))

    def disagreeing_for(self, now: float) -> float:
        """Return for how long the velocities disagree, s; minus infinity if they agree."""
        return now - self._since


#: Displacements are compared over this time, s.
DISPLACEMENT_WINDOW: Final[float] = 5.0
#: Displacements may differ by this, m, or by 3 standard deviations if those are more.
DISPLACEMENT_TOLERANCE: Final[float] = 0.5
#: Odometry that reports a larger standard deviation of its position, m, counts with this one: the
#: drift since the start grows without limit, and that of a few seconds does not.
ODOMETRY_STD_MAX: Final[float] = 0.5
#: Standard deviation of the displacement by a barometer in that time, m: gusts, doors, rotors.
BAROMETER_STD: Final[float] = 0.3
#: The vehicle is handed over after displacements have differed for this long, s.
DISPLACED_HANDOVER_TIME: Final[float] = 1.0
#: Yaws of the autopilot are kept for this long, s: odometry arrives later.
YAW_MEMORY: Final[float] = 1.0
#: After a longer gap than this, s, a path begins again.
PATH_GAP: Final[float] = 0.5
#: Time between two positions that are kept, s.
SPACING: Final[float] = 0.1
#: Acceleration by which the motion during a gap may differ from that of both its ends, m/s^2.
GAP_ACCELERATION: Final[float] = 3.0


class Path:
    """
    The positions (3,), m, of one source, without jumps; times are monotonic, s.

    One rule here removes the jumps of both sources from the path, because displacements must not
    contain jumps. The counter of the odometry's jumps is not used, because the autopilot's
    position has none.
    """

    def __init__(self) -> None:
        self.position: Array | None = None
        """The newest position, m, in the frame of the source without its jumps."""
        self.time = -math.inf
        """Time of the newest position, s."""
        self._velocity: Array | None = None
        self._shift: Array | float = 0.0
        self._kept: deque[tuple[float, Array]] = deque()

    def take(self, position: Array, velocity: Array | None, now: float,
             displaced: Array | None = None) -> None:
        """
        Take a position, m.

        :param velocity: (3,), m/s, by the same source; None: jumps are not detected.
        :param displaced: displacement (3,), m, in a gap of this source, by another one.
        """
        elapsed = now - self.time
        if elapsed <= 0.0:
            return
        if elapsed > PATH_GAP:
            self._kept.clear()
        shifted = position - self._shift
        if self.position is not None and velocity is not None:
            expected = velocity * elapsed if displaced is None else displaced
            surprise = shifted - self.position - expected
            largest = DISPLACEMENT_TOLERANCE if displaced is not None else (
                self._largest_surprise(velocity, elapsed))
            if math.hypot(*surprise.tolist()) > largest:
                self._shift = self._shift + surprise
                shifted = position - self._shift
        self.position, self.time, self._velocity = shifted, now, velocity
        if not self._kept or now - self._kept[-1][0] >= SPACING:
            self._kept.append((now, shifted))
            while len(self._kept) > 2 and now - self._kept[1][0] >= DISPLACEMENT_WINDOW:
                self._kept.popleft()

    def _largest_surprise(self, velocity: Array, elapsed: float) -> float:
        """Return the largest distance, m, from the expected position that is no jump."""
        if elapsed <= PATH_GAP:
            return POSITION_JUMP
        if self._velocity is None:
            return math.inf
        change = math.hypot(*(velocity - self._velocity).tolist())
        return POSITION_JUMP + elapsed * (change + 0.5 * GAP_ACCELERATION * elapsed)

    @property
    def span(self) -> tuple[float, float]:
        """Return the times, s, between which the path is known."""
        return (self._kept[0][0], self._kept[-1][0]) if self._kept else (math.inf, -math.inf)

    def displacement(self, start: float, end: float) -> Array:
        """Return the displacement, (3,), m, from one time within the span to another."""
        return self._place_at(end) - self._place_at(start)

    def _place_at(self, time: float) -> Array:
        """Return the position (3,), m, at a time, s, within the span."""
        before, place = self._kept[-1]
        if time == before:
            return place
        # The window most often begins between the first two.
        after = 1 if time < self._kept[1][0] else bisect_right(
            self._kept, time, key=itemgetter(0))
        before, place = self._kept[after - 1]
        if time == before:
            return place
        later, next_place = self._kept[after]
        return (next_place - place) / (later - before) * (time - before) + place


def difference(one: Path, other: Path, turn: float, now: float) -> Array:
    """
    Return the recent displacement (3,) of ``one`` minus that of ``other``, m.

    :param turn: rotation about the vertical from the frame of ``one`` to that of ``other``, rad.
    :returns: zeros if the paths do not overlap, or one is not recent.
    """
    (first, last), (other_first, other_last) = one.span, other.span
    start, end = max(first, other_first, now - DISPLACEMENT_WINDOW), min(last, other_last)
    if end <= start or now - end > PATH_GAP:
        return np.zeros(3)
    in_other = rotate_about_vertical(one.displacement(start, end), turn)
    return in_other - other.displacement(start, end)


def rotate_about_vertical(vector: Array, angle: float) -> Array:
    """Return a vector (3,) rotated about the vertical by an angle, rad."""
    x, y, z = vector.tolist()
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([cos * x - sin * y, sin * x + cos * y, z])


class Source:
    """The newest motion by one source, and its times, s."""

    def __init__(self) -> None:
        self.velocity: Array = np.zeros(3)
        self.velocity_time = -math.inf
        self.position: Array | None = None
        """The newest position, m, in the frame of the source."""
        self.yaws: deque[tuple[float, float]] = deque()
        self.path = Path()
        self.std = 0.0
        """Standard deviation of the position, m."""

    def take_velocity(self, velocity: Array, time: float) -> None:
        """Take a velocity (3,), m/s, at a time, s; a late velocity replaces no newer velocity."""
        if time >= self.velocity_time:
            self.velocity, self.velocity_time = velocity, time

    def take_position(self, position: ArrayLike | None, time: float, std: float,
                      max_age: float, displaced: Array | None = None) -> None:
        """
        Take a position (3,), m, at a time, s, with a standard deviation, m.

        :param max_age: of the velocity that the position is compared with, s.
        :param displaced: see ``Path.take``.
        """
        p = finite_vector(position)
        if p is not None and max(map(abs, p.tolist())) < SANE:
            fresh = time - self.velocity_time <= max_age
            self.position = p
            self.path.take(p, self.velocity if fresh else None, time, displaced)
            self.std = std if math.isfinite(std) else 0.0

    def take_yaw(self, yaw: float, time: float) -> None:
        """Take a yaw, rad, at a time, s; it replaces a yaw of the same time."""
        newest = self.yaws[-1][0] if self.yaws else -math.inf
        if not math.isfinite(yaw) or not time >= newest:
            return
        if time == newest:
            self.yaws[-1] = time, wrap_angle(yaw)
        else:
            self.yaws.append((time, wrap_angle(yaw)))
            while time - self.yaws[0][0] > YAW_MEMORY:
                self.yaws.popleft()

    def yaw(self, time: float = math.inf) -> tuple[float, float]:
        """Return the yaw, rad, nearest to a time, s, and its own time; by default the newest."""
        newest_time, newest = self.yaws[-1] if self.yaws else (-math.inf, 0.0)
        if not newest_time > time:
            return newest, newest_time
        yaws = tuple(self.yaws)  # a copy: diagnostics read it from another thread
        after = bisect_right(yaws, time, key=itemgetter(0))
        near = yaws[max(after - 1, 0):after + 1]
        return min(reversed(near), key=lambda known: abs(known[0] - time))[::-1]

    def motion(self, now: float, at: float = math.inf) -> SourceMotion:
        """Return the newest motion at ``now``, s, with the yaw that is nearest to a time, s."""
        yaw, _ = self.yaw(at)
        return SourceMotion(self.velocity, now - self.velocity_time, yaw, now - self.yaw()[1])


def find_displacement(odom: Source, autopilot: Source | None, turn: float, height: Path,
                      now: float) -> Refusal | None:
    """
    Return the difference if displacements of odometry and another source differ, or None.

    :param autopilot: None if its estimate is not independent of odometry.
    :param turn: yaw of odom minus that of the autopilot, rad.
    :param height: heights by the barometer.
    """
    refusal, std = None, min(odom.std, ODOMETRY_STD_MAX)
    if autopilot is not None:
        level = difference(odom.path, autopilot.path, -turn, now)[:2]
        refusal = _too_far(level, math.hypot(std, autopilot.std), 'autopilot')
    up = difference(odom.path, height, 0.0, now)[2:]
    return refusal or _too_far(up, math.hypot(std, BAROMETER_STD), 'barometer')


def _too_far(error: Array, std: float, other: str) -> Refusal | None:
    """Return the difference if it exceeds the limit for a standard deviation, both m, or None."""
    distance = math.sqrt(error.dot(error))
    return None if not distance > max(DISPLACEMENT_TOLERANCE, 3.0 * std) else Refusal(
        Obstacle.DISPLACED, f'displacements of odom and of the {other} differ by '
        f'{distance:.1f} m in {DISPLACEMENT_WINDOW:g} s')
