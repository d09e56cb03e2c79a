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
What a simulated vehicle carries besides its flight controller: barometer and battery.

The barometer measures the standard atmosphere with white noise and a slow drift.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Final, NamedTuple

import numpy as np

from flock_desk.vehicles.vehicle import Quadrotor
from flock_follower.geometry import Array

#: Height of the ground above the mean sea level, m.
GROUND_AMSL: Final[float] = 488.0
#: Pressure at the mean sea level, hPa.
SEA_LEVEL: Final[float] = 1013.25
_TEMPERATURE: Final[float] = 288.15  # K at the mean sea level ...
_LAPSE: Final[float] = 0.0065  # ... and how much less 1 m higher
_EXPONENT: Final[float] = 5.25588  # of the international standard atmosphere below 11 km
CAPACITY: Final[float] = 5.2  # Ah
CURRENT: Final[float] = 18.0  # A in flight


class BarometerErrors(NamedTuple):
    """Errors of a barometer: standard deviations of its height, m."""

    noise: float = 0.05
    """White, of each sample."""
    drift: float = 0.1
    """Drift by weather and temperature, zero at the start; first-order Gauss-Markov ..."""
    drift_time: float = 300.0
    """... with this time constant, s."""


class Barometer:
    """
    The barometers of n vehicles.

    :param generators: of the random numbers, one for each vehicle.
    """

    def __init__(self, generators: Sequence[np.random.Generator],
                 errors: BarometerErrors | None = None) -> None:
        self.errors = errors or BarometerErrors()
        self.offset = 0.0
        """Added to every height, m: a step of the pressure, for tests."""
        self._generators = generators
        self._drift: Array = np.zeros(len(generators))
        self._time: float | None = None

    def heights(self, true: Array, now: float) -> Array:
        """Return the heights (n,), m, measured at a time, s, of true ones (n,), m."""
        errors, drawn = self.errors, np.stack([g.standard_normal(2) for g in self._generators])
        passed = 0.0 if self._time is None else now - self._time
        self._time = now
        keep = math.exp(-passed / errors.drift_time)
        self._drift = (keep * self._drift
                       + errors.drift * math.sqrt(1.0 - keep ** 2) * drawn[:, 0])
        measured: Array = true + self.offset + self._drift + errors.noise * drawn[:, 1]
        return measured


class Equipment:
    """
    Barometer and battery of one vehicle; a reboot does not touch them.

    :param seed: of the noise.
    """

    def __init__(self, vehicle: Quadrotor, seed: int, errors: BarometerErrors | None) -> None:
        self._vehicle = vehicle
        self.barometer = Barometer([np.random.default_rng([seed, 1])], errors)
        self.charge: float | None = 1.0
        """Remaining charge of the battery, a share; None: unknown."""

    def step(self, armed: bool, dt: float) -> None:
        """Let the battery drain for ``dt``, s."""
        if armed and self.charge is not None:
            self.charge = max(0.0, self.charge - CURRENT / CAPACITY * dt / 3600.0)

    def pressure(self, now: float) -> float:
        """Return the measured pressure, hPa."""
        height = self.barometer.heights(self._vehicle.position[2:] + GROUND_AMSL, now)[0]
        return float(SEA_LEVEL * (1.0 - _LAPSE * height / _TEMPERATURE) ** _EXPONENT)
