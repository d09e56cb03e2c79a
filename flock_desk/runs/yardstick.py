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
A yardstick of the processor: how long a fixed piece of work takes, beside the nodes of a flight.

A share of a core means less work on a slow processor. The work is of the kinds that the nodes do:
Python, small arrays, one image. Its CPU time counts, not the time for which it waits.
"""

from __future__ import annotations

import time
from typing import Final

import cv2
import numpy as np

#: CPU time of the work on the machine that the bounds are made for, s: 1.8 ms to 1.9 ms measured
#: there, so that no bound is wider there.
REFERENCE: Final[float] = 2.0e-3
#: The share of the samples that are faster than the one that counts: programs beside make some
#: slower, by up to 1.8 times.
FASTER: Final[float] = 0.1
#: Time between two samples, s.
PERIOD: Final[float] = 1.0
#: Pixels of random gray levels, (240, 320).
_IMAGE: Final = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)


class Yardstick:
    """Measures the speed of a processor; times are monotonic, s."""

    def __init__(self) -> None:
        self.times: list[float] = []
        """CPU times of the work, s."""
        self._due = 0.0

    def sample(self, now: float) -> None:
        """Do the work, if PERIOD has passed since the last time."""
        if now >= self._due:
            self._due = now + PERIOD
            self.times.append(work())

    @property
    def speed(self) -> float | None:
        """Return the speed as a share of the reference; None if it was not measured."""
        return REFERENCE / float(np.quantile(self.times, FASTER)) if self.times else None


def work() -> float:
    """Do a fixed piece of work, and return its CPU time, s."""
    begin, total, matrix = time.thread_time(), 0, np.eye(6)
    for k in range(15_000):
        total += k * k % 7
    for _ in range(400):
        matrix = matrix.dot(matrix) + matrix
        matrix = matrix / (1.0 + matrix[0, 0])
    for _ in range(6):
        cv2.adaptiveThreshold(
            _IMAGE, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, 11, 5)
    return time.thread_time() - begin
