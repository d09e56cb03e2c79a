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
the ``time_usec`` of ODOMETRY in it. Both autopilots answer with the time since they booted, PX4
by ``hrt_absolute_time``, ArduPilot by ``AP_HAL::micros64``: the clock of their ``time_boot_ms``.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

#: Time between two questions, s.
PERIOD: Final[float] = 1.0
#: The answer with the shortest way among this many gives the offset: delay only ever adds.
WINDOW: Final[int] = 10
#: Answers older than this no longer count, ns: clocks drift by 0.1 ms/s at the most.
MEMORY: Final[int] = 30_000_000_000
#: Two clocks of the same speed may contradict themselves by this in that time, ns.
TOLERANCE: Final[int] = 10_000_000
_MILLISECOND = 1_000_000  # ns
_WRAP = 2**32 * _MILLISECOND  # of time_boot_ms, after 50 days


class Sample(NamedTuple):
    """One answer."""

    offset: int
    """The autopilot's clock minus ours, ns."""
    way: int
    """There and back, ns."""
    time: int
    """When it came, ns."""


class TimeSync:
    """Our side of TIMESYNC; times are integer nanoseconds of one monotonic clock."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=WINDOW)
        self._asked: deque[int] = deque(maxlen=WINDOW)
        self._unanswered_since: int | None = None

    def question(self, now: int) -> Any:
        """Return the message that asks for the autopilot's time."""
        self._asked.append(now)
        if self._unanswered_since is None:
            self._unanswered_since = now
        return mavlink.MAVLink_timesync_message(0, now)

    def take(self, message: Any, now: int) -> Any | None:
        """Take a TIMESYNC; return the answer where it is a question."""
        if message.tc1 == 0:
            return mavlink.MAVLink_timesync_message(now, message.ts1)
        if message.ts1 in self._asked:  # else somebody else has asked
            self._unanswered_since = None
            self._samples.append(Sample(
                message.tc1 - (message.ts1 + now) // 2, now - message.ts1, now))
        return None

    def age(self, time_boot_ms: int, now: int) -> float:
        """
        Return how old, s, a message received now and stamped at ``time_boot_ms`` is at most.

        An answer is written after its question, so the autopilot's clock is ahead of ours by at
        most ``tc1 - ts1``. The age is therefore never too small: it includes the quickest way
        to the autopilot, as control loops through it do. It is 0 if nothing is known: without a
        stamp (0), before the second answer, if the autopilot's clock runs faster or slower than
        ours, as in simulators, and if the stamp is ahead of the clock of its answers. A stamp
        that is behind that clock by any time is as old as it says.
        """
        if not time_boot_ms:
            return 0.0
        samples = [sample for sample in self._samples if now - sample.time <= MEMORY]
        if len(samples) < 2:
            return 0.0
        ahead = min(sample.offset + sample.way // 2 for sample in samples)
        # The other bound: each answer was written before it arrived. If they clash, trust none.
        if max(sample.offset - sample.way // 2 for sample in samples) > ahead + TOLERANCE:
            return 0.0
        late = (now - time_boot_ms * _MILLISECOND + ahead + _WRAP // 2) % _WRAP - _WRAP // 2
        return max(late, 0) * 1e-9

    def unanswered(self, now: int) -> float:
        """Return for how long, s, no question has been answered; 0 where none waits."""
        return 0.0 if self._unanswered_since is None else (now - self._unanswered_since) * 1e-9

    @property
    def best(self) -> Sample | None:
        """Return the best of the recent answers, None where there was none."""
        return min(self._samples.copy(), key=lambda sample: sample.way, default=None)

    def forget(self) -> None:
        """Drop what is known: the autopilot's clock has started anew."""
        self._samples.clear()
        self._asked.clear()
        self._unanswered_since = None
