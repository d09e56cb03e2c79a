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
Decides whether to use a measured distance, and estimates the constant error of a series of them.

Noise makes a distance longer or shorter, but a detour of radio waves only makes it longer. So a
distance outside the gate that is too short is used with the weight of a distance on the gate; if
the next one is also too short, the prediction is wrong, and its variance is increased. A distance
that is too long is refused; after ``most`` refusals in a row the prediction is wrong.

``RangeBias`` learns the constant error (mostly antenna delays), a slow random walk, while the
marker gives the true distance.
"""

from __future__ import annotations

import math

#: chi^2 with 1 degree of freedom at a probability of 0.99: detours are frequent, ranges too.
RANGE_GATE = 6.63
#: A distance that is too short is refused, too, if its chi^2 is this many times the gate's.
RANGE_WILD = 10.0
#: Number of distances over which the refused share is reported.
COUNTED = 200
#: Before anything was learned, m: a standard deviation.
UNKNOWN_BIAS = 0.5
#: Random walk of the bias, m/sqrt(s).
WALK = 0.01


class RangeGate:
    """
    The gate of a series of distances.

    :param most: number of consecutive too long distances of which the last one is used.
    """

    def __init__(self, most: int = 6) -> None:
        self._most = most
        self._refused = self._judged = 0
        self._before = 0.0  # sign of the last one used, if it was outside
        self.outliers = 0.0
        """Share of recent distances that were refused."""

    def judge(self, innovation: float, spread: float) -> tuple[float, float] | None:
        """
        Judge a distance by its innovation, m, of variance ``spread``, m^2; None if it is refused.

        Return two factors: on the predicted variance, and then on the variance of the innovation,
        because the noise is larger.
        """
        doubt = innovation * innovation / (spread * RANGE_GATE)
        inside = doubt <= 1.0  # NaN is not
        enough = self._refused >= self._most - 1
        refused = not (inside or enough) and (innovation > 0.0 or not doubt <= RANGE_WILD)
        self._judged = min(self._judged + 1, COUNTED)
        self.outliers += (refused - self.outliers) / self._judged
        if refused or not math.isfinite(doubt):
            self._refused += refused
            return None
        side = 0.0 if inside else math.copysign(1.0, innovation)
        again, self._before = side == self._before, side
        if inside:
            self._refused = 0
            return 1.0, 1.0
        return (doubt, 1.0) if again or enough else (1.0, doubt)


class RangeBias:
    """The bias of a series of distances."""

    def __init__(self) -> None:
        self.value = 0.0
        """Bias, m."""
        self.gate = RangeGate()
        self._variance, self._stamp = UNKNOWN_BIAS**2, math.inf

    def variance(self, stamp: float) -> float:
        """Return the variance of the bias at a stamp, s, m^2."""
        return min(self._variance + WALK**2 * abs(stamp - self._stamp), UNKNOWN_BIAS**2)

    def learn(self, stamp: float, excess: float, noise: float) -> None:
        """
        Learn from a distance measured at a stamp, s, of a neighbor in sight.

        :param excess: measured distance minus the distance to the marker, m.
        :param noise: variance of this difference without the bias, m^2.
        """
        prior, innovation = self.variance(stamp), excess - self.value
        factors = self.gate.judge(innovation, prior + noise)
        if factors is None:
            return
        prior *= factors[0]
        gain = prior / (factors[1] * (prior + noise))
        # A larger assumed noise means a smaller gain: the bias is learned more slowly.
        self.value += gain * innovation
        self._variance, self._stamp = (1.0 - gain) * prior, stamp
