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

"""Radios of simulated flocks: messages that come late or not at all, and measured distances."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np

from flock_desk.scenarios.scenario import RangeErrors
from flock_follower.geometry import Array

Message = TypeVar('Message')


class Radio(Generic[Message]):
    """
    Messages within flocks of m vehicles; no flock receives messages of another.

    :param company: m, the number of vehicles in each flock.
    :param delay: time from sending to arrival, s.
    :param loss: share of messages that do not arrive at one of the receivers.
    :param generators: random generators, one for each follower, flock by flock.
    """

    def __init__(self, company: int, delay: float, loss: float,
                 generators: Sequence[np.random.Generator]) -> None:
        self._company, self._delay, self._loss = company, delay, loss
        self._generators = generators
        self._coming: deque[tuple[float, int, Message]] = deque()

    def send(self, now: float, sender: int, messages: Sequence[Message]) -> None:
        """Take messages that a follower, counted through all flocks, sends at a time, s."""
        first = sender - sender % self._company
        draws = self._generators[sender].random((len(messages), self._company))
        for message, luck in zip(messages, draws.tolist()):
            self._coming += [
                (now + self._delay, first + k, message) for k, p in enumerate(luck)
                if first + k != sender and p >= self._loss]

    def arrived(self, now: float) -> list[tuple[int, Message]]:
        """Return the messages that have arrived since the last call, each with its receiver."""
        received = []
        while self._coming and self._coming[0][0] <= now + 1e-9:
            _, receiver, message = self._coming.popleft()
            received.append((receiver, message))
        return received


class Radios:
    """
    Measure distances with the errors of a scenario.

    :param generators: of the random numbers, one for each row.
    """

    def __init__(self, errors: RangeErrors, generators: Sequence[np.random.Generator]) -> None:
        self._errors, self._generators = errors, generators
        self._bias = errors.bias * np.array([g.standard_normal() for g in generators])
        self._walk = errors.bias_walk * errors.rate ** -0.5

    def measure(self, distance: Array) -> Array:
        """Return measurements of true distances (n,), m, one period after the last."""
        errors = self._errors
        drawn = np.stack([g.standard_normal(2) for g in self._generators])
        chance = np.stack([g.random(2) for g in self._generators])
        self._bias = self._bias + self._walk * drawn[:, 0]
        detour = np.where(chance[:, 0] < errors.outliers, errors.outlier * chance[:, 1], 0.0)
        measured: Array = np.maximum(
            distance + self._bias + errors.noise * drawn[:, 1] + detour, 0.0)
        return measured
