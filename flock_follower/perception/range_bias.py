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
By how much ranging is wrong all the time: learnt while the marker tells the true distance.

The bias (antenna delays, mostly) walks slowly at random. All arrays are (n,).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flock_follower.geometry import Array
from flock_follower.perception.range_gate import RangeGate

#: Before anything was learnt, m: a standard deviation.
UNKNOWN = 0.5
#: How the bias wanders, m/sqrt(s).
WALK = 0.01


class RangeBias:
    """The biases of n series of distances."""

    def __init__(self, count: int = 1) -> None:
        self.value: Array = np.zeros(count)
        """m."""
        self._variance: Array = np.full(count, UNKNOWN ** 2)
        self._stamp: Array = np.full(count, np.nan)
        self._gate = RangeGate(count)

    @property
    def outliers(self) -> Array:
        """Return which share of the distances fitted the marker's so badly that it was refused."""
        return self._gate.outliers

    def variance(self, stamp: float) -> Array:
        """Return how sure the biases are at a stamp, s: variances, m^2."""
        since = np.nan_to_num(np.abs(stamp - self._stamp))
        return np.minimum(self._variance + WALK ** 2 * since, UNKNOWN ** 2)

    def learn(self, stamp: float, excess: Array, noise: Array, given: Any = True) -> None:
        """
        Learn from distances measured at a stamp, s, of neighbours in sight.

        :param excess: measured distance less that to the marker, m.
        :param noise: variances of their difference but for the bias, m^2.
        """
        prior = self.variance(stamp)
        innovation = excess - self.value
        used, widened, careful = self._gate.judge(innovation, prior + noise, given)
        prior = prior * widened
        gain = prior / (careful * (prior + noise))
        # Where the noise is taken for larger, the gain is less, and less is learnt.
        self.value = np.where(used, self.value + gain * innovation, self.value)
        self._variance = np.where(used, (1.0 - gain) * prior, self._variance)
        self._stamp = np.where(used, stamp, self._stamp)
