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

"""Radios that measure distances to others, in lock step, and their errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flock_desk.scenarios.scenario import RangeErrors
from flock_follower.geometry import Array


class Radios:
    """
    Measure distances with the errors of a scenario.

    :param generators: of the random numbers, one for each row.
    """

    def __init__(self, errors: RangeErrors, generators: Sequence[np.random.Generator]) -> None:
        self._errors, self._generators = errors, generators
        self._bias = errors.bias * np.array([g.standard_normal() for g in generators])
        self._walk = errors.bias_walk * errors.rate ** -0.5

    def measure(self, distance: Array) -> Array:
        """Return what is measured of true distances (n,), m, one period after the last."""
        errors = self._errors
        drawn = np.stack([g.standard_normal(2) for g in self._generators])
        chance = np.stack([g.random(2) for g in self._generators])
        self._bias = self._bias + self._walk * drawn[:, 0]
        detour = np.where(chance[:, 0] < errors.outliers, errors.outlier * chance[:, 1], 0.0)
        measured: Array = np.maximum(
            distance + self._bias + errors.noise * drawn[:, 1] + detour, 0.0)
        return measured
