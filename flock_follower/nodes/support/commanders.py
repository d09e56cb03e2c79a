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

"""Who commands, asked of the messages and of the graph, and what the bridge is told of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
import time
from typing import Any, Final

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from flock_follower.mavlink.flight_end import CommandSources
from flock_follower.nodes.support.diagnostics import listed, publishers, UNNAMED, WARN

POLL_PERIOD: Final = 0.05  # s between two looks at the graph
LOOKS: Final = 40  # for a name that it does not know yet
_UNNUMBERED: Final = ('this middleware numbers no messages: that a second node commands shows on '
                      '/diagnostics, but does not brake')


class Commanders:
    """
    Notices that two nodes command, and who they are.

    :param topic: that of the commands.
    :param log: of the diagnostics: level and message, at most once per 5 s.
    :param second: called with who they are; again where the graph names them later.
    """

    def __init__(self, node: Node, topic: str, log: Callable[[bytes, str], None],
                 second: Callable[[str], None]) -> None:
        self._node, self._topic = node, topic
        self._log, self._second = log, second
        self._sources = CommandSources()
        self._numbered = True
        self._told = -math.inf
        self._seen = self._looks = 0
        self._timer = node.create_timer(POLL_PERIOD, self._look_again,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.cancel()

    def heard(self, info: Mapping[str, Any], now: float) -> None:
        """Take how a command came at ``now``, s on the monotonic clock."""
        number, received = info['publication_sequence_number'], info['received_timestamp']
        if number is None and self._numbered:
            self._numbered = False
            self._log(WARN, _UNNUMBERED)
        # When it came, not when its turn came: two may have waited that came far apart.
        waited = max(time.time_ns() - received, 0) * 1e-9 if received else 0.0
        if self._sources.another(number, now - waited) and now - self._told >= POLL_PERIOD:
            self._told = now
            self._tell(publishers(self._node, self._topic))

    def _tell(self, names: list[str]) -> None:
        self._seen = len(names)
        if UNNAMED in names and not self._looks:  # its endpoint is known before its node is
            self._looks = LOOKS
            self._timer.reset()
        self._second(f'{listed(names)} on {self._node.resolve_topic_name(self._topic)}')

    def _look_again(self) -> None:
        if not self._looks:
            return
        names = publishers(self._node, self._topic)
        named, gone = UNNAMED not in names, len(names) < self._seen
        self._looks -= 1
        if named or gone or not self._looks:
            self._looks = 0
            self._timer.cancel()
        if named and not gone:
            self._tell(names)
