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
When odometry is overdue, judged by the rhythm in which it comes.

Between two messages odometry grows old by nature: at 10 Hz and 60 ms of latency it is 0.06 s old
on arrival, and 0.16 s just before the next arrives. A fast source is overdue at ``LATE`` of the
timeout; a slow one where it becomes older than it usually does. But a source whose odometry is
too old usually, on average or at its oldest, is too slow to fly on at all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

LATE = 0.5  # share of the timeout: younger odometry is never overdue
LATEST = 0.8  # share of the timeout: older odometry always is, to brake before commands end
OVERDUE = 1.2  # times the greatest age that the last ones reached
AVERAGE = 0.55  # share of the timeout: older on average than this it is too slow
STEADY = 0.9  # hysteresis: once too slow, the limits are this much tighter
REMEMBERED = 20  # messages: 2 s at 10 Hz, but a hiccup at 60 Hz is forgotten in 0.3 s


class Span(NamedTuple):
    """The ages, s, between which one odometry was the newest: on arrival, and when replaced."""

    first: float
    last: float


class Rhythm:
    """Between which ages the last few odometry messages were the newest."""

    def __init__(self) -> None:
        self._stamp: int | None = None
        self._arrived = 0
        self._spans: deque[Span] = deque(maxlen=REMEMBERED)

    def take(self, stamp: int, now: int) -> None:
        """Note that odometry of a stamp arrived at a time, both in ns."""
        if stamp == self._stamp:
            return
        if self._stamp is not None:
            if stamp > self._stamp:
                first, last = ((time - self._stamp) * 1e-9 for time in (self._arrived, now))
                self._spans.append(Span(first, last))
            else:
                self._spans.clear()  # the clock jumped back, or another source took over
        self._stamp, self._arrived = stamp, now

    @property
    def spans(self) -> tuple[Span, ...]:
        """Return the spans of those that have been replaced already."""
        return tuple(self._spans)


def too_slow(spans: Sequence[Span], timeout: float, before: bool) -> float | None:
    """
    Return the age, s, that odometry usually reaches where it is too slow to fly on, else None.

    :param timeout: age at which odometry is not used at all, s.
    :param before: whether it was too slow up to now.
    """
    if not spans:
        return None
    usual = sorted(spans, key=sum)[len(spans) // 2]
    share = timeout * (STEADY if before else 1.0)
    slow = usual.last > LATEST * share or 0.5 * sum(usual) > AVERAGE * share
    return usual.last if slow else None


def overdue(age: float, spans: Sequence[Span], timeout: float) -> bool:
    """Return whether odometry of an age, s, should have been replaced by now."""
    longest = OVERDUE * max((span.last for span in spans), default=0.0)
    return age > min(max(LATE * timeout, longest), LATEST * timeout)
