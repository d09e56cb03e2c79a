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


"""The autopilot's own estimate put together from its two messages, at the time it was valid."""

from __future__ import annotations

from typing import Final, NamedTuple

from flock_follower.geometry import (
    Array,
    quaternion_multiply,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from flock_follower.mavlink.telemetry import Attitude, LocalPosition

#: An attitude further than this, s, from a position is no part of the same estimate.
ATTITUDE_TIMEOUT: Final[float] = 0.1


class AutopilotEstimate(NamedTuple):
    """Odometry: position and attitude in ENU, twist in FLU."""

    time: float
    """When it was valid, s on our monotonic clock."""
    position: Array
    """(3,), m, ENU."""
    quaternion: Array
    """(x, y, z, w), FLU to ENU."""
    velocity: Array
    """(3,), m/s, FLU."""
    angular_velocity: Array
    """(3,), rad/s, FLU."""


def estimate(position: LocalPosition, attitude: Attitude, age: float) -> AutopilotEstimate | None:
    """
    Return the odometry at the time of a position, None where no attitude belongs to it.

    The two are measured at different times (20 ms at 1 rad/s are 5 cm at 2.5 m): the attitude is
    turned on by its rates to the time of the position, where the autopilot has stamped both.

    :param age: of the position when it came, s; 0 where it is not known.
    """
    if abs(position.time - attitude.time) > ATTITUDE_TIMEOUT:
        return None
    between = 0.0  # s
    if position.time_boot_ms and attitude.time_boot_ms:
        between = (position.time_boot_ms - attitude.time_boot_ms) * 1e-3
        if abs(between) > ATTITUDE_TIMEOUT:  # another clock, or one of them was held up
            between = 0.0
    quaternion = quaternion_multiply(
        attitude.quaternion, rotation_vector_to_quaternion(attitude.angular_velocity * between))
    return AutopilotEstimate(position.time - max(age, 0.0), position.position, quaternion,
                             quaternion_to_matrix(quaternion).T @ position.velocity,
                             attitude.angular_velocity)
