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
How much measurements err beyond what a fit to the image can know, learnt from what they do.

Across the line of sight it is one's own attitude, which moves a neighbour sideways as it errs from
one image to the next: that of the odometry, of its interpolation, of the camera's stamps. Along it
is all that makes a marker look larger or smaller: a rolling shutter, a bent print, motion blur.
What innovations are off in either direction, and more than expected, is that noise.
"""

from __future__ import annotations

import math

import numpy as np

from flock_follower.geometry import Array, skew

#: Innovations over which the noise is learnt; at first over as many as there were, and these.
LEARNT = 120
FIRST = 15
#: An innovation counts at most with so many times its variance: one far out is a slip.
LIMIT = 16.0
#: The most that is believed, rad, and as share of the distance.
MOST = 0.05

_LEVERAGE = np.concatenate([np.zeros((3, 3)), np.eye(3)])


class LearntNoise:
    """
    The noise of one's own attitude, rad, about each axis, and of the distance, a share of it.

    :param least: what that of the attitude is at least, and at first; that of the distance is 0.
    """

    def __init__(self, least: float) -> None:
        self._least = least**2
        self.restart()

    def restart(self) -> None:
        """Forget what was learnt."""
        self._across, self._along = self._least, 0.0
        self._count = FIRST

    @property
    def attitude(self) -> float:
        """Return the noise of one's own attitude, one standard deviation, rad."""
        return math.sqrt(self._across)

    @property
    def distance(self) -> float:
        """Return the noise of the distance, one standard deviation, a share of it."""
        return math.sqrt(self._along)

    def covariance(self, sight: Array) -> Array:
        """Return what it adds to a pose measured so far away (3,), m: (6, 6)."""
        # An attitude error e turns what is seen about oneself: it moves a marker at r by e x r,
        # and tilts it by e.
        leverage = _LEVERAGE.copy()
        leverage[:3] = skew(-sight)
        covariance: Array = leverage.dot(self._across * leverage.T)
        if self._along:
            covariance[:3, :3] += self._along * sight[:, None] * sight
        return covariance

    def take(self, innovation: Array, spread: Array, sight: Array) -> None:
        """
        Take an innovation of a position (3,), m, of covariance (3, 3), and the way there (3,), m.

        The covariance holds the noise as it is now.
        """
        # In plain numbers: for every image, and so small.
        (x, y, z), (u, v, w) = sight.tolist(), innovation.tolist()
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = spread.tolist()
        squared = x * x + y * y + z * z
        along = (x * u + y * v + z * w)**2 / squared
        expected = (x * x * xx + y * y * yy + z * z * zz
                    + 2.0 * (x * y * xy + x * z * xz + y * z * yz)) / squared
        across, across_expected = u * u + v * v + w * w - along, xx + yy + zz - expected
        self._count = min(self._count + 1, LEARNT)
        # Two axes across, each off by the noise times the distance.
        for_attitude = _excess(across, across_expected) / (2.0 * squared * self._count)
        for_distance = _excess(along, expected) / (squared * self._count)
        self._across = min(max(self._across + for_attitude, self._least), MOST**2)
        self._along = min(max(self._along + for_distance, 0.0), MOST**2)


def _excess(squared: float, expected: float) -> float:
    return min(squared, LIMIT * expected) - expected
