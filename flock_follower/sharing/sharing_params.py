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

"""What followers take for granted of each other's words: limits, drifts, noises."""

from __future__ import annotations

from dataclasses import dataclass
import re
from typing import ClassVar

from flock_follower.ranges import Checked, Range

#: A vehicle's name: it goes into frame ids, and comes from a namespace.
NAME = re.compile(r'[A-Za-z0-9_.-]{1,64}')


@dataclass(frozen=True)
class SharingParams(Checked):
    """
    Whose words these are, and what is believed of the others'.

    :raises ValueError: naming the field, its value and what is valid.
    """

    name: str
    """Of this vehicle, unique in the flock."""
    position_std_max: float = 0.5
    """Standard deviation of where a teller's frame lies, and of whom it tells, beyond which its
    words are not used, m: that of the planner."""
    yaw_std_max: float = 0.1
    """The same of how it is turned, rad."""
    word_age_max: float = 1.0
    """Age up to which words are taken, and what they told is given out, s."""
    clock_tolerance: float = 0.02
    """Time by which a word may be ahead of the own clock, s."""
    seen_timeout: float = 0.5
    """Age of an own sighting up to which nobody needs to be told of that vehicle, s."""
    position_drift: float = 0.025
    """Of every vehicle's odometry, a random walk, m/sqrt(s)."""
    yaw_drift: float = 0.0025
    """The same of its yaw, rad/sqrt(s)."""
    odometry_noise: float = 0.02
    """By which an odometry's positions tremble, m."""
    sighting_noise: float = 0.02
    """By which sightings err beyond their covariance, and do so for long, m."""
    attitude_noise: float = 0.06
    """By which the yaw of a vehicle seen errs beyond its covariance: markers hang askew, rad."""
    acceleration: float = 0.5
    """What a vehicle told of may do since, m/s^2."""
    tellers_max: int = 32
    """Vehicles listened to at most."""

    RANGES: ClassVar[dict[str, Range]] = {
        'position_std_max': Range(0.01, 5.0, 'm'),
        'yaw_std_max': Range(0.01, 1.0, 'rad'),
        'word_age_max': Range(0.1, 5.0, 's'),
        'clock_tolerance': Range(0.0, 1.0, 's'),
        'seen_timeout': Range(0.0, 5.0, 's'),
        'position_drift': Range(0.001, 1.0, 'm/sqrt(s)'),
        'yaw_drift': Range(0.0001, 0.1, 'rad/sqrt(s)'),
        'odometry_noise': Range(0.001, 1.0, 'm'),
        'sighting_noise': Range(0.001, 1.0, 'm'),
        'attitude_noise': Range(0.01, 1.0, 'rad'),
        'acceleration': Range(0.0, 20.0, 'm/s^2'),
        'tellers_max': Range(1, 100, whole=True),
    }

    def __post_init__(self) -> None:
        """Check the name, and the numbers."""
        super().__post_init__()
        if not NAME.fullmatch(self.name):
            raise ValueError(f'vehicle_name = {self.name!r}: must be 1 to 64 letters, digits, _ . '
                             'or -, unique in the flock; by default it is the namespace')
