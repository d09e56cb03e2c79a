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

"""How steadily the autopilot's messages arrive, and when to ask for them again."""

from __future__ import annotations

from collections import deque
import math
from typing import Final

#: Rates and pauses are told of this long, s.
RECENT: Final[float] = 5.0
#: A rate is judged over this long, s, or as long as ``FEWEST`` messages should take.
WINDOW: Final[float] = 1.0
FEWEST: Final[int] = 5
#: So many of a kind are remembered: RECENT at 400 Hz.
MOST: Final[int] = 2000
#: A message comes too seldom below this share of what was asked for; autopilots round intervals.
ENOUGH: Final[float] = 0.7
#: Time between two requests, s; the longest where asking does no good.
SHORTEST_WAIT: Final[float] = 2.0
LONGEST_WAIT: Final[float] = 30.0


class Arrivals:
    """When the messages of one autopilot came, by MAVLink's message id; times in s."""

    def __init__(self) -> None:
        self._times: dict[int, deque[float]] = {}
        self._newest = -math.inf
        # Times and lengths of pauses, each longer than all that came after it.
        self._pauses: deque[tuple[float, float]] = deque()

    def take(self, message_id: int, now: float) -> None:
        """Take a message that came at ``now``."""
        times = self._times.setdefault(message_id, deque(maxlen=MOST))
        times.append(now)
        while now - times[0] > RECENT:
            times.popleft()
        pause, self._newest = now - self._newest, now
        if math.isinf(pause):
            return
        while self._pauses and self._pauses[-1][1] <= pause:
            self._pauses.pop()
        self._pauses.append((now, pause))
        while now - self._pauses[0][0] > RECENT:
            self._pauses.popleft()

    def count(self, message_id: int, now: float, window: float) -> int:
        """Return how often a message came within ``window``, s, at most ``RECENT``."""
        times = self._times.get(message_id, deque()).copy()  # other threads read too
        return sum(now - window < time for time in times)

    def rate(self, message_id: int, now: float) -> float:
        """Return how often a message comes, Hz; 0 where the last is half of RECENT ago."""
        times = [time for time in self._times.get(message_id, deque()).copy()
                 if now - time < RECENT]
        if len(times) < 2 or now - times[-1] > 0.5 * RECENT:
            return 0.0
        return (len(times) - 1) / max(times[-1] - times[0], 1e-3)

    def longest_pause(self, now: float) -> float:
        """Return the longest time without any message that ended, or lasts, within RECENT, s."""
        ended = [pause for time, pause in self._pauses.copy() if now - time <= RECENT]
        return max([*ended, now - self._newest] if math.isfinite(self._newest) else [0.0])

    def too_seldom(self, message_id: int, wanted: float, now: float) -> bool:
        """Return whether a message comes well below the rate that was asked for, Hz."""
        window = min(max(WINDOW, FEWEST / wanted), RECENT)
        # One message more or less is chance.
        return self.count(message_id, now, window) + 1 < ENOUGH * wanted * window


class AskAgain:
    """
    When to ask again for messages that come too seldom: soon, but less and less often in vain.

    Another one on the same line may have set other rates (MAVProxy does, every 15 s): asking
    helps. A line that cannot carry more is only filled by asking.
    """

    def __init__(self) -> None:
        self._asked = self._low = -math.inf
        self._vain = 0

    def asked(self, now: float) -> None:
        """Begin afresh: everything was asked for at ``now``, s."""
        self._asked, self._vain = now, 0

    def due(self, low: bool, now: float) -> bool:
        """Return whether to ask at ``now``, s, where messages come too seldom (``low``) or not."""
        if not low:
            if now - max(self._low, self._asked) >= SHORTEST_WAIT:
                self._vain = 0
            return False
        self._low = now
        wait = min(SHORTEST_WAIT * 2 ** max(0, self._vain - 1), LONGEST_WAIT)
        if now - self._asked < wait:
            return False
        self._asked = now
        self._vain = min(self._vain + 1, 10)
        return True
