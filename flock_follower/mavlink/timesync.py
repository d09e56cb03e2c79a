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
TIMESYNC: the offset between the autopilot's clock and ours, and answers to its own requests.

Whoever asks sends ``tc1 = 0`` and its own time in ``ts1``; the answer holds the other's time in
``tc1`` and ``ts1`` as it came. PX4 learns our clock from our answers, and from then on expects
the ``time_usec`` of ODOMETRY in it.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

#: Time between two questions, s.
PERIOD: Final[float] = 1.0
#: The answer with the shortest way among this many gives the offset: delay only ever adds.
WINDOW: Final[int] = 10
#: An answer that took longer is not one to our last questions, ns.
LONGEST_WAY: Final[int] = 1_000_000_000


class Sample(NamedTuple):
    """One answer."""

    offset: int
    """The autopilot's clock minus ours, ns."""
    way: int
    """There and back, ns."""


class TimeSync:
    """Our side of TIMESYNC; times are integer nanoseconds of one monotonic clock."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=WINDOW)

    def question(self, now: int) -> Any:
        """Return the message that asks for the autopilot's time."""
        return mavlink.MAVLink_timesync_message(0, now)

    def take(self, message: Any, now: int) -> Any | None:
        """Take a TIMESYNC; return the answer where it is a question."""
        if message.tc1 == 0:
            return mavlink.MAVLink_timesync_message(now, message.ts1)
        way = now - message.ts1
        if 0 <= way <= LONGEST_WAY:
            self._samples.append(Sample(message.tc1 - (message.ts1 + now) // 2, way))
        return None

    @property
    def best(self) -> Sample | None:
        """Return the best of the recent answers, None where there was none."""
        return min(self._samples, key=lambda sample: sample.way, default=None)

    def forget(self) -> None:
        """Drop what is known: the autopilot's clock has started anew."""
        self._samples.clear()
