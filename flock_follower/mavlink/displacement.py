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
Whether two sources report the same displacement of the vehicle: a velocity error shows in time.

The displacements over the last WINDOW seconds are compared. A jump of a position, which its own
velocity does not match, is taken out: estimators correct themselves in jumps.
"""

from __future__ import annotations

from collections import deque
import math
from typing import Final

import numpy as np

from flock_follower.geometry import Array

#: s.
WINDOW: Final[float] = 5.0
#: Displacements may differ by this, m, or by 3 standard deviations if those are more.
TOLERANCE: Final[float] = 0.5
#: Standard deviation of the displacement by a barometer over WINDOW, m: gusts, doors, rotors.
BAROMETER_STD: Final[float] = 0.3
#: The vehicle is handed over after displacements have differed for this long, s.
HANDOVER_TIME: Final[float] = 1.0
#: A position that differs by more than this, m, from the one expected has jumped.
JUMP: Final[float] = 0.3
#: After a longer gap than this, s, a path begins again.
LONGEST_GAP: Final[float] = 0.5
#: s between two positions that are kept.
SPACING: Final[float] = 0.1


class Path:
    """The positions (3,), m, of one source, without jumps; times are monotonic, s."""

    def __init__(self) -> None:
        self.jumps = 0
        self.position: Array | None = None
        """The newest, m, in a frame that is the source's but for the jumps."""
        self._time = -math.inf
        self._shift: Array | float = 0.0
        self._kept: deque[tuple[float, Array]] = deque()

    def take(self, position: Array, velocity: Array | None, now: float) -> None:
        """
        Take a position, m.

        :param velocity: (3,), m/s, by the same source; None tells no jump.
        """
        elapsed = now - self._time
        if elapsed <= 0.0:
            return
        if elapsed > LONGEST_GAP:
            self._kept.clear()
        shifted = position - self._shift
        if self.position is not None and velocity is not None and elapsed <= LONGEST_GAP:
            surprise = shifted - self.position - velocity * elapsed
            if math.hypot(*surprise.tolist()) > JUMP:
                self.jumps += 1
                self._shift = self._shift + surprise
                shifted = position - self._shift
        self.position, self._time = shifted, now
        if not self._kept or now - self._kept[-1][0] >= SPACING:
            self._kept.append((now, shifted))
            while len(self._kept) > 2 and now - self._kept[1][0] >= WINDOW:
                self._kept.popleft()

    @property
    def span(self) -> tuple[float, float]:
        """Return the times, s, between which the path is known."""
        return (self._kept[0][0], self._kept[-1][0]) if self._kept else (math.inf, -math.inf)

    def between(self, start: float, end: float) -> Array:
        """Return the displacement (3,), m, from one time within the span to another."""
        times = [time for time, _ in self._kept]
        places = np.array([place for _, place in self._kept])
        return np.array([np.interp(end, times, column) - np.interp(start, times, column)
                         for column in places.T])


def difference(one: Path, other: Path, turn: float, now: float) -> Array | None:
    """
    Return the displacement (3,) of ``one`` less that of ``other``, m, over the last WINDOW.

    :param turn: rotation about the vertical from the frame of ``one`` to that of ``other``, rad.
    :returns: None if they do not overlap, or one of them is not of now.
    """
    (first, last), (other_first, other_last) = one.span, other.span
    start, end = max(first, other_first, now - WINDOW), min(last, other_last)
    if end <= start or now - end > LONGEST_GAP:
        return None
    moved = one.between(start, end)
    cos, sin = math.cos(turn), math.sin(turn)
    moved[:2] = cos * moved[0] - sin * moved[1], sin * moved[0] + cos * moved[1]
    result: Array = moved - other.between(start, end)
    return result
