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
Radios that measure distances to others, in lock step: their errors, and what comes of them.

Each object serves n pairs of a follower and another vehicle at once, one row each.
``SimulatedRanging`` is to n pairs what ``perception.range_tracking`` is to one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from flock_desk.scenarios.scenario import RangeErrors
from flock_desk.sensors.sensing import Filters
from flock_desk.sensors.vio import Due
from flock_follower.geometry import Array
from flock_follower.perception.neighbor_motion import FilterParams
from flock_follower.perception.range_tracking import LONGEST, RangeBias, RangingParams, UNSEEN

IN_SIGHT = 0.05  # s since the newest image that shows it: the next one is due


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


class RangedStates(NamedTuple):
    """The states of n others at a moment, as ranges tell them, in the frame of the filters."""

    told: Any
    """Of whom it is told (n,): of those not in sight."""
    distance: Array
    """From the follower (n,), m."""
    position: Array
    """(n, 3), m."""
    velocity: Array
    """(n, 3), m/s."""
    position_covariance: Array
    """(n, 3, 3), m^2."""
    velocity_covariance: Array
    """(n, 3, 3), m^2/s^2."""
    acceleration: Array
    """(n, 3), m/s^2."""


class SimulatedRanging:
    """The ranges of n followers to one other each, and the filters that go on with them."""

    def __init__(self, errors: RangeErrors, generators: Sequence[np.random.Generator],
                 params: FilterParams | None = None) -> None:
        count = len(generators)
        self.latency: Array = np.array([g.uniform(*errors.latency) for g in generators])
        """From a measurement to whoever uses it (n,), s."""
        self.bias = RangeBias(count)
        self._radios, self._due = Radios(errors, generators), Due(errors.rate)
        self._noise = RangingParams().range_noise ** 2
        self._apart = Filters(count, replace(params or FilterParams(), max_gap=LONGEST))
        self._since: Array = np.full(count, -np.inf)

    def due(self, now: float) -> bool:
        """Return whether it is time, s, for the next ranges; asked once for each time."""
        return self._due.at(now)

    def step(self, now: float, offsets: Array, own: Array, seen: Filters,
             answers: Any = True) -> RangedStates:
        """
        Measure the distances, and go on with them where the other one is not in sight.

        :param offsets: true ones from the followers to the others (n, 3), m.
        :param own: the own positions (n, 3), m, in the frame of the filters.
        :param seen: the filters of what is seen.
        :param answers: whether the other one's radio answers (n,).
        """
        measured = self._radios.measure(np.linalg.norm(offsets, axis=1))
        age = now - seen.stamp
        distance, _, spread = seen.along(now, own)
        self.bias.learn(now, measured - distance, self._noise + spread,
                        (age <= IN_SIGHT) & answers)

        apart, unseen = self._apart, (age > IN_SIGHT) & np.isfinite(age) & answers
        apart.go_on_from(seen, unseen & (self._since != seen.stamp))
        self._since = np.where(unseen, seen.stamp, self._since)
        doubt = self.bias.variance(now)
        used = apart.update_range(now, measured - self.bias.value, own, self._noise + doubt,
                                  unseen)
        distance, along, _ = apart.along(now, own)
        covariance = (apart.position_covariance
                      + doubt[:, None, None] * along[:, :, None] * along[:, None, :])
        return RangedStates(
            used & (age > UNSEEN) & (age <= LONGEST), distance, apart.position.copy(),
            apart.velocity.copy(), covariance, apart.velocity_covariance.copy(),
            apart.acceleration.copy())
