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

"""The planner's state machine, and the command of one step in each state."""

from __future__ import annotations

from dataclasses import replace
import math
from typing import Any

from flown import commanded, step, STILL
from flown import seen as leader
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.typing import ArrayLike
from one_step import decide, FREE, LAW, own, PARAMS, tracking
import pytest

from flock_follower.flocking import acceleration, FlockingParams
from flock_follower.geometry import Array
from flock_follower.planner.bound_keeping import SPEED_TIME
from flock_follower.planner.inputs import FUTURE_TOLERANCE, Neighbor
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import next_state, State
from flock_follower.planner.params import (
    ALTITUDE_MODES,
    AVOID,
    COLUMN_V_MAX,
    FOLLOWER,
    Member,
    PlannerParams,
    ROLES,
)
from flock_follower.planner.scene import Decision


@pytest.mark.parametrize(('engaged', 'fault', 'youngest', 'followed', 'expected'), [
    (False, '', 0.0, None, State.IDLE),
    (False, '', None, 0.1, State.IDLE),
    (False, 'no odometry', None, None, State.IDLE),
    (True, '', None, None, State.SEARCH),
    (True, '', 0.6, None, State.SEARCH),
    (True, '', 0.0, None, State.TRACK),
    (True, '', -0.05, 0.1, State.TRACK),
    (True, '', 0.5, 0.5, State.TRACK),
    (True, '', 0.51, 0.51, State.COAST),
    (True, '', None, 2.0, State.COAST),
    (True, '', None, 2.01, State.HOLD),
    (True, '', 0.0, 60.0, State.TRACK),
    (True, 'no odometry', 0.0, None, State.SEARCH),
    (True, 'odometry 1 s old', 0.0, 0.1, State.HOLD),
])
def test_state_follows_from_the_age_of_the_inputs(engaged: bool, fault: str,
                                                  youngest: float | None, followed: float | None,
                                                  expected: State) -> None:
    state, reason = next_state(engaged, fault, youngest, followed, PARAMS)
    assert state is expected
    assert bool(reason) == (state is not State.TRACK)
    assert fault in reason or not engaged


def test_track_applies_the_law_to_states_predicted_to_now() -> None:
    me = own(0.9, (0.1, -0.2, 2.0), (0.2, 0.0, 0.0))
    it = leader(0.8, (2.0, 0.5, 2.1), (0.1, 0.4, 0.0))
    decision = decide(1.0, it, me=me, params=FREE)
    offset = it.position + 0.2 * it.velocity - me.position - 0.1 * me.velocity
    expected = acceleration([offset], [it.velocity - me.velocity], FREE.law)
    assert commanded(decision)[:2] == pytest.approx(expected[:2], rel=1e-9)
    assert (decision.state, decision.stamp, decision.limits) == (State.TRACK, 0.8, '')
    x, y, _ = offset
    w = it.velocity - me.velocity
    passing = (x * w[1] - y * w[0]) / (x ** 2 + y ** 2)
    assert decision.yaw == pytest.approx(math.atan2(y, x) + 0.4 * passing)  # of when it is there


def test_lost_leader_is_predicted_coasted_held_and_found() -> None:
    memory, states, along = tracking(velocity=(0.2, 0.0, 0.0)), [], []
    for tick in range(1, 30):
        me = own(0.1 * tick, velocity=(0.3, 0.0, 0.0))
        memory, decision = step(memory, 0.1 * tick, True, me, [], PARAMS)
        states.append(decision.state)
        along.append(commanded(decision)[0])
    assert states == [State.TRACK] * 5 + [State.COAST] * 15 + [State.HOLD] * 9
    # The longer it is out of sight the more places it may be in: out of its way.
    assert np.all(np.array(along[5:20]) < 0.0)
    assert np.all(np.array(along[20:]) < -0.5 * 0.3 / PARAMS.brake_time_constant)
    memory, decision = step(memory, 3.0, True, own(3.0), [leader(2.97)], PARAMS)
    assert (decision.state, decision.stamp) == (State.TRACK, 2.97)


@pytest.mark.parametrize(('silent', 'state'), [
    (None, State.TRACK), (-0.05, State.TRACK), (0.199, State.TRACK), (0.2, State.HOLD),
    (3.0, State.HOLD)])
def test_when_no_image_is_processed_any_more_it_brakes(silent: float | None,
                                                       state: State) -> None:
    me = own(0.1, velocity=(0.3, 0.0, 0.0))
    looked = None if silent is None else 0.1 - silent
    decision = step(tracking(), 0.1, True, me, [leader(0.1)], PARAMS, looked)[1]
    assert decision.state is state
    if state is State.HOLD:
        assert decision.reason == f'no image processed for {silent:.2f} s'
        assert commanded(decision) == pytest.approx(np.array([-1.0, 0.0, 0.0]))
        assert decision.stamp is None


def test_search_brakes_to_a_hover_until_a_neighbor_is_seen() -> None:
    decision = decide(0.0, me=own(velocity=(0.0, 0.3, 0.0)))
    assert decision.state is State.SEARCH
    assert commanded(decision) == pytest.approx(np.array([0.0, -1.0, 0.0]))
    assert decision.yaw == pytest.approx(0.3 + PARAMS.scan_rate * PARAMS.period)
    assert decision.stamp is None


def test_yaw_faces_leader_and_is_kept_when_lost_or_overhead() -> None:
    memory, decision = step(Memory(), 0.0, True, own(), [leader(0.0, (0.0, -2.0, 2.0))], LAW)
    assert decision.yaw == pytest.approx(-math.pi / 2)
    for now, seen in ((0.2, [leader(0.2, (0.05, 0.05, 4.0))]), (1.5, [])):
        memory, decision = step(memory, now, True, own(now, yaw=2.0), seen, LAW)
        assert decision.yaw == pytest.approx(-math.pi / 2)


def test_leader_seen_during_turn_turns_it_back() -> None:
    """Turning on to the yaw commanded last it lost the leader again."""
    memory = tracking()._replace(yaw=0.8, params=None)
    decision = decide(0.1, leader(0.1), me=own(0.1, yaw=0.3), memory=memory)
    assert decision.yaw == pytest.approx(0.2)


def test_engagement_yaw_and_altitude_are_held_by_mode() -> None:
    params = PlannerParams(yaw_mode='hold', altitude_mode='hold')
    memory, _ = step(Memory(), 0.0, True, own(yaw=1.1), [leader()], params)
    above = leader(0.1, (2.0, 0.0, 3.0))
    memory, decision = step(memory, 0.1, True, own(0.1, yaw=-2.0), [above], params)
    assert decision.yaw == 1.1
    assert memory.altitude is not None and memory.altitude.held == 2.0


def fly(ticks: int, params: PlannerParams, memory: Memory, start: int = 1,
        change: PlannerParams | None = None) -> tuple[Memory, Array]:
    """Return the commands to a follower at rest behind a leader that leaves at 0.4 m/s."""
    commands = []
    for tick in range(start, start + ticks):
        now = 0.1 * tick
        memory, decision = step(memory, now, True, own(now), [
            leader(now, (2.45, 0.0, 2.0), (0.4, 0.0, 0.0))], change or params)
        commands.append(commanded(decision))
    return memory, np.array(commands)


def test_engaging_fades_the_laws_command_in_from_nothing() -> None:
    params = replace(PARAMS, guard=False, v_max=5.0)
    law = acceleration([[2.45, 0.0, 0.0]], [[0.4, 0.0, 0.0]], params.law)
    _, commands = fly(8, params, Memory())
    assert commands[:, 0] == pytest.approx(law[0] * np.array([0.2, 0.4, 0.6, 0.8] + [1.0] * 4))
    assert np.array_equal(commands[5, :2], law[:2])  # from then on it is the law bit for bit


def test_a_change_of_parameters_and_seeing_again_make_no_jump() -> None:
    params = replace(PARAMS, guard=False, v_max=5.0)
    stronger = replace(params, law=replace(params.law, K=3.0))
    memory, before = fly(10, params, Memory())
    memory, after = fly(10, params, memory, 11, stronger)
    jumps = np.linalg.norm(np.diff(np.vstack([before[-1:], after]), axis=0), axis=1)
    assert jumps[:5] == pytest.approx(np.linalg.norm(after[-1] - before[-1]) / 5)
    assert jumps[5:] == pytest.approx(0.0)
    for tick in range(21, 30):  # unseen for long enough to coast
        memory, decision = step(memory, 0.1 * tick, True, own(0.1 * tick), [], stronger)
    assert decision.state is State.COAST
    _, again = fly(5, stronger, memory, 30)
    assert np.linalg.norm(again[0]) == pytest.approx(np.linalg.norm(after[-1]) / 5)


def test_the_guard_acts_at_once_while_the_law_is_being_faded_in() -> None:
    near = leader(0.0, (1.1, 0.0, 2.0), (-0.3, 0.0, 0.0))
    decision = decide(0.0, near)
    assert commanded(decision)[0] < -1.5
    assert 'separation' in decision.limits


def test_guard_equals_law_bit_for_bit_without_risk() -> None:
    rng = np.random.default_rng(5)
    memories = [Memory(), Memory()]
    for tick in range(200):
        now = 0.1 * tick
        me = own(now, velocity=rng.normal(0.0, 0.02, 3))
        it = leader(now, rng.normal([2.0, 0.0, 2.0], 0.01), rng.normal(0.0, 0.02, 3))
        (memories[0], law), (memories[1], guarded) = (
            step(memory, now, True, me, [it], replace(PARAMS, guard=on))
            for memory, on in zip(memories, (False, True)))
        assert commanded(law).tobytes() == commanded(guarded).tobytes()


@pytest.mark.parametrize(('speed', 'clear'), [(-0.3, False), (1.3, True)])
def test_coasting_keeps_clear_of_where_a_lost_neighbor_should_be(
        speed: float, clear: bool) -> None:
    memory = tracking(position=(1.6, 0.0, 2.0), velocity=(speed, 0.0, 0.0))
    for tick in range(1, 10):
        memory, decision = step(memory, 0.1 * tick, True, own(0.1 * tick), [], PARAMS)
    assert decision.state is State.COAST
    assert np.array_equal(commanded(decision), np.zeros(3)) == clear
    assert (decision.stamp is None) == clear
    if not clear:
        assert commanded(decision)[0] < -0.5
        assert (decision.limits, decision.stamp) == ('separation', 0.0)
        _, free = step(memory, 2.0, True, own(2.0), [], replace(PARAMS, guard=False))
        assert np.array_equal(commanded(free), np.zeros(3))


def test_lost_one_is_kept_clear_of_while_other_is_followed() -> None:
    near = leader(0.0, (1.5, 0.0, 2.0), (-0.3, 0.0, 0.0), name='near')
    memory, _ = step(Memory(), 0.0, True, own(), [near], PARAMS)
    for tick in range(1, 11):
        now = 0.1 * tick
        beside = leader(now, (0.0, 2.0, 2.0), name='beside')
        memory, decision = step(memory, now, True, own(now), [beside], PARAMS)
    assert set(memory.neighbors) == {'beside'}
    assert (decision.state, decision.stamp) == (State.TRACK, 1.0)
    assert commanded(decision)[0] < -0.5
    assert 'separation' in decision.limits


def test_a_command_on_its_way_counts_as_flown() -> None:
    """Approaching at a speed that it may just have, one that brakes already brakes less."""
    near = leader(0.5, (1.5, 0.0, 2.0))
    me = own(0.5, velocity=(0.45, 0.0, 0.0))
    fresh, braking = (decide(0.5, near, me=me, memory=Memory(pending=np.array([v, 0.0, 0.0])))
                      for v in (0.0, -0.2))
    assert 'separation' in fresh.limits
    assert commanded(fresh)[0] < commanded(braking)[0] - 0.5


def test_drag_does_not_keep_it_below_its_largest_speed() -> None:
    """It fell back at 0.48 m/s: commands that only offset the drag counted as coming speed."""
    memory, x, v, a = Memory(), np.array([0.0, 0.0, 2.0]), np.zeros(3), np.zeros(3)
    for tick in range(150):
        now = 0.1 * tick
        it = leader(now, (2.3 + 0.49 * now, 0.0, 2.0), (0.49, 0.0, 0.0))
        memory, decision = step(memory, now, True, own(now, x, v), [it], PARAMS)
        for _ in range(10):
            a = a + 0.01 / PARAMS.response_time * (commanded(decision) - a)
            v = v + 0.01 * (a - 0.15 * v)
            x = x + 0.01 * v
        assert v[0] < PARAMS.v_max + 0.01
    assert v[0] > 0.485


@pytest.mark.parametrize(('it', 'warning'), [
    (leader(0.0, (2.0, 0.0, 2.0), (0.9, 0.0, 0.0)),
     'leader at 0.9 m/s, v_max 0.5 m/s: cannot keep up'),
    (leader(0.0, (0.8, 0.0, 2.0)), 'leader is too close: 0.80 m, the band begins at 1.00 m'),
    (leader(0.0, (3.2, 0.0, 2.0)), 'leader is too far: 3.20 m, the band ends at 2.83 m'),
])
def test_a_motion_beyond_its_means_is_a_warning(it: Neighbor, warning: str) -> None:
    assert decide(0.0, it).warnings == (warning,)
    assert decide(0.0, leader()).warnings == ()


WILD = [math.nan, math.inf, -math.inf, 1e308, -1e308, 60.0, 0.0]
STAMPS = [0.0, -0.02, -0.1, -0.25, 0.05] * 5 + [-0.31, -0.6, -1.9, -12.0, 0.2, 8.0, math.nan]


def draw_state(rng: np.random.Generator, now: float) -> tuple[float, Array, Array]:
    """Return a stamp, position and velocity, mostly usable, sometimes of any other kind."""
    position, velocity = rng.uniform(-3.0, 3.0, 3), rng.uniform(-0.6, 0.6, 3)
    for vector in (position, velocity):
        if rng.random() < 0.1:
            vector[rng.integers(3)] = rng.choice(WILD)
    return now + float(rng.choice(STAMPS)), position, velocity


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2 ** 32), st.integers(1, 8), st.sampled_from(ALTITUDE_MODES))
@pytest.mark.filterwarnings('ignore:overflow')
def test_no_command_is_stale_or_beyond_limits(seed: int, count: int,
                                              altitude_mode: str) -> None:
    """Whatever comes, of neighbors of any kind."""
    rng = np.random.default_rng(seed)
    roles = {f'n{k}': Member(str(rng.choice(ROLES)), float(rng.choice([0.0, 0.3, 1.5])))
             for k in range(count)}
    vehicles = roles if count > 1 else {}
    column = any(each.role == FOLLOWER for each in vehicles.values())
    params = PlannerParams(altitude_mode=altitude_mode, vehicles=vehicles,
                           v_max=float(rng.choice([0.5, COLUMN_V_MAX if column else 2.0])))
    memory, now = Memory(), 100.0
    for _ in range(25):
        now += float(rng.choice([0.1] * 15 + [0.7, 3.0, -0.05, -8.0]))
        engaged = rng.random() < 0.95
        me = own(*draw_state(rng, now)) if rng.random() < 0.8 else None
        around = [leader(*draw_state(rng, now), name, received=rng.random() < 0.3,
                         position_covariance=np.eye(3) * float(rng.choice([0.0, 1e-4, math.nan])))
                  for name in roles if rng.random() < 0.5]
        memory, decision = step(memory, now, engaged, me, around, params)
        assert {*decision.edges} <= {name for name, n in memory.neighbors.items()
                                     if n.member.role != AVOID}
        assert engaged or decision.state is State.IDLE
        if decision.acceleration is None:
            assert decision.yaw is None
            continue
        assert engaged and memory.own is not None and decision.yaw is not None
        assert -FUTURE_TOLERANCE <= now - memory.own.stamp <= params.odom_timeout
        if decision.state is State.TRACK:
            assert decision.edges and decision.stamp is not None
            assert -FUTURE_TOLERANCE <= now - decision.stamp <= params.heard_timeout
        elif decision.stamp is not None:  # to keep clear of one that is lost
            assert decision.state is State.COAST and 'separation' in decision.limits
        assert np.all(np.isfinite([*decision.acceleration, decision.yaw]))
        assert np.linalg.norm(decision.acceleration) <= params.a_max
        reached = memory.own.velocity + decision.acceleration * params.period
        speed = float(np.linalg.norm(memory.own.velocity))
        assert np.linalg.norm(reached) <= max(speed, params.v_max)
        assert abs(decision.yaw_rate) <= params.yaw_rate_max


@pytest.mark.parametrize(('change', 'message'), [
    ({'a_max': -1.0}, r'^a_max = -1\.0: must be a number in \[1\.5, 20\] m/s\^2$'),
    ({'v_max': math.nan}, r'^v_max = nan: must be a number in \[0\.1, 5\] m/s$'),
    ({'coast_timeout': 0.4},
     r'^coast_timeout = 0\.4: must be at least predict_timeout = 0\.5$'),
    ({'yaw_mode': 'spin'}, r"^yaw_mode = 'spin': must be one of leader, hold$"),
])
def test_bad_parameters_are_named_with_value_and_range(change: dict[str, Any],
                                                       message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PlannerParams(**change)


def test_default_law_is_that_of_the_papers_flights() -> None:
    assert PARAMS.law == FlockingParams(K=1.0, sigma=1.0, beta=0.25, theta=2.0, d0=1.0, d1=8.0)


LOWERED = replace(PARAMS, a_max=1.5, v_max=0.1, a_max_start=2.5, v_max_start=0.5)


def settled(it: Neighbor, velocity: ArrayLike, params: PlannerParams) -> Decision:
    """Return the decision once the law is faded in, with a leader that stays where it is."""
    memory = Memory()
    for tick in range(8):
        now = 0.1 * tick
        memory, decision = step(memory, now, True, own(now, velocity=velocity), [
            it._replace(stamp=now)], params)
        memory = memory._replace(own=None)  # where it is is no jump
    return decision


def test_v_max_is_approached_within_speed_time() -> None:
    """Not within one period, in which the noise of the velocity would be a command."""
    leaving = leader(0.0, (3.2, 0.0, 2.0), (0.5, 0.0, 0.0))
    for speed in (0.4, 0.46):  # what was commanded before counts for 0.3 s
        command = commanded(settled(leaving, (speed, 0.0, 0.0), PARAMS))
        assert command[0] == pytest.approx((PARAMS.v_max - speed) / (SPEED_TIME + 0.3), rel=0.02)


def test_lowered_limits_bind_what_is_wanted() -> None:
    far = leader(0.0, (3.5, 0.0, 2.0))
    assert np.linalg.norm(commanded(settled(far, STILL, LOWERED))) <= 0.1 / 0.3 + 1e-6
    assert np.linalg.norm(commanded(settled(far, STILL, PARAMS))) > 0.5
    slowing = commanded(settled(far, (0.3, 0.0, 0.0), LOWERED))
    assert -1.5 <= slowing[0] < -0.5  # faster than v_max now allows


def test_braking_and_separation_keep_the_limits_of_the_start() -> None:
    near = settled(leader(0.0, (1.0, 0.0, 2.0)), (0.1, 0.0, 0.0), LOWERED)
    assert 'separation' in near.limits
    assert commanded(near)[0] < -0.7
    coming = settled(leader(0.0, (0.9, 0.0, 2.0), (-0.5, 0.0, 0.0)), (0.3, 0.0, 0.0), LOWERED)
    assert -2.5 < commanded(coming)[0] < -1.6  # a_max, lowered, would leave -1.5
    fast = (0.4, 0.0, 0.0)
    for params in (LOWERED, PARAMS):
        _, decision = step(Memory(), 0.0, True, own(velocity=fast), [], params)
        assert decision.state is State.SEARCH
        assert commanded(decision)[0] == pytest.approx(-0.4 / 0.3, rel=1e-3)
