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
The schedule of playback: the time at which each message of a bag is published. No clock is read.

Wall time is in float seconds of any monotonic clock, and always an argument; bag time is in
integer nanoseconds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

NS_PER_S = 1_000_000_000
#: Time between two messages of a recording, s; if it is more, the clock was set or nothing was
#: recorded.
MAX_GAP = 5.0


class Section(NamedTuple):
    """The part of a bag to play: ``start_ns <= stamp < stop_ns``."""

    start_ns: int
    stop_ns: int


def section(bag_start_ns: int, bag_end_ns: int, start: float, duration: float) -> Section:
    """
    Return the part that begins ``start`` s into the bag and lasts ``duration`` s (0: all).

    :raises ValueError: the bag ends before the part begins.
    """
    length = (bag_end_ns - bag_start_ns) / NS_PER_S
    if not 0.0 <= start <= length:
        raise ValueError(f'start = {start:g}: must be in [0, {length:g}] s, the length of the bag')
    start_ns = bag_start_ns + round(start * NS_PER_S)
    last_ns = start_ns + round(duration * NS_PER_S)
    return Section(start_ns, min(bag_end_ns + 1, last_ns) if duration else bag_end_ns + 1)


class Gaps:
    """Finds the steps of more than MAX_GAP in the times of successive messages, ahead and back."""

    def __init__(self, start_ns: int | None = None) -> None:
        self.skipped_ns = 0
        """The sum of all skipped gaps, ns."""
        self._last_ns = start_ns

    def take(self, stamp_ns: int) -> float:
        """Return the gap before a message, s; negative if the clock went back; 0 without a gap."""
        step_ns = 0 if self._last_ns is None else stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        if abs(step_ns) <= MAX_GAP * NS_PER_S:
            return 0.0
        self.skipped_ns += step_ns
        return step_ns / NS_PER_S


class Timeline:
    """
    The position of playback in the bag, and the time at which a stamp falls due.

    Both follow from one pair of a wall time and a bag time, the anchor, so errors of single waits
    never add up. Before the anchor's wall time the position does not move: an anchor in the future
    delays the start.
    """

    def __init__(self, start_ns: int, rate: float, now: float) -> None:
        self.rate = rate
        self.paused = False
        self._wall = now
        self._bag_ns = start_ns

    def position(self, now: float) -> int:
        """Return the bag time [ns] reached at ``now``."""
        if self.paused or now <= self._wall:
            return self._bag_ns
        return self._bag_ns + int((now - self._wall) * self.rate * NS_PER_S)

    def due(self, stamp_ns: int) -> float:
        """Return the wall time [s] at which a stamp falls due; infinity while paused."""
        if self.paused:
            return math.inf
        return self._wall + (stamp_ns - self._bag_ns) / (self.rate * NS_PER_S)

    def change(self, now: float, rate: float, paused: bool) -> None:
        """Continue at another rate from the position at ``now``, or pause there."""
        self.jump(self.position(now), now)
        self.rate, self.paused = rate, paused

    def jump(self, stamp_ns: int, now: float) -> None:
        """Set the position to bag time ``stamp_ns`` at wall time ``now``."""
        self._bag_ns, self._wall = stamp_ns, now

    def limit_lateness(self, stamp_ns: int, now: float, limit: float) -> None:
        """
        Drop the backlog when a stamp is late by more than ``limit`` s.

        After the process was suspended or the disk stalled, playback continues at its rate, and
        does not publish all delayed messages at once.
        """
        if now - self.due(stamp_ns) > limit:
            self.jump(stamp_ns, now)
