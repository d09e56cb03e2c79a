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
What is known of the vehicle's motion, by odometry and by the autopilot, and what to believe of it.

A velocity is believed while it is fresh and finite, and nothing contradicts it: braking on a wrong
one speeds the vehicle up. Yaws tell whether the frames of both are turned against one another.
Vectors are ENU; what is known is a value, and no clock is read.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, wrap_angle
from flock_follower.mavlink.gate_limits import GateLimits

#: A stamp may lie this far in the future, s: clocks and ``/clock`` come in steps.
FUTURE_TOLERANCE: Final[float] = 0.1
#: The stream stops this long, s, after a velocity that is told could no longer be believed. Where
#: none is told at all, the whole computer may have stood still: that is ``blind_timeout``.
LOSS_TIMEOUT: Final[float] = 0.6
#: ``brake_time`` and ``speed_horizon`` allow for velocities of up to this age, s.
USUAL_AGE: Final[float] = 0.05
#: Age beyond that lengthens both by this factor times it. Braking on a velocity that is d late is
#: the loop v' = -v(t - d) / T: it swings for ever at T = 2 d / pi, and not at all from T = e d on.
LATE_FACTOR: Final[float] = math.e
ODOM: Final[str] = 'odom'
AUTOPILOT: Final[str] = 'autopilot'
VELOCITIES_DISAGREE: Final[str] = 'velocities of odom and of the autopilot disagree'


class Velocity(NamedTuple):
    """A velocity that is fresh and finite."""

    vector: Array
    """(3,), m/s."""
    margin: float
    """By how much its age prolongs time constants, s."""


class Motion(NamedTuple):
    """What one source says of the vehicle's motion; an age is infinite where it never said."""

    velocity: ArrayLike = (0.0, 0.0, 0.0)
    """(3,), m/s."""
    velocity_age: float = math.inf
    """s."""
    yaw: float = 0.0
    """rad."""
    yaw_age: float = math.inf
    """s."""

    def fresh_velocity(self, limits: GateLimits) -> Velocity | None:
        """Return the velocity; None where it is not fresh, or not three finite numbers."""
        if not fresh(self.velocity_age, limits.odom_timeout):
            return None
        vector = finite_vector(self.velocity)
        margin = LATE_FACTOR * max(self.velocity_age - USUAL_AGE, 0.0)
        return None if vector is None else Velocity(vector, margin)

    def fresh_yaw(self, limits: GateLimits) -> float | None:
        """Return the yaw, rad; None where it is not fresh, or not finite."""
        usable = fresh(self.yaw_age, limits.odom_timeout) and math.isfinite(self.yaw)
        return self.yaw if usable else None


UNKNOWN: Final[Motion] = Motion()


@dataclass(frozen=True, kw_only=True)
class KnownMotion:
    """What both sources say of the vehicle's motion, and since when not to believe them."""

    odom: Motion
    """By the odometry."""
    autopilot: Motion
    """By the autopilot's own estimate."""
    source: str
    """'odom' or 'autopilot': whose velocity judges a command and has to be fresh."""
    disagreeing_for: float = -math.inf
    """How long ago the velocities began to disagree, s; negative: they agree."""
    distrusted_for: float = -math.inf
    """For how long the autopilot has told a velocity that nothing carries, s."""

    @property
    def source_first(self) -> tuple[Motion, Motion]:
        """Return the motion by the source, then the one by the other."""
        if self.source == ODOM:
            return self.odom, self.autopilot
        return self.autopilot, self.odom

    def braking_velocity(self, limits: GateLimits) -> Velocity | None:
        """Return the velocity to brake with; None where none is fresh, or two disagree."""
        first, second = self.source_first
        if self.yaws_disagree(limits):
            # The autopilot's own frame is the one in which it obeys.
            first, second = self.autopilot, self.odom
        elif self.disagreeing_for >= 0.0:
            return None  # one of them is wrong: braking on that one would speed the vehicle up
        velocity = first.fresh_velocity(limits)
        return second.fresh_velocity(limits) if velocity is None else velocity

    def blind(self, limits: GateLimits) -> bool:
        """Return whether there was no velocity to believe for too long, after there was one."""
        if self.braking_velocity(limits) is not None:
            return False
        if self.disagreeing_for > LOSS_TIMEOUT or self.distrusted_for > LOSS_TIMEOUT:
            return True
        ages = [age for age in (self.odom.velocity_age, self.autopilot.velocity_age)
                if math.isfinite(age)]
        # None was ever known where the vehicle is still on the ground.
        return bool(ages) and min(ages) > limits.odom_timeout + limits.blind_timeout

    def contradiction(self, limits: GateLimits) -> str:
        """Return what odom and the autopilot disagree about, or ''."""
        if self.yaws_disagree(limits):
            return 'yaws of odom and of the autopilot disagree'
        return VELOCITIES_DISAGREE if self.disagreeing_for >= 0.0 else ''

    def yaws_disagree(self, limits: GateLimits) -> bool:
        """Return whether the frames are turned against one another: braking would accelerate."""
        turned = self.yaw_difference(limits)
        return turned is not None and abs(turned) > limits.yaw_disagreement

    def yaw_difference(self, limits: GateLimits) -> float | None:
        """Return the yaw of odom minus that of the autopilot, rad; None where one is not fresh."""
        mine, own = self.odom.fresh_yaw(limits), self.autopilot.fresh_yaw(limits)
        return None if mine is None or own is None else wrap_angle(mine - own)

    def velocity_difference(self, limits: GateLimits) -> Array | None:
        """Return by what (3,), m/s, odom, being the source, is faster; None unless both fresh."""
        mine, own = self.odom.fresh_velocity(limits), self.autopilot.fresh_velocity(limits)
        if self.source != ODOM or mine is None or own is None:
            return None
        with np.errstate(over='ignore'):
            return mine.vector - own.vector


def fresh(age: float, timeout: float) -> bool:
    """Return whether an age, s, is neither too old, nor in the future, nor NaN."""
    return -FUTURE_TOLERANCE <= age <= timeout


def finite_vector(value: ArrayLike) -> Array | None:
    """Return a copy as an array (3,), None where it is not three finite numbers."""
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return vector if vector.shape == (3,) and np.all(np.isfinite(vector)) else None
