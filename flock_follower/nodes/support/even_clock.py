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

"""A node's time that does not jump if the system clock is set."""

from __future__ import annotations

import time

from rclpy.node import Node

from flock_follower.nodes.support.clock_watch import BEFORE_STEP, ClockWatch
from flock_follower.nodes.support.runtime import FlockNode

READING_TIME = 1e-3  # s within which two clocks are read


class EvenClock(ClockWatch):
    """
    The time of a node, which does not jump if the system clock is set.

    ``clock_shift`` is the sum of all steps of the system clock, ns. With ``use_sim_time`` the time
    is that of /clock, and every stamp is used.
    """

    def __init__(self, node: FlockNode) -> None:
        super().__init__()
        self._node = node
        self.simulated = bool(node.get_parameter('use_sim_time').value)

    def now(self) -> int:
        """Return the time, ns; find a step of the system clock, and count it."""
        if self.simulated:
            return int(self._node.get_clock().now().nanoseconds)
        system, monotonic = read_clocks(self._node)
        if step := self.take(system, monotonic):
            self._node.diagnostics.reject('system clock was set', f'by {step:+.3f} s')
        return system - self.clock_shift

    def dated(self, stamp: int, arrival: int) -> int:
        """Return a message's stamp, ns, on this clock, but no later than the message's arrival."""
        return stamp if self.simulated else min(stamp, arrival) - self.clock_shift

    def fresh(self, topic: str, stamp: int) -> bool:
        """Return whether a stamp, ns, can be used; count the stamp if it is from before a step."""
        fresh = self.simulated or not self.before_step(stamp)
        if not fresh:
            self._node.diagnostics.reject(f'{topic} {BEFORE_STEP}', f'stamp {stamp * 1e-9:.3f} s')
        return fresh


def read_clocks(node: Node) -> tuple[int, float]:
    """Return a node's clock, ns, and the monotonic one, s, read at the same time."""
    for _ in range(3):  # a pause between two readings would look like a clock that was set
        before = time.monotonic()
        system: int = node.get_clock().now().nanoseconds
        after = time.monotonic()
        if after - before < READING_TIME:
            break
    return system, 0.5 * (before + after)
