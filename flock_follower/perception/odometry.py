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
One's own odometry, remembered for a moment and interpolated to an image's stamp.

A position from visual-inertial odometry trembles and jumps with every correction; its velocity
does not. The buffer therefore keeps a second position, ``travel``, the integral of the velocity:
what is seen from there moves smoothly, and ``position - travel`` takes it back to odom.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from flock_follower.geometry import (
    Array,
    quaternion_multiply,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
    slerp,
    Transform,
)


@dataclass(frozen=True, eq=False)
class OdometrySample:
    """
    One's own state at a stamp, s.

    ``position`` (3,), m, and ``velocity`` (3,), m/s, in odom; ``quaternion`` (x, y, z, w) takes
    the body (FLU) to odom; ``angular_velocity`` (3,), rad/s, is in the body. ``travel`` (3,), m,
    is the integral of the velocity since the buffer began, filled in there.
    """

    stamp: float
    position: Array
    quaternion: Array
    velocity: Array
    angular_velocity: Array
    travel: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def smooth_pose(self) -> Transform:
        """Return the body's pose in the smooth frame: attitude as in odom, at ``travel``."""
        return Transform(quaternion_to_matrix(self.quaternion), self.travel)

    @property
    def correction(self) -> Array:
        """Return what takes positions (3,) in the smooth frame to odom, m."""
        correction: Array = self.position - self.travel
        return correction


class Missing(Enum):
    """Why there is no odometry for a stamp."""

    EMPTY = 'no odometry yet'
    TOO_NEW = 'odometry has not reached the image stamp'
    TOO_OLD = 'odometry does not reach back to the image stamp'
    GAP = 'odometry has a gap at the image stamp'


@dataclass(frozen=True)
class OdometryParams:
    """
    How far the buffer goes, s.

    ``horizon``: how long samples are kept. ``max_gap``: two samples further apart are not
    interpolated. ``max_extrapolation``: how far past the newest sample its velocities may carry.
    ``max_jump``: a stamp further back than this is a new start (a bag played again), not disorder.
    """

    horizon: float = 2.0
    max_gap: float = 0.1
    max_extrapolation: float = 0.03
    max_jump: float = 0.5

    def __post_init__(self) -> None:
        """Validate."""
        for name in ('horizon', 'max_gap', 'max_extrapolation', 'max_jump'):
            value = getattr(self, name)
            if not 0.0 <= value <= 60.0:
                raise ValueError(f'{name} = {value}: must be in [0, 60] s')


class OdometryBuffer:
    """The samples of the last moment, in the order of their stamps."""

    #: Samples kept at most, whatever their stamps: 2 s at 1 kHz.
    CAPACITY = 2000

    def __init__(self, params: OdometryParams | None = None) -> None:
        self.params = params or OdometryParams()
        self._samples: deque[OdometrySample] = deque(maxlen=self.CAPACITY)

    def __len__(self) -> int:
        """Return how many samples are held."""
        return len(self._samples)

    @property
    def newest(self) -> float | None:
        """Return the newest stamp, s, or None while empty."""
        return self._samples[-1].stamp if self._samples else None

    def add(self, sample: OdometrySample) -> bool:
        """
        Remember a sample; return whether time jumped back, and so all others were forgotten.

        A sample that is only late, or a repetition, is ignored.
        """
        jumped = False
        if self._samples and sample.stamp <= self._samples[-1].stamp:
            if self._samples[-1].stamp - sample.stamp <= self.params.max_jump:
                return False
            self._samples.clear()
            jumped = True
        self._samples.append(replace(sample, travel=self._travel(sample)))
        while sample.stamp - self._samples[0].stamp > self.params.horizon:
            self._samples.popleft()
        return jumped

    def _travel(self, sample: OdometrySample) -> Array:
        if not self._samples:
            return np.array(sample.position, dtype=float)
        last = self._samples[-1]
        dt = sample.stamp - last.stamp
        if dt > self.params.max_gap:  # velocities so far apart say little
            return last.travel + (sample.position - last.position)
        return last.travel + 0.5 * dt * (last.velocity + sample.velocity)

    def at(self, stamp: float, extrapolate: bool = True) -> OdometrySample | Missing:
        """
        Return the state at a stamp, s, or why there is none.

        Between two samples position and velocities are linear, the attitude follows the shorter
        arc; past the newest, its velocities carry on for at most ``max_extrapolation``.
        """
        if not self._samples:
            return Missing.EMPTY
        if stamp < self._samples[0].stamp:
            return Missing.TOO_OLD
        after = self._samples[-1]
        if stamp > after.stamp:
            ahead = stamp - after.stamp
            if not extrapolate or ahead > self.params.max_extrapolation:
                return Missing.TOO_NEW
            return _extrapolated(after, ahead)
        # Image stamps lie near the newest: a scan from there is a handful of steps.
        for before in reversed(self._samples):
            if before.stamp == stamp:
                return before
            if before.stamp < stamp:
                return (Missing.GAP if after.stamp - before.stamp > self.params.max_gap
                        else _interpolated(before, after, stamp))
            after = before
        return Missing.TOO_OLD


def _interpolated(a: OdometrySample, b: OdometrySample, stamp: float) -> OdometrySample:
    part = (stamp - a.stamp) / (b.stamp - a.stamp)

    def between(x: Array, y: Array) -> Array:
        mixed: Array = (1.0 - part) * x + part * y
        return mixed

    return OdometrySample(stamp, between(a.position, b.position),
                          slerp(a.quaternion, b.quaternion, part),
                          between(a.velocity, b.velocity),
                          between(a.angular_velocity, b.angular_velocity),
                          between(a.travel, b.travel))


def _extrapolated(a: OdometrySample, ahead: float) -> OdometrySample:
    turn = rotation_vector_to_quaternion(a.angular_velocity * ahead)
    step = ahead * a.velocity
    return OdometrySample(a.stamp + ahead, a.position + step,
                          quaternion_multiply(a.quaternion, turn), a.velocity,
                          a.angular_velocity, a.travel + step)
