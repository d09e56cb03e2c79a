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

"""Roles and hulls: vehicles to follow, vehicles to keep clear of, and their sizes."""

from __future__ import annotations

import flown
from flown import commanded, own, step, STILL
import numpy as np
from numpy.typing import ArrayLike
import pytest

from flock_follower.flocking import acceleration
from flock_follower.planner.inputs import Neighbor
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import EDGE_RETURN_SPEED, Member, PlannerParams
from flock_follower.planner.scene import Decision

STRANGER = {'stranger': Member('avoid')}
PARAMS = PlannerParams(vehicles=STRANGER)


def seen(name: str, stamp: float, x: float, y: float = 0.0, velocity: ArrayLike = STILL,
         z: float = 2.0) -> Neighbor:
    return flown.seen(stamp, (x, y, z), velocity, name)


def decide(*neighbors: Neighbor, memory: Memory | None = None, now: float = 0.0,
           params: PlannerParams = PARAMS) -> tuple[Memory, Decision]:
    return step(memory or Memory(), now, True, own(now), neighbors, params)


def test_one_to_avoid_is_never_followed() -> None:
    memory = Memory()
    for tick in range(30):
        memory, decision = decide(seen('stranger', 0.1 * tick, 2.6, 0.0, (0.4, 0.0, 0.0), 3.0),
                                  memory=memory, now=0.1 * tick)
        assert decision.state is State.SEARCH
        assert decision.edges == () and decision.stamp is None
        assert commanded(decision)[:2] == pytest.approx([0.0, 0.0], abs=1e-9)
        assert memory.altitude is not None and memory.altitude.held == 2.0


def test_second_print_of_leader_is_avoided_never_followed() -> None:
    params = PlannerParams(vehicles={'leader': Member('leader', 0.3)})
    _, decision = decide(seen('leader/duplicate', 0.0, 1.3, 0.0, (-0.3, 0.0, 0.0)),
                         params=params)
    assert decision.state is State.SEARCH and decision.edges == ()
    assert commanded(decision)[0] < -1.0 and 'separation' in decision.limits
    _, decision = decide(seen('leader', 0.0, 0.0, 2.1),
                         seen('leader/duplicate_2', 0.0, 1.3, 0.0, (-0.3, 0.0, 0.0)),
                         params=params)
    assert decision.edges == ('leader',)
    assert commanded(decision)[0] < -1.0


@pytest.mark.parametrize('following', [False, True])
def test_avoided_one_is_kept_clear_of_with_or_without_leader(
        following: bool) -> None:
    near = seen('stranger', 0.0, 1.1, 0.0, (-0.3, 0.0, 0.0))
    leader = [seen('leader', 0.0, 0.0, 2.1)] if following else []
    memory, decision = decide(near, *leader)
    assert commanded(decision)[0] < -1.0 and 'separation' in decision.limits
    assert decision.edges == (('leader',) if following else ())
    for tick in range(1, 30):  # gone: it is awaited nowhere for ever
        memory, decision = decide(memory=memory, now=0.1 * tick)
    assert 'stranger' not in memory.flock or following


def test_coasting_and_holding_it_keeps_clear_of_one_to_avoid() -> None:
    memory, _ = decide(seen('leader', 0.0, 2.0))
    for tick in range(1, 40):
        near = seen('stranger', 0.1 * tick, 0.0, 1.2, (0.0, -0.2, 0.0))
        memory, decision = decide(near, now=0.1 * tick, memory=memory._replace(
            pending=np.zeros(3)))
        assert 'separation' in decision.limits and commanded(decision)[1] < -0.5
    assert decision.state is State.HOLD


def test_the_law_and_the_guard_act_between_hulls() -> None:
    big = PlannerParams(radius=0.4, vehicles={'leader': Member('leader', 0.8)}, guard=False,
                        handover_time=0.0, v_max=5.0)
    it = seen('leader', 0.0, 3.2, 0.0, (0.1, 0.05, 0.0))
    expected = acceleration([[2.0, 0.0, 0.0]], [[0.1, 0.05, 0.0]], big.law)
    assert commanded(decide(it, params=big)[1]) == pytest.approx(expected, abs=1e-9)
    near = seen('leader', 0.0, 2.3, 0.0, (-0.3, 0.0, 0.0))
    guarded = PlannerParams(radius=0.4, vehicles={'leader': Member('leader', 0.8)})
    decision = decide(near, params=guarded)[1]
    assert commanded(decision)[0] < -1.5 and 'separation' in decision.limits
    assert decision.warnings == ()
    closer = seen('leader', 0.0, 2.1)
    assert decide(closer, params=guarded)[1].warnings == (
        'leader is too close: 0.90 m, the band begins at 1.00 m',)
    assert 'separation' not in decide(near, params=PlannerParams())[1].limits


def test_hulls_that_overlap_are_driven_apart() -> None:
    params = PlannerParams(radius=1.0, vehicles={'leader': Member('leader', 1.0)})
    decision = decide(seen('leader', 0.0, 1.5), params=params)[1]
    assert commanded(decision)[0] == pytest.approx(
        -EDGE_RETURN_SPEED / params.guarding.T_g, rel=1e-3)


def test_listed_vehicle_neither_seen_nor_received_is_reported() -> None:
    params = PlannerParams(vehicles={
        'leader': Member(), 'a': Member('follower'), 'b': Member('follower'), **STRANGER})
    leader, beside = seen('leader', 0.0, 2.0), seen('a', 0.0, 1.0, 1.8)
    received = beside._replace(received=True)
    for around, missing in (([leader, beside], 'b'), ([leader, received], 'b'),
                            ([leader], 'ab')):
        assert decide(*around, params=params)[1].warnings == tuple(
            f'{name} neither seen nor received: no distance to it is kept' for name in missing)
