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

"""The longest time for which a message waits for another message, from the observed waits."""

from __future__ import annotations

from collections import deque

LATE_MARGIN = 0.03  # s
MAX_WAIT = 0.35  # s: the parameter max_wait by default
N_OBSERVED = 50  # newest waits that count


class ObservedWait:
    """
    Waits for ``factor`` times the longest observed wait and LATE_MARGIN, at most ``max_wait``, s.

    :param needed: number of waits to observe before the limit can be below ``max_wait``.
    """

    def __init__(self, max_wait: float, factor: float, needed: int) -> None:
        self._max_wait, self._factor, self._needed = max_wait, factor, needed
        self._waits: deque[float] = deque(maxlen=N_OBSERVED)

    @property
    def limit(self) -> float:
        """Return the present limit of the wait, s."""
        if len(self._waits) < self._needed:
            return self._max_wait
        return min(self._factor * max(self._waits) + LATE_MARGIN, self._max_wait)

    def observe(self, waited: float) -> None:
        """Record the length, s, of a wait that ended with the expected message."""
        self._waits.append(waited)

    def forget(self) -> None:
        """Forget the observed waits, because the expected message may now come later."""
        self._waits.clear()
