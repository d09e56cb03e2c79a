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

"""What an embedded autopilot carries besides its flight controller; a reboot does not touch it."""

from __future__ import annotations

from typing import Final

import numpy as np

from flock_desk.vehicles.barometer import (
    Barometer,
    BarometerErrors,
    pressure,
    temperature,
)
from flock_desk.vehicles.vehicle import Quadrotor

#: Height of the ground above the mean sea level, m.
GROUND_AMSL: Final[float] = 488.0
#: What the rangefinder measures, m ...
RANGEFINDER_LIMITS: Final[tuple[float, float]] = 0.1, 10.0
_RANGE_NOISE: Final[float] = 0.01  # ... with this standard deviation, m
CAPACITY: Final[float] = 5.2  # Ah
CURRENT: Final[float] = 18.0  # A in flight


class Equipment:
    """
    Barometer, rangefinder and battery.

    :param seed: of their noise.
    :param rangefinder: whether there is one, which looks down.
    """

    def __init__(self, vehicle: Quadrotor, seed: int, barometer: BarometerErrors | None = None,
                 rangefinder: bool = False) -> None:
        self._vehicle = vehicle
        self.barometer = Barometer([np.random.default_rng([seed, 1])], barometer)
        self.rangefinder = rangefinder
        self._range_rng = np.random.default_rng([seed, 2])
        self.charge = 1.0
        """What is left of the battery's capacity, a share."""
        self.charge_known = True

    def step(self, armed: bool, dt: float) -> None:
        """Let the battery drain for ``dt``, s."""
        if armed:
            self.charge = max(0.0, self.charge - CURRENT / CAPACITY * dt / 3600.0)

    def air(self, now: float) -> tuple[float, float]:
        """Return the measured pressure, hPa, and the temperature, degrees Celsius."""
        return (pressure(self.pressure_altitude(now)),
                temperature(float(self._vehicle.position[2]) + GROUND_AMSL))

    def pressure_altitude(self, now: float) -> float:
        """Return the height above the mean sea level, m, that the barometer measures."""
        return float(self.barometer.heights(self._vehicle.position[2:] + GROUND_AMSL, now)[0])

    def distance(self) -> float | None:
        """Return the distance, m, to the ground along the body's z axis; None out of limits."""
        vehicle, (nearest, farthest) = self._vehicle, RANGEFINDER_LIMITS
        true = float(vehicle.position[2] / vehicle.axis[2])
        measured = max(true, nearest) + _RANGE_NOISE * self._range_rng.standard_normal()
        return measured if true <= farthest else None
