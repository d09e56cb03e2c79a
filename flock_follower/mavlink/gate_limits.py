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

"""What the gate is told to keep to: its limits and timeouts, their defaults and ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

from flock_follower.ranges import Checked, Range

#: Where no limit is set, velocities disagree that differ by this share of v_max and by this, m/s:
#: the healthy estimate of PX4 1.16 (SIH, odometry forwarded) errs by up to 0.25, averaged.
DISAGREEMENT_SHARE: Final[float] = 0.5
DISAGREEMENT_LEAST: Final[float] = 0.4


@dataclass(frozen=True)
class GateLimits(Checked):
    """Limits and timeouts of the gate; validated, ValueError names parameter, value and range."""

    a_max: float = 2.5
    """Largest acceleration, m/s^2."""
    v_max: float = 0.5
    """Largest speed, m/s."""
    planner_timeout: float = 0.2
    """Oldest command used, s."""
    odom_timeout: float = 0.3
    """Oldest velocity used, s."""
    link_timeout: float = 1.0
    """Longest silence of the autopilot, s."""
    blind_timeout: float = 2.0
    """After this long without a velocity that was known before, the stream stops, s; sooner where
    there is one that cannot be believed, see ``known_motion.LOSS_TIMEOUT``."""
    speed_horizon: float = 0.3
    """The speed is predicted this far ahead, s: twice a quadrotor's attitude lag, so that a
    vehicle which answers late does not overshoot ``v_max``; further where the velocity is late."""
    brake_time: float = 0.3
    """Time constant of braking, s; longer where the velocity is late."""
    yaw_disagreement: float = 0.35
    """Largest difference between the yaws of odom and of the autopilot, rad."""
    velocity_disagreement: float = 0.0
    """Largest difference between their velocities, m/s; 0: half of ``v_max``, at least 0.4."""
    height_min: float = 0.5
    """Least height above the place of arming, m."""
    height_max: float = 10.0
    """Greatest height above the place of arming, m."""
    radius_max: float = 50.0
    """Greatest horizontal distance from where it became ACTIVE, m."""

    RANGES: ClassVar[dict[str, Range]] = {
        'a_max': Range(0.01, 20.0, 'm/s^2'),
        'v_max': Range(0.01, 20.0, 'm/s'),
        'planner_timeout': Range(0.05, 1.0, 's'),
        'odom_timeout': Range(0.05, 1.0, 's'),
        'link_timeout': Range(0.2, 5.0, 's'),
        'blind_timeout': Range(0.2, 10.0, 's'),
        'speed_horizon': Range(0.02, 2.0, 's'),
        'brake_time': Range(0.02, 2.0, 's'),
        'yaw_disagreement': Range(0.01, 3.2, 'rad'),
        'velocity_disagreement': Range(0.0, 100.0, 'm/s'),
        'height_min': Range(0.3, 100.0, 'm'),
        'height_max': Range(0.5, 1000.0, 'm'),
        'radius_max': Range(1.0, 10000.0, 'm'),
    }

    def __post_init__(self) -> None:
        """Check the fields, and that the heights are in order."""
        super().__post_init__()
        if self.height_max <= self.height_min:
            raise ValueError(f'height_max = {self.height_max:g}: must be a number in '
                             f'({self.height_min:g}, 1000] m, where height_min = '
                             f'{self.height_min:g}')

    @property
    def velocity_tolerance(self) -> float:
        """Return the largest difference between the velocities of odom and autopilot, m/s."""
        return self.velocity_disagreement or max(DISAGREEMENT_SHARE * self.v_max,
                                                 DISAGREEMENT_LEAST)
