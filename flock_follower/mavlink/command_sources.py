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
Who commands: one node, or two at once.

rclpy does not tell which publisher a message came from. The middleware numbers the messages of
each publisher upwards from 1 (publication_sequence_number), and delivers those of one publisher in
order: a number that is not above the last one is another publisher's. Two that publish in turn
cannot keep clear of that, since between two numbers of the one there is none for the other.
"""

from __future__ import annotations

import math
from typing import Final

#: s without a command after which its publisher has stopped: three ticks of the planner, so that
#: a late tick is no pause; a planner that was killed takes longer than that to start again.
FELL_SILENT_AFTER: Final[float] = 0.3


class CommandSources:
    """Remembers who commanded last, to notice another one who does."""

    def __init__(self) -> None:
        self._number = 0
        self._time = -math.inf

    def another(self, number: int | None, time: float) -> bool:
        """
        Take a command; return whether it shows that two publishers command.

        Where the one before has fallen silent, the other has replaced it: that is one.

        :param number: what its publisher counts, from 1; None where the middleware does not tell.
        :param time: when it came, s on a monotonic clock.
        """
        if number is None:
            return False
        another = number <= self._number and time - self._time < FELL_SILENT_AFTER
        self._number, self._time = number, time
        return another
