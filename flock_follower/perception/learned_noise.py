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
Noise learned from innovations in flight: of the measurements, and of a neighbor's motion.

If the assumed noises are right, the innovations of a Kalman filter are white and have the expected
covariance. Unmodeled motion correlates successive innovations; white measurement noise does not.
So half the squared difference of two successive innovations measures the noise of the
measurements, and their mean over ``MEAN_TIME`` measures the motion (Mehra, "On the identification
of variances and adaptive Kalman filtering", IEEE Trans. Automatic Control, 1970).

``LearnedNoise``: across the line of sight, the noise is the error of the ego attitude, which moves
a neighbor sideways: errors of the odometry, of its interpolation and of the camera's stamps.
Along the line of sight, the noise is anything that changes the marker's apparent size: a rolling
shutter, a bent print, motion blur. The covariances of measured poses are increased, because the
errors of adjacent edges may be correlated; the innovations show which increase is needed.

``LearnedMotion``: factors on the process noise of ``FilterParams``, along each axis of odom. They
adapt to the motion of a neighbor, and to the errors of the ego velocity.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from flock_follower.geometry import Array, skew
from flock_follower.perception.measurement import DEVIATION_FACTOR

#: Innovations over which the noise is learned.
LEARNED = 120
#: Initial count of innovations.
FIRST = 15
#: The square of an innovation is limited to this many times its variance.
LIMIT = 16.0
#: Largest value that is used, rad, and as share of the distance.
MOST = 0.05
#: Lower limit of the variance of the attitude, as share of the initial one.
LEAST = 0.04
#: Lower limit of the shares of a measured pose's variances. It is not that of independent edges: a
#: marker seen from the front errs now and then by more, and alike for some images.
LEAST_SHARE = 1.0 / DEVIATION_FACTOR
#: From a turn to the change of a measured pose, of which the upper half depends on the sight.
_LEVERAGE = np.concatenate([np.zeros((3, 3)), np.eye(3)])


class LearnedNoise:
    """
    The noise of the ego attitude, rad, about each axis, and of the distance, as a share of it.

    ``shares`` says which shares of the variances of a measured position and attitude are noise.

    :param initial: initial noise of the attitude, rad; the noise of the distance starts at 0.
    """

    def __init__(self, initial: float) -> None:
        self._initial = initial**2
        self.restart()

    def restart(self) -> None:
        """Reset the estimates."""
        self._across, self._along = self._initial, 0.0
        self.shares = [1.0, 1.0]
        self._count = FIRST

    @property
    def attitude(self) -> float:
        """Return the noise of the ego attitude, one standard deviation, rad."""
        return math.sqrt(self._across)

    @property
    def distance(self) -> float:
        """Return the noise of the distance, one standard deviation, a share of it."""
        return math.sqrt(self._along)

    @property
    def scales(self) -> tuple[float, float]:
        """Return the factors on the deviations of a measured position and attitude."""
        place, turn = self.shares
        return math.sqrt(place), math.sqrt(turn)

    def covariance(self, sight: Array) -> Array:
        """Return the covariance, (6, 6) that it adds to a pose measured at ``sight`` (3,), m."""
        # An attitude error e turns all measurements about the ego vehicle: it moves a marker at r
        # by e x r, and tilts it by e.
        leverage = _LEVERAGE.copy()
        leverage[:3] = skew(-sight)
        covariance: Array = leverage.dot(self._across * leverage.T)
        if self._along:
            covariance[:3, :3] += self._along * sight[:, None] * sight
        return covariance

    def take(self, change: Array, expected: Array, sight: Array) -> None:
        """
        Take the change of an innovation, as in ``neighbor_filter.Change``.

        :param sight: from the ego vehicle to the neighbor (3,), m.
        """
        # In plain numbers: for every image, and so small.
        (x, y, z), (u, v, w, *turn) = sight.tolist(), change.tolist()
        rows = expected.tolist()
        (xx, xy, xz, *_), (_, yy, yz, *_), (_, _, zz, *_) = rows[:3]
        squared = x * x + y * y + z * z
        along = (x * u + y * v + z * w)**2 / squared
        variance = (x * x * xx + y * y * yy + z * z * zz
                    + 2.0 * (x * y * xy + x * z * xz + y * z * yz)) / squared
        across, across_variance = u * u + v * v + w * w - along, xx + yy + zz - variance
        self._count = min(self._count + 1, LEARNED)
        # Two axes across, each off by the noise times the distance, in two innovations.
        for_attitude = _excess(across, across_variance) / (4.0 * squared * self._count)
        self._across = min(max(self._across + for_attitude, LEAST * self._initial), MOST**2)
        # Noise of the distance is added only once all of the measured variance is noise.
        if self._along or (self.shares[0] == 1.0 and along > variance):
            for_distance = _excess(along, variance) / (2.0 * squared * self._count)
            self._along = min(max(self._along + for_distance, 0.0), MOST**2)
        else:
            self._share(0, along, variance)
        if turn:
            a, b, c = turn
            self._share(1, a * a + b * b + c * c, rows[3][3] + rows[4][4] + rows[5][5])

    def _share(self, which: int, squared: float, expected: float) -> None:
        """Learn one of the shares from the square of a change and its expected value."""
        share = self.shares[which] * (1.0 + (squared / expected - 1.0) / self._count)
        self.shares[which] = min(max(share, LEAST_SHARE), 1.0)


def _excess(squared: float, expected: float) -> float:
    return min(squared, LIMIT * expected) - expected


#: Time constant of the mean innovation, s.
MEAN_TIME: Final = 0.25
#: Time constant of the noise that the mean innovation is compared with, s.
NOISE_TIME: Final = 2.0
#: Time constant of the learned motion, s.
MOTION_TIME: Final = 2.0
#: Limit of the surplus of one image.
STRONGEST: Final = 4.0
#: Limits of the factor.
FACTORS: Final = (0.2, 16.0)
#: After a longer gap, s, the step is not learned: the mean restarts, and the factor is at least 1,
#: so ``FilterParams`` holds.
LEARNING_GAP: Final = 0.3


class LearnedMotion:
    """Factors of the spectral densities of a neighbor's motion, for each axis of odom."""

    def __init__(self) -> None:
        self.factors = [1.0] * 3
        self._means = [0.0] * 3
        self._noises = [1.0] * 3
        self._before = [0.0] * 3
        self._share = 0.0  # variance of the means if innovations are white, of variance 1

    def scale(self, dt: float) -> list[float]:
        """Return the factor, by axis, on the covariance that dt, s, adds."""
        least = 0.0 if abs(dt) <= LEARNING_GAP else 1.0
        return [max(factor, least) for factor in self.factors]

    def take(self, dt: float, innovation: Array, expected: Array) -> None:
        """
        Take an innovation of the position (3,), m, and its expected covariance (3, 3).

        :param dt: time since the previous innovation, s.
        """
        if dt > LEARNING_GAP:
            self._share, self._means = 0.0, [0.0] * 3
        weight = min(dt / MEAN_TIME, 0.5)
        self._share = (1.0 - weight)**2 * self._share + weight**2
        variances = expected.diagonal().tolist()
        for k, (off, variance) in enumerate(zip(innovation.tolist(), variances)):
            off = min(max(off / math.sqrt(variance), -STRONGEST), STRONGEST)
            if dt <= LEARNING_GAP:
                self._noises[k] += min(dt / NOISE_TIME, 1.0) * (
                    0.5 * (off - self._before[k])**2 - self._noises[k])
            self._before[k] = off
            self._means[k] += weight * (off - self._means[k])
            surplus = self._means[k]**2 / (self._share * max(self._noises[k], 0.05)) - 1.0
            factor = self.factors[k] * math.exp(
                min(dt, LEARNING_GAP) / MOTION_TIME * min(surplus, STRONGEST))
            self.factors[k] = min(max(factor, FACTORS[0]), FACTORS[1])
