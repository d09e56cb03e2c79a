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

"""Roles and hulls: who is followed, who only kept clear of, and how large everybody is."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.typing import ArrayLike
import pytest

from flock_follower.flocking import acceleration
from flock_follower.geometry import Array
from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import ALTITUDE_MODES, Member, PlannerParams
from flock_follower.planner.step import Decision, step

STILL = (0.0, 0.0, 0.0)
STRANGER = {'stranger': Member('avoid')}
PARAMS = PlannerParams(vehicles=STRANGER)


def own(stamp: float = 0.0, velocity: ArrayLike = STILL) -> OwnState:
    return OwnState(stamp, np.array([0.0, 0.0, 2.0]), np.array(velocity), 0.0)


def seen(name: str, stamp: float, x: float, y: float = 0.0, velocity: ArrayLike = STILL,
         z: float = 2.0) -> Neighbor:
    return Neighbor(name, stamp, np.array([x, y, z]), np.array(velocity))


def decide(*neighbors: Neighbor, memory: Memory | None = None, now: float = 0.0,
           params: PlannerParams = PARAMS) -> tuple[Memory, Decision]:
    return step(memory or Memory(), now, True, own(now), neighbors, params)


def commanded(decision: Decision) -> Array:
    assert decision.acceleration is not None
    return decision.acceleration


def test_one_to_avoid_is_never_followed() -> None:
    memory = Memory()
    for tick in range(30):
        memory, decision = decide(seen('stranger', 0.1 * tick, 2.6, 0.0, (0.4, 0.0, 0.0), 3.0),
                                  memory=memory, now=0.1 * tick)
        assert decision.state is State.SEARCH
        assert decision.edges == () and decision.stamp is None
        assert commanded(decision)[:2] == pytest.approx([0.0, 0.0], abs=1e-9)
        assert memory.altitude is not None and memory.altitude.held == 2.0


def test_a_second_print_of_the_leaders_marker_is_avoided_and_never_followed() -> None:
    params = PlannerParams(vehicles={'leader': Member('leader', 0.3)})
    _, decision = decide(seen('leader/duplicate', 0.0, 1.3, 0.0, (-0.3, 0.0, 0.0)),
                         params=params)
    assert decision.state is State.SEARCH and decision.edges == ()
    assert commanded(decision)[0] < -1.0 and 'separation' in decision.limits
    _, decision = decide(seen('leader', 0.0, 0.0, 2.1),
                         seen('leader/duplicate_2', 0.0, 1.3, 0.0, (-0.3, 0.0, 0.0)),
                         params=params)
    assert decision.edges == ('leader',)
    assert commanded(decision)[0] < -1.0 and 'separation' in decision.limits


@pytest.mark.parametrize('following', [False, True])
def test_one_to_avoid_is_kept_clear_of_whether_or_not_somebody_is_followed(
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
    assert commanded(decision)[0] == pytest.approx(-2.5) and 'separation' in decision.limits
    assert decision.warnings == ()
    closer = seen('leader', 0.0, 2.1)
    assert decide(closer, params=guarded)[1].warnings == (
        'leader 0.90 m away, the band begins at 1.00 m: too close',)
    assert 'separation' not in decide(near, params=PlannerParams())[1].limits


def test_hulls_that_overlap_are_driven_apart() -> None:
    params = PlannerParams(radius=1.0, vehicles={'leader': Member('leader', 1.0)})
    decision = decide(seen('leader', 0.0, 1.5), params=params)[1]
    assert commanded(decision)[0] < -1.0


@pytest.mark.parametrize(('changes', 'message'), [
    ({'role': 'boss'}, "^role = 'boss': must be one of leader, follower, avoid$"),
    ({'radius': -0.1}, r'^radius = -0\.1: must be a number in \[0, 5\] m$'),
    ({'radius': math.nan}, r'^radius = nan: must be a number in \[0, 5\] m$')])
def test_what_a_vehicle_cannot_be_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Member(**changes)  # type: ignore[arg-type]


WILD = [math.nan, math.inf, -math.inf, 1e308, 60.0, 0.0]


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2 ** 32), st.integers(1, 14), st.sampled_from(ALTITUDE_MODES))
@pytest.mark.filterwarnings('ignore:overflow')
def test_limits_hold_with_any_number_of_neighbors_of_any_kind(seed: int, count: int,
                                                              altitude_mode: str) -> None:
    rng = np.random.default_rng(seed)
    roles = {f'n{k}': Member(str(rng.choice(['leader', 'follower', 'avoid'])),
                             float(rng.choice([0.0, 0.3, 1.5]))) for k in range(count)}
    params = PlannerParams(altitude_mode=altitude_mode, vehicles=roles, v_max=float(
        rng.choice([0.5, 2.0])), radius=float(rng.choice([0.0, 0.4])))
    memory, now, at_rest = Memory(), 100.0, rng.random() < 0.5
    for _ in range(15):
        now += float(rng.choice([0.1] * 15 + [0.7, 3.0]))
        me = OwnState(now, rng.uniform(-0.2, 0.2, 3), np.zeros(3) if at_rest else rng.uniform(
            -0.6, 0.6, 3), 0.0)
        told = []
        for name in roles:
            if rng.random() < 0.3:
                continue
            position, velocity = rng.uniform(-4.0, 4.0, 3), rng.uniform(-0.6, 0.6, 3)
            if rng.random() < 0.05:
                position[rng.integers(3)] = rng.choice(WILD)
            told.append(Neighbor(
                name, now - float(rng.choice([0.0, 0.1, 0.4, 0.9, 3.0])), position, velocity,
                np.eye(3) * float(rng.choice([0.0, 1e-4, 0.02, math.nan])),
                heard=rng.random() < 0.5))
        memory, decision = step(memory, now, True, me, told, params)
        follow = [n for n in memory.neighbors.values() if roles[n.name].role != 'avoid']
        assert (decision.state is State.TRACK) == bool(follow)
        assert {*decision.edges} <= {n.name for n in follow}
        assert bool(decision.edges) == bool(follow)
        assert decision.acceleration is not None
        assert np.all(np.isfinite(decision.acceleration))
        assert np.linalg.norm(decision.acceleration) <= params.a_max
        reached = me.velocity + params.period * decision.acceleration
        assert np.linalg.norm(reached) <= max(float(np.linalg.norm(me.velocity)), params.v_max)
        assert abs(decision.yaw_rate) <= params.yaw_rate_max
