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
Decides whether to use a measured distance.

Noise has two signs, but a detour of radio waves only lengthens. A distance outside the gate that
is too short gets the weight that puts it on the gate; if the next one is too short, too, the
prediction is wrong, and its variance is raised. A distance that is too long is refused, until
``most`` in a row were: then the prediction is wrong. Arrays are (n,): distances to n neighbours,
or of n runs of a simulation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flock_follower.geometry import Array

#: chi^2 with 1 degree of freedom at a probability of 0.99: detours are frequent, ranges too.
RANGE_GATE = 6.63
#: A distance that is too short is refused, too, if its chi^2 is this many times the gate's.
RANGE_WILD = 10.0
#: Number of distances over which the refused share is reported.
COUNTED = 200


class Verdict(NamedTuple):
    """The treatment of measured distances, (n,) each."""

    used: Any
    """Whether to use it."""
    prior: Array
    """Factor on the predicted variances."""
    spread: Array
    """Factor on the variance of the innovation after that: the noise is larger."""


class RangeGate:
    """
    The gate of n series of distances.

    :param most: at most one less than this number is refused in a row.
    """

    def __init__(self, count: int = 1, most: int = 6) -> None:
        self._most = most
        self._refused: Any = np.zeros(count, dtype=int)
        self._before: Array = np.zeros(count)  # sign of the last one used, where it surprised
        self._judged: Any = np.zeros(count, dtype=int)
        self.outliers: Array = np.zeros(count)
        """Share of recent distances that was refused."""

    def restart(self, which: Any) -> None:
        """Forget what surprised of some (n,) bool, but not how many are refused."""
        self._refused[which] = 0
        self._before[which] = 0.0

    def judge(self, innovation: Array, spread: Array, given: Any = True) -> Verdict:
        """
        Judge distances by their innovations, m, of variances ``spread``, m^2.

        :param given: which there are; of the others nothing changes, and none is used.
        """
        doubt = innovation ** 2 / (spread * RANGE_GATE)
        inside = doubt <= 1.0  # NaN is not
        refused = ~inside & (self._refused < self._most - 1) & (
            (innovation > 0.0) | ~(doubt <= RANGE_WILD))
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
