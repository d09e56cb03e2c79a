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
Velocities derived from positions, and angular velocities from attitudes.

The same Kalman filter serves both: value, rate and acceleration along each axis, driven by white
jerk (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
section 6.2). The noise of what is measured is learnt from the innovations.
"""

from __future__ import annotations

import math

import numpy as np

from flock_follower.geometry import (
    Array,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_rotation_vector,
    rotation_vector_to_quaternion,
)

#: After a longer gap, s, a derivation begins anew.
LONGEST_GAP = 0.6
#: In which time the noise follows the innovations, s.
NOISE_TIME = 2.0


class _WhiteJerk:
    """What the axes of a vector share: covariance, gain, and the noise of a measurement."""

    #: Spectral density of the jerk, (unit/s^3)^2/Hz; deviations of a measurement: what it is taken
    #: for at first, the least and the most believed; of rate and acceleration at the start.
    jerk: float
    first_noise: float
    least_noise: float
    most_noise: float
    first_rate: float
    first_acceleration: float

    def __init__(self) -> None:
        self.stamp: float | None = None
        self.variance = self.first_noise**2
        """Of a measurement along an axis."""
        # Covariance along an axis: of value, rate, acceleration, the upper triangle row by row. In
        # plain numbers: at hundreds of messages per second matrices so small cost more.
        self._covariance = (0.0,) * 6

    def _begin(self, stamp: float) -> None:
        self.stamp = stamp
        self._covariance = (self.variance, 0.0, 0.0, self.first_rate**2, 0.0,
                            self.first_acceleration**2)

    def _predict(self, dt: float) -> float:
        """Carry the covariance on by dt, s; return the variance of an innovation there."""
        pp, pv, pa, vv, va, aa = self._covariance
        q = self.jerk * dt
        pp += dt * (2.0 * pv + dt * (pa + vv + dt * (va + dt * (aa / 4.0 + q / 20.0))))
        pv += dt * (vv + pa + dt * (1.5 * va + dt * (aa / 2.0 + q / 8.0)))
        pa += dt * (va + dt * (aa / 2.0 + q / 6.0))
        vv += dt * (2.0 * va + dt * (aa + q / 3.0))
        va += dt * (aa + q / 2.0)
        aa += q
        self._covariance = pp, pv, pa, vv, va, aa
        return pp + self.variance

    def _gains(self, stamp: float, dt: float, innovation: Array) -> tuple[float, float, float]:
        """Return what a unit of innovation adds to value, rate and acceleration; learn from it."""
        pp, pv, pa, vv, va, aa = self._covariance
        spread = pp + self.variance
        p, v, a = pp / spread, pv / spread, pa / spread
        self._covariance = (pp - p * pp, pv - p * pv, pa - p * pa, vv - v * pv, va - v * pa,
                            aa - a * pa)
        # One innovation far out is a jump, not noise.
        squared = float(innovation.dot(innovation)) / 3.0
        seen = min(squared, 16.0 * spread) - pp
        self.variance += min(1.0, dt / NOISE_TIME) * (seen - self.variance)
        self.variance = min(max(self.variance, self.least_noise**2), self.most_noise**2)
        self.stamp = stamp
        return p, v, a


class DerivedVelocity(_WhiteJerk):
    """
    The velocity of a point, from its positions.

    ``position`` (3,), m, ``velocity`` (3,), m/s, and ``acceleration`` (3,), m/s^2, are those at
    ``stamp``, s, in the frame of the positions.
    """

    jerk = 0.5
    first_noise, least_noise, most_noise = 0.003, 0.0003, 0.1
    first_rate, first_acceleration = 1.0, 2.0
    #: Positions closer together than this, s, tell nothing new: errors of a filter are not white.
    SHORTEST = 0.018
    #: So often they are: measured errors of the velocity, squared, are several times the filter's.
    CORRELATED = 4.0
    #: A position this many deviations from where it was expected is a step, not motion: a filter
    #: that corrects itself makes them. After some in a row it is motion after all.
    STEP = 4.0
    MOST_STEPS = 2
    #: That takes a velocity and a noise that are known: not before so many s.
    SETTLED = 0.5
    #: A position further than this, m, from where it was expected is a jump (REP-105 has them in
    #: ``map`` only, but sources with loop closure put them into ``odom``).
    JUMP = 0.3
    #: At a low rate the vehicle's own acceleration, m/s^2, is no jump.
    MOST_ACCELERATION = 10.0

    def __init__(self) -> None:
        super().__init__()
        self.position: Array = np.zeros(3)
        self.velocity: Array = np.zeros(3)
        self.acceleration: Array = np.zeros(3)
        self._steps = 0
        self._start = 0.0

    @property
    def variance_of_velocity(self) -> float:
        """Return the variance of the velocity along an axis, (m/s)^2."""
        return self.CORRELATED * self._covariance[3]

    def velocity_at(self, stamp: float) -> Array:
        """Return the velocity (3,), m/s, at a stamp, s, soon after the newest position."""
        return self.velocity + (stamp - (self.stamp or stamp)) * self.acceleration

    def take(self, stamp: float, position: Array) -> float:
        """Take a position; return how far it jumped, m, else 0."""
        dt = LONGEST_GAP + 1.0 if self.stamp is None else stamp - self.stamp
        if not 0.0 < dt <= LONGEST_GAP:
            self._restart(stamp, position)
            return 0.0
        if dt < self.SHORTEST:
            return 0.0
        expected = self.position + dt * self.velocity + 0.5 * dt * dt * self.acceleration
        innovation = position - expected
        off = float(np.abs(innovation).max())
        far = off > self.JUMP + 0.5 * self.MOST_ACCELERATION * dt * dt
        settled = stamp - self._start > self.SETTLED
        step = (off > self.STEP * math.sqrt(self._predict(dt)) and settled) or far
        often = self._steps >= self.MOST_STEPS
        self._steps = self._steps + 1 if step else 0
        if far and often:
            self._restart(stamp, position)
            return off
        self.velocity = self.velocity + dt * self.acceleration
        if step and not often:
            # The motion goes on, from another place.
            self._covariance = self.variance, 0.0, 0.0, *self._covariance[3:]
            self.stamp, self.position = stamp, position
            return off if far else 0.0
        p, v, a = self._gains(stamp, dt, innovation)
        self.position = expected + p * innovation
        self.velocity = self.velocity + v * innovation
        self.acceleration = self.acceleration + a * innovation
        return 0.0

    def _restart(self, stamp: float, position: Array) -> None:
        self._begin(stamp)
        self._start = stamp
        self.position, self._steps = position, 0
        self.velocity, self.acceleration = np.zeros(3), np.zeros(3)


class DerivedRates(_WhiteJerk):
    """
    The angular velocity of a body, from its attitudes.

    ``quaternion`` (x, y, z, w) takes the body to odom; ``rates`` (3,), rad/s, and ``acceleration``
    (3,), rad/s^2, are in the body, at ``stamp``, s.
    """

    jerk = 300.0
    first_noise, least_noise, most_noise = 0.001, 0.0001, 0.05
    first_rate, first_acceleration = 1.0, 5.0

    def __init__(self) -> None:
        super().__init__()
        self.quaternion: Array = np.array([0.0, 0.0, 0.0, 1.0])
        self.rates: Array = np.zeros(3)
        self.acceleration: Array = np.zeros(3)

    def take(self, stamp: float, quaternion: Array) -> None:
        """Take an attitude."""
        dt = LONGEST_GAP + 1.0 if self.stamp is None else stamp - self.stamp
        if not 0.0 < dt <= LONGEST_GAP:
            self._begin(stamp)
            self.quaternion, self.rates = quaternion, np.zeros(3)
            self.acceleration = np.zeros(3)
            return
        turn = dt * self.rates + 0.5 * dt * dt * self.acceleration
        expected = quaternion_multiply(self.quaternion, rotation_vector_to_quaternion(turn))
        innovation = quaternion_to_rotation_vector(
            quaternion_multiply(quaternion_conjugate(expected), quaternion))
        self._predict(dt)
        p, v, a = self._gains(stamp, dt, innovation)
        self.quaternion = quaternion_multiply(
            expected, rotation_vector_to_quaternion(p * innovation))
        self.rates = self.rates + dt * self.acceleration + v * innovation
        self.acceleration = self.acceleration + a * innovation
