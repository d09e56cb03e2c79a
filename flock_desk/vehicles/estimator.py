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
What the embedded autopilot believes of its own motion: GPS, or external vision that can go stale.

With GPS the estimate is the truth. With vision it follows the poses that ODOMETRY brings, whether
they are right or not, and dead-reckons with a biased accelerometer once they stop: position and
velocity go on, and drift. ENU; the time is given.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_desk.vehicles.vehicle import Quadrotor
from flock_follower.geometry import Array, quaternion_from_yaw, quaternion_multiply, wrap_angle

#: A gap in the vision longer than this, s, makes it stale: PX4's EKF2 stops using it then.
VISION_TIMEOUT: Final[float] = 0.2
#: Vision further than this from the estimate, m, is an outlier unless it announces a reset.
INNOVATION_GATE: Final[float] = 1.0
_TIME_CONSTANT: Final[float] = 0.2  # s in which the estimate follows the vision


class VisionSample(NamedTuple):
    """A pose and a velocity (3,), m/s, in ENU, as external vision sees them."""

    position: Array
    velocity: Array
    yaw: float
    reset_counter: int


class Estimator:
    """
    The estimate: the truth plus an error that vision keeps small.

    :param uses_vision: False for GPS.
    :param ready_at: the time, s, before which there is no estimate.
    :param drift: what is left of the accelerometer's bias (3,), m/s^2; the barometer keeps z.
    """

    def __init__(self, vehicle: Quadrotor, *, uses_vision: bool = False,
                 ready_at: float = -math.inf, drift: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        self._vehicle = vehicle
        self._drift: Array = np.asarray(drift, dtype=float)
        self.uses_vision = uses_vision
        self.vision_available = True
        """False is a fault: whatever comes is ignored."""
        self._ready_at = ready_at
        self._position_error: Array = np.zeros(3)
        self._velocity_error: Array = np.zeros(3)
        self.yaw_error = 0.0
        self._vision_time = -math.inf
        self._vision_seen = False
        self._assumed_at = -math.inf
        self._reset_counter = 0

    @property
    def position(self) -> Array:
        """Return where it takes itself to be, (3,), m."""
        return self._vehicle.position + self._position_error

    @property
    def velocity(self) -> Array:
        """Return how fast it takes itself to move, (3,), m/s."""
        return self._vehicle.velocity + self._velocity_error

    @property
    def yaw(self) -> float:
        """Return the yaw, rad."""
        return wrap_angle(self._vehicle.yaw + self.yaw_error)

    @property
    def quaternion(self) -> Array:
        """Return the attitude FLU to ENU, (x, y, z, w)."""
        if self.yaw_error == 0.0:
            return self._vehicle.quaternion
        return quaternion_multiply(quaternion_from_yaw(self.yaw_error), self._vehicle.quaternion)

    def vision_age(self, now: float) -> float:
        """Return for how long no usable vision has come, s; 0 where none is needed."""
        return now - max(self._vision_time, self._assumed_at) if self.uses_vision else 0.0

    def ready(self, now: float) -> bool:
        """Return whether there has been an estimate of the position."""
        return self.started(now) and (self._vision_seen or math.isfinite(self._assumed_at)
                                      or not self.uses_vision)

    def assume(self, now: float) -> None:
        """Begin in the air at ``now``, s, as if vision had come until then."""
        self._assumed_at = now

    def started(self, now: float) -> bool:
        """Return whether it runs, be it without anything to rest on."""
        return now >= self._ready_at

    def to_true_frame(self, acceleration: Array) -> Array:
        """Return a vector of the estimate's frame as it acts in the world."""
        if self.yaw_error == 0.0:
            return acceleration
        c, s = math.cos(-self.yaw_error), math.sin(-self.yaw_error)
        x, y, z = acceleration
        return np.array([c * x - s * y, s * x + c * y, z])

    def on_vision(self, sample: VisionSample, now: float) -> bool:
        """Take a vision sample; return whether it was used."""
        if not self.uses_vision or not self.vision_available:
            return False
        starts = not self._vision_seen or sample.reset_counter != self._reset_counter
        innovation = sample.position - self.position
        if not starts and np.linalg.norm(innovation) > INNOVATION_GATE:
            return False
        gain = 1.0 if starts else -math.expm1(
            -min(now - self._vision_time, VISION_TIMEOUT) / _TIME_CONSTANT)
        self._position_error = self._position_error + gain * innovation
        self._velocity_error = self._velocity_error + gain * (sample.velocity - self.velocity)
        self.yaw_error = wrap_angle(self.yaw_error + gain * wrap_angle(sample.yaw - self.yaw))
        self._vision_seen, self._vision_time = True, now
        self._reset_counter = sample.reset_counter
        return True

    def step(self, now: float, dt: float) -> None:
        """Move the error on by ``dt``, s."""
        if self._vision_seen and self.vision_age(now) > VISION_TIMEOUT:
            self._velocity_error = self._velocity_error + self._drift * dt
            self._position_error = self._position_error + self._velocity_error * dt
