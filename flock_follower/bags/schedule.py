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
When to publish which message of a bag: the arithmetic of playback, without ROS or a clock.

Wall time is float seconds of any monotonic clock and always passed in; bag time is integer
nanoseconds.
"""

from __future__ import annotations

from collections.abc import Collection
import math
from typing import NamedTuple

from flock_follower.ranges import Range

NANOSECONDS = 1_000_000_000


class Section(NamedTuple):
    """The stretch of a bag to play: ``start_ns <= stamp < stop_ns``."""

    start_ns: int
    stop_ns: int


def section(bag_start_ns: int, bag_end_ns: int, start: float, duration: float) -> Section:
    """
    Return the stretch that begins ``start`` s into the bag and lasts ``duration`` s (0: all).

    :raises ValueError: the bag ends before the stretch begins.
    """
    length = (bag_end_ns - bag_start_ns) / NANOSECONDS
    try:
        Range(0.0, length, 's').check('start', start)
    except ValueError as error:
        raise ValueError(f'{error}, the length of the bag') from None
    start_ns = bag_start_ns + round(start * NANOSECONDS)
    stop_ns = bag_end_ns + 1
    if duration > 0.0:
        stop_ns = min(stop_ns, start_ns + round(duration * NANOSECONDS))
    return Section(start_ns, stop_ns)


class Timeline:
    """
    Where in the bag playback is, and when a stamp falls due.

    Both follow from one anchor (this wall time is that bag time), so errors of single waits never
    add up. Position never moves before the anchor's wall time: an anchor in the future is a
    lead-in.
    """

    def __init__(self, start_ns: int, rate: float, now: float, paused: bool = False) -> None:
        self.rate = rate
        self.paused = paused
        self._wall = now
        self._bag_ns = start_ns

    def position(self, now: float) -> int:
        """Return the bag time [ns] reached at ``now``."""
        if self.paused or now <= self._wall:
            return self._bag_ns
        return self._bag_ns + int((now - self._wall) * self.rate * NANOSECONDS)

    def due(self, stamp_ns: int) -> float:
        """Return the wall time [s] at which a stamp falls due; infinity while paused."""
        if self.paused:
            return math.inf
        return self._wall + (stamp_ns - self._bag_ns) / (self.rate * NANOSECONDS)

    def pause(self, now: float) -> None:
        """Stop at the position of ``now``."""
        self.jump(self.position(now), now)
        self.paused = True

    def resume(self, now: float) -> None:
        """Go on from where it paused."""
        if self.paused:
            self.paused = False
            self._wall = now

    def set_rate(self, rate: float, now: float) -> None:
        """Go on at another rate from the position of ``now``."""
        self.jump(self.position(now), now)
        self.rate = rate

    def jump(self, stamp_ns: int, now: float) -> None:
        """Be at bag time ``stamp_ns`` at wall time ``now``."""
        self._bag_ns, self._wall = stamp_ns, now

    def limit_lateness(self, stamp_ns: int, now: float, limit: float) -> float:
        """
        Drop the backlog when a stamp is late by more than ``limit`` s; return the s dropped.

        After a suspended process or a stalled disk, playback goes on at its rate instead of
        flooding its subscribers with everything missed.
        """
        late = now - self.due(stamp_ns)
        if late <= limit:
            return 0.0
        self.jump(stamp_ns, now)
        return late


def published_names(topics: Collection[str], remaps: Collection[str] = ()) -> dict[str, str]:
    """
    Return the name to publish each topic of a bag under.

    A bag's absolute names become relative (``/odom`` to ``odom``), so that namespaces and ROS
    remaps apply. ``remaps`` are ``from:=to``; a ``to`` with a leading slash stays absolute.

    :raises ValueError: a remap is malformed or names a topic that is not played.
    """
    names = {topic: topic.lstrip('/') for topic in topics}
    for remap in remaps:
        source, separator, target = (part.strip() for part in remap.partition(':='))
        topic = '/' + source.lstrip('/')
        if not separator or not source or not target:
            raise ValueError(f'remap = {remap!r}: must be from:=to')
        if topic not in names:
            raise ValueError(f'remap = {remap!r}: {topic} is not played, only {", ".join(names)}')
        names[topic] = target
    return names


def progress(
    position: float, end: float, fraction: float, rate: float, messages: int,
    paused: bool = False, width: int = 0,
) -> str:
    """
    Return one line of progress, with a bar in the rest of ``width`` columns.

    ``position`` and ``end`` are s into the bag, ``fraction`` the part of the section played.
    """
    state = 'paused' if paused else f'{rate:g}x'
    text = f'{position:6.1f} / {end:.1f} s  {state:>6}  {messages} messages'
    columns = min(40, width - len(text) - 4)
    if columns < 5:
        return text[:width] if width else text
    filled = round(columns * min(max(fraction, 0.0), 1.0))
    return f'[{"#" * filled}{"." * (columns - filled)}] {text}'
