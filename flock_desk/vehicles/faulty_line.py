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

"""One direction of a line to the embedded autopilot, and what its faults do to it."""

from __future__ import annotations

from collections.abc import Sequence
import heapq
import itertools
import random
from typing import Any

from flock_desk.vehicles.fault_script import Fault


class FaultyLine:
    """
    Holds messages until they arrive; a faultless one lets them through at once, and in order.

    :param direction: 'sent' or 'received', as the autopilot sees it.
    """

    def __init__(self, faults: Sequence[Fault], direction: str, seed: int) -> None:
        self._faults = [fault for fault in faults if fault.direction in (direction, 'both')]
        self._direction = direction
        self._random = random.Random(f'{seed} {direction}')
        self._queue: list[tuple[float, int, Any]] = []
        self._numbers = itertools.count()

    def put(self, kind: str, item: Any, time: float) -> None:
        """Send an item, a message of a type, at a time, s since the start."""
        copies, arrival = 1, time
        for fault in self._faults:
            if not fault.befalls(self._direction, kind, time) or not self._hits(fault):
                continue
            if fault.kind == 'drop':
                return
            if fault.kind == 'duplicate':
                copies += 1
            elif fault.kind == 'delay':
                arrival += fault.by
        for _ in range(copies):
            heapq.heappush(self._queue, (arrival, next(self._numbers), item))

    def take(self, time: float) -> list[Any]:
        """Return what has arrived."""
        items = []
        while self._queue and self._queue[0][0] <= time:
            items.append(heapq.heappop(self._queue)[2])
        return items

    def garbled(self, data: bytes, time: float) -> bytes:
        """Return bytes with the garbage that the line puts into them."""
        for fault in self._faults:
            if fault.kind == 'garbage' and fault.active(time) and self._hits(fault):
                garbage = self._random.randbytes(fault.size)
                # Before, within or behind what was sent.
                cut = self._random.choice([0, self._random.randint(0, len(data)), len(data)])
                data = data[:cut] + garbage + data[cut:]
        return data

    def _hits(self, fault: Fault) -> bool:
        return fault.share >= 1.0 or self._random.random() < fault.share
