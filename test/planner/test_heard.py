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

"""What others tell of a neighbour: used where the eyes know nothing, and told as what it is."""

from __future__ import annotations

from flown import own, PARAMS, seen
import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.inputs import Neighbor
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.step import Decision, step


def reported(stamp: float, x: float = 2.0, received: bool = True, name: str = 'leader',
         variance: float = 0.0, speed: float = 0.0) -> Neighbor:
    return seen(stamp, (x, 0.0, 2.0), (speed, 0.0, 0.0), name,
                position_covariance=variance * np.eye(3), received=received)


def decide(memory: Memory, now: float, *neighbors: Neighbor,
           params: PlannerParams = PARAMS) -> tuple[Memory, Decision]:
    return step(memory, now, True, own(now), neighbors, params)


def place(memory: Memory, name: str = 'leader') -> float:
    return float(memory.neighbors[name].position[0])


def test_who_is_seen_freshly_is_never_replaced_by_what_is_heard() -> None:
    memory, _ = decide(Memory(), 0.0, reported(0.0, 2.0, received=False))
    memory, decision = decide(memory, 0.3, reported(0.3, 2.4))
    assert place(memory) == 2.0 and decision.rejected == ()
    memory, decision = decide(memory, 0.51, reported(0.5, 2.4))
    assert place(memory) == 2.4 and decision.state is State.TRACK


@pytest.mark.parametrize('x', [2.1, 4.0])  # a little, and a jump
def test_eyes_beat_words_at_once_even_newer_ones(x: float) -> None:
    memory, _ = decide(Memory(), 0.1, reported(0.1, 2.0))
    memory, decision = decide(memory, 0.2, reported(0.05, x, received=False))
    assert place(memory) == x and decision.rejected == ()
    assert set(memory.flock) == {'leader'}  # nobody at the place that was only told


def test_words_are_used_up_to_their_own_age() -> None:
    memory, states = Memory(), []
    for tick in range(14):
        memory, decision = decide(memory, 0.1 * tick, *([reported(0.0)] if tick == 0 else []))
        states.append(decision.state)
    assert states == [State.TRACK] * 11 + [State.COAST] * 3
    late = decide(Memory(), 1.2, reported(0.1))[1]
    assert late.state is State.SEARCH
    assert [r.reason for r in late.rejected] == ['received estimate too old']


def command(variance: float) -> Array:
    decision = decide(Memory(), 0.0, reported(0.0, 1.6, variance=variance, speed=-0.1))[1]
    assert decision.acceleration is not None
    return decision.acceleration


def test_the_less_sure_a_word_the_farther_away_it_stays() -> None:
    pushed = [command(variance)[0] for variance in (0.0, 0.02, 0.04, 0.08)]
    assert pushed[0] > -0.3
    assert np.all(np.diff(pushed[:3]) < 0.0) and max(pushed[2:]) < -1.0
    refused = decide(Memory(), 0.0, reported(0.0, variance=0.09))[1]
    assert [r.reason for r in refused.rejected] == ['received estimate too uncertain']
