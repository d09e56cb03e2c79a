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

"""Whether odometry and autopilot tell of the same velocity: if not, who is right is not known."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.limits import limit_norm

#: The difference is averaged over this time, s. In flights on real autopilots' simulators single
#: ones were up to 0.32 m/s, averaged 0.13 m/s; one wrong sample must not end a flight.
AVERAGING_TIME: Final[float] = 0.3
#: Samples further apart than this, s, weigh no more than this.
LONGEST_STEP: Final[float] = 0.1
#: A difference counts up to this many times what is tolerated.
LARGEST: Final[float] = 3.0
#: What disagreed for this long, s, does so until it flies anew: a wrong frame shows only at speed.
#: With 0.3 s a sound PX4 was landed twice, after 24 and 26 minutes.
LATCH_TIME: Final[float] = 0.6


class VelocityComparison:
    """Averages the difference of two velocities, and remembers since when it is too large."""

    def __init__(self) -> None:
        self._average: Array = np.zeros(3)
        self._time = -math.inf
        self._since = math.inf

    def take(self, difference: Array | None, tolerance: float, flying: bool, now: float) -> None:
        """
        Take what one is faster than the other at ``now``, s, as a vector (3,), m/s.

        :param difference: None where one of them is not fresh.
        :param tolerance: largest average difference, m/s.
        :param flying: whether the vehicle flies by them; else nothing is remembered.
        """
        if difference is not None:
            first = math.isinf(self._time)
            step = 0.0 if first else min(now - self._time, LONGEST_STEP)
            share = 1.0 - math.exp(-step / AVERAGING_TIME)
            # Of finite velocities even the difference may be beyond every number.
            difference = limit_norm(np.clip(difference, -1e6, 1e6), LARGEST * tolerance)
            self._average = self._average + share * (difference - self._average)
            self._time = now
            if self.difference > tolerance:
                self._since = min(self._since, now)
                return
        if not flying or now - self._since < LATCH_TIME:
            self._since = math.inf

    @property
    def difference(self) -> float:
        """Return the average difference, m/s."""
        return float(np.linalg.norm(self._average))

    def disagreeing_for(self, now: float) -> float:
        """Return how long ago they began to disagree, s; minus infinity where they agree."""
        return now - self._since
