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

"""Two followers in lock step that talk: what one is told reaches its planner, marked as heard."""

from __future__ import annotations

import numpy as np

from flock_follower.flock.exchange import Sharing
from flock_follower.follower import Follower, Listener
from flock_follower.geometry import IDENTITY_QUATERNION
from flock_follower.mavlink.gate import Gate
from flock_follower.messages import OdometryState, to_nanoseconds
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.params import PlannerParams

ORIGIN = {'front': np.array([5.0, 0.0, 0.0]), 'rear': np.array([0.0, -3.0, 0.2])}
TRUE = {'front': np.array([2.0, 0.0, 2.0]), 'rear': np.array([0.0, 0.0, 2.0])}


class Listening(Listener):
    """A listener that remembers words, and who was reckoned with in the last tick."""

    def __init__(self) -> None:
        self.said: list[tuple[int, list[OdometryState]]] = []
        self.rejections: list[str] = []

    def words(self, time: int, words: list[OdometryState]) -> None:
        self.said.append((time, words))

    def rejected(self, reason: str, detail: str) -> None:
        self.rejections.append(reason)


def state(name: str, child: str, of: str, time: float, seen: bool) -> OdometryState:
    pose = (0.01 ** 2 if seen else 0.0) * np.eye(6)
    return OdometryState(
        to_nanoseconds(time), 'odom', child, TRUE[of] + ORIGIN[name], IDENTITY_QUATERNION,
        np.zeros(3), np.zeros(3), pose, 0.01 * np.eye(6), np.eye(3))


def fly(talking: bool) -> dict[str, tuple[Follower, Listening]]:
    flock = {}
    for name in ORIGIN:
        listener = Listening()
        flock[name] = Follower(
            PlannerLoop(require_bridge=False), PlannerParams(), Gate(),
            listener, sharing=Sharing(name) if talking else None), listener
    for k in range(1, 151):
        now = 1.0 + k * 0.02
        for name, (follower, _) in flock.items():
            follower.odometry(to_nanoseconds(now), state(name, 'base_link', name, now, False))
        if k % 2:
            flock['rear'][0].neighbor(
                to_nanoseconds(now), state('rear', 'front', 'front', now, True))
        for name, (_, listener) in flock.items():
            for _, words in listener.said:
                for word in words:
                    for other, (follower, _) in flock.items():
                        if other != name:
                            follower.word(to_nanoseconds(now), word)
            listener.said.clear()
    return flock


def test_who_is_behind_is_known_by_its_words() -> None:
    flock = fly(talking=True)
    front, listener = flock['front']
    heard = front.planner.memory.neighbors
    assert heard.keys() == {'rear'}
    assert heard['rear'].heard
    assert np.allclose(heard['rear'].position, TRUE['rear'] + ORIGIN['front'], atol=0.02)
    assert 'not aligned with rear' in listener.rejections  # in the beginning
    rear = flock['rear'][0].planner.memory.neighbors
    assert rear.keys() == {'front'} and not rear['front'].heard


def test_without_words_nobody_is_told_anything() -> None:
    flock = fly(talking=False)
    assert flock['front'][0].planner.memory.neighbors == {}
    assert flock['front'][1].rejections == []
