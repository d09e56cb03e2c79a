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
The sensors of the embedded autopilot: its position estimator and its barometer.

With GPS the estimate is the truth. With vision the estimate follows the poses of ODOMETRY, right
or wrong. Without new poses it integrates a biased accelerometer, so position and velocity drift.
The barometer measures the standard atmosphere with white noise and a slow drift. ENU; the time is
given.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.profiles import Profile
from flock_desk.vehicles.quadrotor import Quadrotor
from flock_follower.geometry import (
    Array,
    normalize_quaternion,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
    wrap_angle,
    yaw_from_quaternion,
)
from flock_follower.mavlink.ned import frd_to_flu, ned_to_enu, quaternion_ned_frd_to_enu_flu

#: A gap in the vision longer than this, s, makes it stale: PX4's EKF2 stops using it then.
VISION_TIMEOUT: Final[float] = 0.2
#: Vision farther than this from the estimate, m, is an outlier unless it announces a reset.
INNOVATION_GATE: Final[float] = 1.0
_TIME_CONSTANT: Final[float] = 0.2  # s in which the estimate follows the vision
_FUTURE: Final[float] = 0.1  # s
#: Time constant with which the barometer corrects the height, s: on PX4 and ArduCopter odometry
#: that sank by 1.5 m in 5 s moved it by 1.42 and 1.47 m.
BAROMETER_TIME: Final[float] = 42.0


class Estimator:
    """
    The estimate: the truth plus an error that vision keeps small.

    :param uses_vision: False for GPS.
    :param height_by_vision: False for the barometer: then the height follows the vertical velocity
        of the vision, and slowly the barometer.
    :param now: time, s. If the vehicle starts in the air, vision counts as received until then.
    :param ready_at: the time, s, before which there is no estimate.
    """

    def __init__(self, vehicle: Quadrotor, profile: Profile, uses_vision: bool,
                 height_by_vision: bool, now: float, ready_at: float) -> None:
        self._vehicle, self._profile = vehicle, profile
        self.uses_vision, self._height_by_vision = uses_vision, height_by_vision
        self.ready_at = ready_at
        """Since when it runs, s, with or without aiding."""
        self._position_error: Array = np.zeros(3)
        self._velocity_error: Array = np.zeros(3)
        self.yaw_error = 0.0
        self._vision_time = -math.inf if vehicle.landed else now
        self._reset_counter = -1

    @property
    def position(self) -> Array:
        """Return the estimated position, (3,), m."""
        return self._vehicle.position + self._position_error

    @property
    def velocity(self) -> Array:
        """Return the estimated velocity, (3,), m/s."""
        return self._vehicle.velocity + self._velocity_error

    @property
    def yaw(self) -> float:
        """Return the yaw, rad."""
        return wrap_angle(self._vehicle.yaw + self.yaw_error)

    @property
    def quaternion(self) -> Array:
        """Return the attitude FLU to ENU, (x, y, z, w)."""
        return quaternion_multiply(quaternion_from_yaw(self.yaw_error), self._vehicle.quaternion)

    def vision_age(self, now: float) -> float:
        """Return the time since the last valid vision, s; 0 if it does not use vision."""
        return now - self._vision_time if self.uses_vision else 0.0

    def on_odometry(self, message: Any, now: float, age: float) -> None:
        """Take an ODOMETRY of an age, s, if it is one that the autopilot uses."""
        profile, (w, x, y, z) = self._profile, message.q
        numbers = [message.x, message.y, message.z, message.vx, message.vy, message.vz, w, x, y, z]
        # PX4 requires the six variances on the diagonals.
        filled = not profile.px4 or all(
            math.isfinite(matrix[i]) and matrix[i] > 0.0 for i in (0, 6, 11, 15, 18, 20)
            for matrix in (message.pose_covariance, message.velocity_covariance))
        if (not self.uses_vision or not -_FUTURE <= age <= profile.oldest_vision or not filled
                or message.frame_id not in profile.frames
                or message.child_frame_id != mavlink.MAV_FRAME_BODY_FRD
                or not np.all(np.isfinite(numbers)) or math.hypot(w, x, y, z) < 0.5):
            return
        attitude = quaternion_ned_frd_to_enu_flu(normalize_quaternion([x, y, z, w]))
        innovation = (ned_to_enu(numbers[:3]) - self.position) * [
            1.0, 1.0, float(self._height_by_vision)]
        starts = message.reset_counter != self._reset_counter
        if not starts and np.linalg.norm(innovation) > INNOVATION_GATE:
            return
        gain = 1.0 if starts else -math.expm1(
            -min(now - self._vision_time, VISION_TIMEOUT) / _TIME_CONSTANT)
        velocity = quaternion_to_matrix(attitude) @ frd_to_flu(numbers[3:6])
        self._position_error = self._position_error + gain * innovation
        self._velocity_error = self._velocity_error + gain * (velocity - self.velocity)
        self.yaw_error = wrap_angle(
            self.yaw_error + gain * wrap_angle(yaw_from_quaternion(attitude) - self.yaw))
        self._vision_time, self._reset_counter = now, message.reset_counter

    def step(self, now: float, dt: float) -> None:
        """Move the error on by ``dt``, s."""
        if VISION_TIMEOUT < self.vision_age(now) < math.inf:
            self._velocity_error = self._velocity_error + self._profile.drift * dt
            self._position_error = self._position_error + self._velocity_error * dt
        elif self.uses_vision and not self._height_by_vision:
            self._position_error[2] += dt * (
                self._velocity_error[2] - self._position_error[2] / BAROMETER_TIME)


#: Height of the ground above the mean sea level, m.
GROUND_AMSL: Final[float] = 488.0
#: Pressure at the mean sea level, hPa.
SEA_LEVEL: Final[float] = 1013.25
_TEMPERATURE: Final[float] = 288.15  # K at the mean sea level ...
_LAPSE: Final[float] = 0.0065  # ... and how much less 1 m higher
_EXPONENT: Final[float] = 5.25588  # of the international standard atmosphere below 11 km
#: Standard deviation of the white noise of a barometer's height, m.
BAROMETER_NOISE = 0.05
#: Standard deviation of its drift, m, which is zero at the start.
BAROMETER_DRIFT = 0.1
#: Time constant of its drift, s.
BAROMETER_DRIFT_TIME = 300.0


class Barometer:
    """
    The barometers of n vehicles.

    :param generators: of the random numbers, one for each vehicle.
    """

    def __init__(self, generators: Sequence[np.random.Generator]) -> None:
        self._generators = generators
        self._drift: Array = np.zeros(len(generators))
        self._time: float | None = None

    def heights(self, true: Array, now: float) -> Array:
        """Return the heights, (n,), m, measured at a time, s, of true ones (n,), m."""
        drawn = np.stack([g.standard_normal(2) for g in self._generators])
        keep = 1.0 if self._time is None else math.exp(-(now - self._time) / BAROMETER_DRIFT_TIME)
        self._time = now
        self._drift = keep * self._drift + BAROMETER_DRIFT * math.sqrt(1.0 - keep ** 2) * drawn[:,
                                                                                                0]
        measured: Array = true + self._drift + BAROMETER_NOISE * drawn[:, 1]
        return measured


def pressure(altitude: float) -> float:
    """Return the pressure, hPa, of the standard atmosphere at an altitude above the sea, m."""
    return float(SEA_LEVEL * (1.0 - _LAPSE * altitude / _TEMPERATURE) ** _EXPONENT)
