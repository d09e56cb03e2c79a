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
Whether to believe a measured distance: noise is even, what radio waves add on a detour is not.

A distance outside the gate is neither believed as it is nor refused for ever. One that is too
short gets the weight that puts it on the gate; where the next one is too short as well, what was
predicted is wrong, and is taken for less certain. One that is too long is refused, as reflections
only lengthen, until ``most`` in a row are: then it is the prediction that is wrong.

All arrays are (n,): distances to n neighbours, or of n runs of a simulation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flock_follower.geometry import Array

#: chi^2 with 1 degree of freedom at a probability of 0.99: detours are frequent, ranges too.
GATE = 6.63
#: One that is too short is refused, too, where its chi^2 is so many times the gate's.
WILD = 10.0
#: Of how many distances the share that is refused is told.
COUNTED = 200


class Verdict(NamedTuple):
    """What to do with measured distances, (n,) each."""

    used: Any
    """Whether to use it."""
    prior: Array
    """By what to multiply the variances of what was predicted."""
    spread: Array
    """By what to multiply, after that, the variance of the innovation: the noise is larger."""


class RangeGate:
    """
    The gate of n series of distances.

    :param most: so many in a row are refused, less one.
    """

    def __init__(self, count: int = 1, most: int = 6) -> None:
        self._most = most
        self._refused: Any = np.zeros(count, dtype=int)
        self._before: Array = np.zeros(count)  # sign of the last one used, where it surprised
        self._judged: Any = np.zeros(count, dtype=int)
        self.outliers: Array = np.zeros(count)
        """Which share of the distances was refused of late."""

    def restart(self, which: Any) -> None:
        """Forget what surprised of some (n,) bool, but not how many are refused."""
        self._refused[which] = 0
        self._before[which] = 0.0

    def judge(self, innovation: Array, spread: Array, given: Any = True) -> Verdict:
        """
        Judge distances by their innovations, m, of variances ``spread``, m^2.

        :param given: which there are; of the others nothing changes, and none is used.
        """
        doubt = innovation ** 2 / (spread * GATE)
        inside = doubt <= 1.0  # NaN is not
        refused = ~inside & (self._refused < self._most - 1) & (
            (innovation > 0.0) | ~(doubt <= WILD))
        used = given & ~refused & np.isfinite(doubt)
        side = np.where(inside, 0.0, np.sign(innovation))
        again = used & ~inside & ((side == self._before) | (self._refused >= self._most - 1))
        self._refused = np.where(given & refused, self._refused + 1,
                                 np.where(used & inside, 0, self._refused))
        self._before = np.where(used, side, self._before)
        self._judged = np.minimum(self._judged + given, COUNTED)
        self.outliers = np.where(given, self.outliers + (refused - self.outliers) / np.maximum(
            self._judged, 1), self.outliers)
        return Verdict(used, np.where(again, doubt, 1.0),
                       np.where(used & ~inside & ~again, doubt, 1.0))
