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
The vehicle's motion by odometry and by the autopilot, as the gate receives it.

``MotionSources`` stores the newest motion of both sources, chooses the source with which commands
are checked, and compares the sources, see ``velocity_check``.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.obstacle import Obstacle, Refusal
from flock_follower.gate.velocity_check import (
    AUTOPILOT,
    DISPLACED_HANDOVER_TIME,
    find_displacement,
    finite_vector,
    known_motion,
    KnownMotion,
    MotionReport,
    ODOM,
    Path,
    PATH_GAP,
    plausible_velocity,
    refusal,
    rotate_about_vertical,
    Source,
    Velocity,
    VelocityComparison,
)
from flock_follower.geometry import Array

#: Mean age of odometry at decisions, s, above which it is late. At 0.2 s the height of an
#: ArduCopter that fused it swung more and more.
LATE_AGE: Final[float] = 0.15
#: Share of each decision in that mean: 5 s at 20 Hz.
AGE_SHARE: Final[float] = 0.01
VELOCITY_SOURCES: Final[tuple[str, ...]] = (ODOM, AUTOPILOT, 'auto')


def onset(since: float, holds: bool, now: float) -> float:
    """Return the time since which a condition has been true, s; infinite while it is false."""
    return min(since, now) if holds else math.inf


class MotionSources:
    """
    The newest motion by both sources; times are monotonic, s.

    :param choice: the source with which commands are checked, one of ``VELOCITY_SOURCES``; 'auto'
        is odom once odom was received.
    """

    def __init__(self, choice: str) -> None:
        self.climb_rate_error = 0.0
        """Error of the vertical velocity of odom by the barometer, m/s; 0 if not to be removed."""
        self.displaced: Refusal | None = None
        """The difference of the displacements of both sources as a text, if they differ."""
        self._choice = choice
        self._sources = {ODOM: Source(), AUTOPILOT: Source()}
        self._height_path = Path()
        self._handed_on: Array | float = 0.0  # m, from the position of odom to the path followed
        self._mean_age = 0.0
        self._comparison = VelocityComparison()
        self._distrusted_since = math.inf
        self._displaced_since = math.inf

    @property
    def source(self) -> str:
        """Return the source with which commands are checked now."""
        if self._choice in (ODOM, AUTOPILOT):
            return self._choice
        # Once odometry was received, losing it must brake: the autopilot's own estimate often
        # rests on that odometry, and drifts meters without it.
        return ODOM if math.isfinite(self._sources[ODOM].velocity_time) else AUTOPILOT

    @property
    def odometry(self) -> Source:
        """Return the motion by odometry."""
        return self._sources[ODOM]

    @property
    def position(self) -> Array | None:
        """Return the position, (3,), m, by the source, without its jumps; None if unknown."""
        position = self._sources[self.source].path.position
        return None if position is None else position + self._handed_on

    def take(self, source: str, report: MotionReport, age: float, max_age: float,
             now: float) -> str:
        """Take a report of an age, s, at most ``max_age``; return '' or why it is refused."""
        v, known = plausible_velocity(report.velocity), self._sources[source]
        if v is None:
            return 'not finite' if finite_vector(report.velocity) is None else 'too fast'
        if not (refused := refusal(age, max_age)):
            by, before = self.source, self._sources[self.source].path.position
            time = now - max(age, 0.0)
            known.take_velocity(v, time)
            known.take_yaw(report.yaw, time)
            known.take_position(report.position, time, report.std, max_age, (
                self._displacement_in_gap(report.yaw, time) if source == ODOM else None))
            now_at = self.position if by != self.source else None
            if before is not None and now_at is not None:
                # Odometry takes over, in a frame of its own: the vehicle has not moved by that.
                self._handed_on = before + self._handed_on - now_at
        return refused

    def _displacement_in_gap(self, yaw: float, time: float) -> Array | None:
        """
        Return the autopilot's displacement (3,), m, during a gap of odom, in the frame of odom.

        :param yaw: the newest by odom, rad; :param time: its time, s.
        :returns: None without a gap, or if the displacement or the turn of the frames is unknown.
        """
        autopilot, begun = self._sources[AUTOPILOT], self._sources[ODOM].path.time
        if not time - begun > PATH_GAP:  # most often
            return None
        (first, last), (other_yaw, known_at) = autopilot.path.span, autopilot.yaw(time)
        if not (time - min(last, known_at) <= PATH_GAP and first <= begun and (
                math.isfinite(yaw))):
            return None
        return rotate_about_vertical(
            autopilot.path.displacement(begun, min(time, last)), yaw - other_yaw)

    def take_position(self, source: str, position: ArrayLike, time: float,
                      max_age: float) -> None:
        """Take a position (3,), m, at a time, s; see ``Source.take_position`` for ``max_age``."""
        self._sources[source].take_position(position, time, 0.0, max_age)

    def take_yaw(self, source: str, yaw: float, time: float) -> None:
        """Take the vehicle's yaw, rad, ENU, at a time, s."""
        self._sources[source].take_yaw(yaw, time)

    def take_height(self, height: float, now: float) -> None:
        """Take a height by the barometer, m."""
        self._height_path.take(np.array([0.0, 0.0, height]), None, now)

    def forget_heights(self) -> None:
        """Forget the heights, because the sensor has jumped."""
        self._height_path = Path()

    def fresh_yaw(self, max_age: float, now: float) -> float | None:
        """Return the autopilot's yaw, rad; if it is not fresh, odom's yaw, or None."""
        yaws = (self._sources[source].yaw() for source in (AUTOPILOT, ODOM))
        return next((yaw for yaw, time in yaws if now - time <= max_age), None)

    def best_velocity(self, limits: GateLimits, now: float) -> Velocity | None:
        """Return the velocity by the chosen source, else the velocity for braking, else None."""
        by_source = self._sources[self.source].motion(now).fresh_velocity(limits)
        return by_source or self.known_motion(limits, now).braking

    def known_motion(self, limits: GateLimits, now: float) -> KnownMotion:
        """Return the known motion at ``now``, s."""
        odom, autopilot = self._sources[ODOM], self._sources[AUTOPILOT]
        _, yaw_time = odom.yaw()
        by_odom = odom.motion(now)
        by_odom = by_odom._replace(
            velocity=by_odom.velocity + np.array([0.0, 0.0, self.climb_rate_error]))
        # Compared at the same time: at 1 rad/s odometry 0.25 s late would differ by 0.25 rad.
        return known_motion(
            limits, by_odom, autopilot.motion(now, yaw_time), source=self.source,
            disagreeing_for=self._comparison.disagreeing_for(now),
            distrusted_for=now - self._distrusted_since)

    def compare(self, limits: GateLimits, engaged: bool, distrusted: bool, fused: bool,
                now: float) -> KnownMotion:
        """
        Compare the velocities and displacements; return the known motion.

        :param engaged: whether the vehicle flies with these velocities.
        :param distrusted: whether the velocity of the autopilot is invalid.
        :param fused: whether the autopilot's estimate uses our odometry.
        """
        self._distrusted_since = onset(self._distrusted_since, distrusted, now)
        known, before = self.known_motion(limits, now), self._comparison.disagreeing_for(now)
        self._comparison.take(known.difference, limits.velocity_tolerance, engaged, now)
        age = now - self._sources[ODOM].velocity_time if engaged and math.isfinite(
            self._sources[ODOM].velocity_time) else 0.0
        self._mean_age += AGE_SHARE * (age - self._mean_age)
        # An estimate that rests on our odometry, or on no sensor, is no evidence.
        proves = not fused and not distrusted
        self.displaced = None if known.source != ODOM else find_displacement(
            self._sources[ODOM], self._sources[AUTOPILOT] if proves else None,
            known.turned or 0.0, self._height_path, now)
        self._displaced_since = onset(
            self._displaced_since, engaged and self.displaced is not None, now)
        return known if self._comparison.disagreeing_for(now) == before else (
            self.known_motion(limits, now))

    def displaced_too_long(self, now: float) -> bool:
        """Return whether displacements have differed for so long that the vehicle must stop."""
        return now - self._displaced_since > DISPLACED_HANDOVER_TIME

    def lateness(self) -> str:
        """Return that odometry is late at the decisions of this flight, or ''."""
        return '' if self._mean_age <= LATE_AGE else (
            f'odometry is {self._mean_age:.2f} s old when setpoints are decided, above '
            f'{LATE_AGE:g} s: the height can swing; end other programs, or reduce its latency')

    def contradiction(self, limits: GateLimits, now: float) -> str:
        """Return the contradiction between odom and the autopilot as text, or ''."""
        known = self.known_motion(limits, now)
        cause, turned = known.contradiction, math.degrees(known.turned or 0.0)
        if cause is Obstacle.YAWS_DISAGREE:
            return (f'{cause.value} by {turned:.0f} deg: their frames are not aligned, commands '
                    'would go the wrong way')
        if cause is Obstacle.VELOCITIES_DISAGREE:
            return (f'{cause.value} by {self._comparison.difference:.2f} m/s, more than '
                    f'{limits.velocity_tolerance:.2f} m/s (velocity_disagreement)')
        # Displacements are compared in each cycle.
        return '' if self.displaced is None else str(self.displaced)
