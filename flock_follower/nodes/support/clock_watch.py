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
Steps of the system clock: stamps are corrected if it is set, for example by NTP.

The stamp of a message is on the system clock, which may jump; the monotonic clock never jumps. The
caller reads both clocks at the same time, and passes both times.
"""

from __future__ import annotations

import math

from flock_follower.messages import NANOSECONDS

#: A smaller change, s, is slewing or a late reading, and followed as it is.
LEAST_STEP = 0.1
#: For so long after a step messages come that were stamped before it, s.
ON_THE_WAY = 2.0
BEFORE_STEP = 'stamped before the system clock was set'


class ClockWatch:
    """
    Detects steps of the system clock, and messages that were stamped before the last step.

    ``clock_shift`` is the sum of all steps of the clock, ns: a stamp minus that sum is the time
    of a clock without steps.
    """

    def __init__(self) -> None:
        self.clock_shift = 0
        self._offset: int | None = None  # of the system clock from the monotonic one, ns
        self._monotonic = -math.inf
        self._stepped = -math.inf  # when the last step was found, by the monotonic clock, s
        self._first = 0  # ns: the least stamp there can be since

    def take(self, system: int, monotonic: float) -> float:
        """
        Take both clocks, read at the same time; return the step found, s, 0.0 if there was none.

        :param system: system clock, ns; :param monotonic: monotonic clock, s.
        """
        before, self._offset = self._offset, system - round(monotonic * NANOSECONDS)
        last, self._monotonic = self._monotonic, monotonic
        step = 0 if before is None else self._offset - before
        if abs(step) <= LEAST_STEP * NANOSECONDS:
            return 0.0
        self.clock_shift += step
        self._stepped, self._first = monotonic, system - round((monotonic - last) * NANOSECONDS)
        return step / NANOSECONDS

    def before_step(self, stamp: int) -> bool:
        """Return whether a stamp, ns, was made before the last step; 0 is no stamp."""
        if stamp <= 0 or self._offset is None or self._monotonic - self._stepped > ON_THE_WAY:
            return False
        now = self._offset + (self._monotonic + LEAST_STEP) * NANOSECONDS
        return not self._first <= stamp <= now
