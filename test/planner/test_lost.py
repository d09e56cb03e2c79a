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

"""A leader out of sight: retreat, search, and following again within a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math
from typing import Any

from flown import commanded, Follower, own, PARAMS, seen, step
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.geometry import wrap_angle
from flock_follower.messages.commands import ODOMETRY_GAP
from flock_follower.planner.inputs import FRESH, Neighbor, predict
from flock_follower.planner.memory import Loss, Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import Member, PlannerParams
from flock_follower.planner.retreat import (
    DRIFT_SPEED,
    fallback_retreat,
    FallbackRetreat,
    retreat,
    RETREAT_TIME,
    STOPPING_TIME,
)
from flock_follower.planner.scene import survey
from flock_follower.planner.sight import FieldOfView

AHEAD = np.array([2.0, 0.0, 0.0])


def lost(distance: float = 1.6, closing: float = 0.4, params: PlannerParams = PARAMS) -> Follower:
    """Return a follower that has just lost a leader that comes nearer, straight ahead."""
    follower = Follower(params)
    for tick in range(10):
        place = np.array([distance + closing * 0.1 * (9 - tick), 0.0, 2.0])
        decision = follower.tick(seen(follower.now, place, (-closing, 0.0, 0.0)))
    assert decision.state is State.TRACK
    return follower


def test_out_of_sight_it_retreats_so_far_then_hovers_and_warns() -> None:
    follower = lost()
    begin, warned, heights = follower.position, [], []
    for _ in range(250):
        decision = follower.tick()
        warned.append(decision.warnings)
        heights.append(follower.position[2])
    assert decision.state is State.HOLD
    # What it moved while the leader was still predicted comes on top.
    most = RETREAT_TIME * PARAMS.v_max + 2.0 * 0.4  # it was coming at 0.4 m/s
    assert most - 0.2 < math.dist(begin, follower.position) < most + 0.2
    assert abs(follower.position[1]) > 0.5  # beside the path of the leader
    assert np.linalg.norm(follower.velocity) < 0.02
    assert 'out of the way of a neighbor out of sight' in warned[-1][0]
    assert not warned[0]
    assert min(heights) > 2.0 - 0.01  # never descending


def test_one_glimpse_of_an_occluded_leader_renews_the_retreat() -> None:
    """One image is too few to follow again, but shows that the leader now comes nearer."""
    follower, aside = lost(distance=1.5, closing=-0.3), math.radians(40.0)
    view = FieldOfView(aside, aside, aside, aside),
    for _ in range(80):
        frames = [follower.now - 0.1 * k for k in (2, 1, 0)]
        decision = follower.tick(frames=frames, view=view)
    used = follower.position
    assert decision.state is State.HOLD and np.linalg.norm(follower.velocity) < 0.02
    ahead = used + np.array([1.5, 0.0, 0.0])
    follower.tick(seen(follower.now, ahead, (-0.4, 0.0, 0.0)), frames=[follower.now], view=view)
    for _ in range(12):
        decision = follower.tick(view=view)
    assert decision.state is not State.TRACK
    assert follower.velocity[0] < -0.3


@pytest.mark.parametrize(('retreat_max', 'looked'), [(0.0, None), (1.0, 0.7)],
                         ids=['no retreat', 'no camera'])
def test_where_it_shall_not_retreat_it_stays(retreat_max: float, looked: float | None) -> None:
    follower = lost(params=PlannerParams(retreat_max=retreat_max))
    for _ in range(100):
        follower.tick(looked=looked)
    assert abs(follower.position[0]) < 0.35  # what the leader had pushed it back before


def test_without_retreat_it_still_avoids_another_one_in_sight() -> None:
    follower = lost(params=PlannerParams(retreat_max=0.0, vehicles={'other': Member('avoid')}))
    for _ in range(60):
        follower.tick()
    behind = follower.position - 0.45 * AHEAD
    decision = follower.tick(seen(follower.now, behind, (0.3, 0.0, 0.0), 'other'))
    assert decision.state is not State.TRACK and 'separation' in decision.limits
    assert commanded(decision)[0] > 1.0


def test_the_faster_it_may_be_the_more_places_it_may_be_in() -> None:
    n = seen(velocity=(0.3, 0.0, 0.0))
    ages = np.linspace(0.0, 5.0, 51)
    spreads = np.array([predict(n, np.zeros(3), age, PARAMS).spread for age in ages])
    rates = np.array([predict(n, np.zeros(3), age, PARAMS).spreading for age in ages])
    assert np.all(spreads[ages <= FRESH] == 0.0)  # the margin of the guard covers that
    assert np.gradient(spreads, ages)[10:-1] == pytest.approx(rates[10:-1], abs=0.06)
    assert rates[-1] == pytest.approx(PARAMS.leader_speed_max + 0.3)
    # Worst that a leader can do: accelerate as hard as it can, up to the speed it can have.
    blind = ages - FRESH
    reached = np.minimum(np.maximum(blind, 0.0), 2.3)
    assert spreads == pytest.approx(reached * (np.maximum(blind, 0.0) - 0.5 * reached))


@pytest.mark.parametrize(('reported', 'least', 'most'), [(0.05, 0.0, 0.001), (0.2, 0.09, 0.11),
                                                         (1.0, 0.98, 1.0), (5.0, 1.99, 2.0)])
def test_an_acceleration_counts_as_far_as_it_is_more_than_noise(reported: float, least: float,
                                                                most: float) -> None:
    estimated = predict(seen(), np.array([0.0, -reported, 0.0]), 0.1, PARAMS).acceleration
    assert least <= -estimated[1] <= most
    assert estimated[0] == estimated[2] == 0.0


def test_coasting_turns_after_it_then_looks_back_then_around() -> None:
    follower = Follower()
    for tick in range(10):
        follower.tick(seen(follower.now, [2.0, 0.06 * tick, 2.0], (0.0, 0.6, 0.0)))
    before = follower.yaw
    coasting = follower.now
    while (state := follower.tick().state) is not State.HOLD:
        assert follower.now < coasting + 60.0, f'not HOLD, but {state}'
    assert follower.yaw > before + 0.1  # it went on to the left
    towards = follower.yaw
    turned = []
    for _ in range(200):
        turned.append(wrap_angle(follower.tick().yaw - towards))  # type: ignore[operator]
    assert max(turned[:40]) > 0.6
    assert min(turned[:100]) < -0.6
    assert max(np.abs(turned)) > 3.0  # all round
    assert max(np.abs(np.diff(np.unwrap(turned)))) <= PARAMS.yaw_rate_max * PARAMS.period + 1e-9


def test_it_awaits_one_that_brakes_and_sinks_where_that_leads() -> None:
    follower = Follower()
    for tick in range(10):  # passing to the left, ever slower
        t = 0.1 * tick - 0.9
        follower.tick(seen(follower.now, [2.0, 0.6 * t - 0.4 * t * t, 2.0 - 0.2 * t],
                           (0.0, 0.6 - 0.8 * t, -0.2), acceleration=np.array([0.0, -0.8, 0.0])))
    for _ in range(20):
        follower.tick()
    # After 2 s it is 1.2 - 1.2 m aside, the follower 0.6 m; without the acceleration 1.2 m.
    assert -0.4 < follower.yaw < -0.1
    assert follower.position[2] < 1.75


@pytest.mark.parametrize(('distance', 'moved'), [(1.9, 1.0), (3.3, 0.53), (5.0, 0.0)])
def test_the_retreat_is_shorter_by_the_distance_beyond_the_band(distance: float,
                                                                moved: float) -> None:
    loss = Loss(np.array([1.0, 0.0, 0.0]), np.array([4.0, 0.0, 0.0]), 4.0 + distance, 0.0, 0.0,
                np.zeros(3), 'leader')
    assert retreat(loss, PARAMS) == pytest.approx(moved, abs=0.01)


@pytest.mark.parametrize(('speed', 'coming', 'most'), [(1.8, 0.0, 2.0), (-1.8, 1.8, 4.2)])
def test_unknown_place_after_odometry_jump_soon_stops_it(speed: float, coming: float,
                                                         most: float) -> None:
    params = PlannerParams(v_max=2.0)
    follower = Follower(params, params.response_time)
    follower.velocity = np.array([speed, 0.0, 0.0])
    for _ in range(10):
        follower.tick(seen(follower.now, follower.position + AHEAD, follower.velocity))
    follower.jumped, begin = np.array([0.0, 5.0, 0.0]), follower.position
    for _ in range(60):
        assert follower.tick().state in (State.COAST, State.HOLD)
    assert most - 1.0 < math.dist(begin, follower.position) < most
    assert math.hypot(*follower.velocity) < 0.1
    lost_then = follower.memory.lost
    assert lost_then is not None and lost_then.approach == pytest.approx(coming, abs=0.01)


def test_without_images_it_retreats_from_no_unknown_place() -> None:
    params = PlannerParams(v_max=2.0)
    follower = Follower(params, params.response_time)
    for _ in range(10):
        ahead = follower.position + AHEAD
        follower.tick(seen(follower.now, ahead, (-0.5, 0.0, 0.0)), looked=follower.now)
    follower.jumped, begin = np.array([0.0, 5.0, 0.0]), follower.position
    follower.tick(looked=follower.now)
    blind_from = follower.now
    for _ in range(60):
        assert follower.tick(looked=blind_from).state in (State.COAST, State.HOLD)
    assert math.dist(begin, follower.position) < 0.5


def test_after_odometry_jump_it_looks_to_both_sides() -> None:
    follower = Follower()
    for _ in range(5):
        follower.tick(seen(follower.now))
    follower.jumped, yaws = np.array([0.0, 5.0, 0.0]), []
    for _ in range(60):
        follower.tick()
        yaws.append(follower.yaw)
    assert yaws[3] == pytest.approx(0.0, abs=1e-6)
    assert max(yaws[:30]) > 0.75 and min(yaws[30:]) < -0.75


@pytest.mark.parametrize('seen_before', [True, False], ids=['HOLD', 'SEARCH'])
@pytest.mark.parametrize('fault', ['no neighbor', 'no odometry', 'no image'])
def test_after_resume_timeout_it_stops_commanding(seen_before: bool, fault: str) -> None:
    """Whatever keeps it from following: a planner that hovers for ever ends no flight."""
    memory, now, end = Memory(), 0.0, PARAMS.resume_timeout
    if seen_before:
        memory = lost().memory
        now = memory.now or 0.0
        end += now
    last = memory.now
    for tick in range(1, 400):
        now = (last or 0.0) + 0.1 * tick
        me = None if fault == 'no odometry' else own(now)
        memory, decision = step(memory, now, True, me, [], PARAMS,
                                looked=last or 0.0 if fault == 'no image' else None)
        if now > end + 0.15:
            assert decision.state is (State.HOLD if seen_before else State.SEARCH)
            assert decision.acceleration is None and decision.yaw is None
            assert decision.reason.startswith(
                'no neighbor followed for more than 30 s: sends no more commands, '
                'call planner/engage')
        elif now < end - 0.15 and fault != 'no odometry':
            assert decision.acceleration is not None
    assert memory.pending == pytest.approx(np.zeros(3))
    assert step(memory, now, True, own(now), [seen(now)], PARAMS)[1].acceleration is None


def test_one_that_returns_too_near_is_not_faded_in() -> None:
    follower = lost()
    for _ in range(100):
        follower.tick()
    decision = follower.tick(seen(
        follower.now, follower.position + 0.4 * AHEAD, (-0.3, 0.0, 0.0)))
    assert commanded(decision)[0] < -1.0
    assert math.hypot(*commanded(decision)) <= PARAMS.a_max


@pytest.mark.parametrize(('velocity', 'acceleration', 'changes', 'retreat'), [
    ((-0.2, 0.0, 0.0), (0.0, 0.0, 0.0), {}, (-0.4, 0.0, 0.0)),  # and the drift
    ((0.3, 0.0, 0.0), (0.0, 0.0, 0.0), {}, None),  # it goes away
    ((0.3, 0.0, 0.0), (-0.7, 0.0, 0.0), {}, (-0.5, 0.0, 0.0)),  # it turns back
    ((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0), {}, (-0.5, 0.0, 0.0)),  # at most v_max
    ((-0.3, 0.0, 0.0), (0.0, 0.0, 0.0), {'retreat_max': 0.0}, None),
    ((-0.3, 0.0, 0.0), (0.0, 0.0, 0.0), {'retreat_max': 0.15}, (-0.25, 0.0, 0.0)),
    ((-0.3, 0.0, 0.0), (0.0, 0.0, 0.0), {'guard': False}, None)])
def test_it_names_velocity_keeping_distance_if_odometry_is_lost(
        velocity: tuple[float, ...], acceleration: tuple[float, ...], changes: dict[str, Any],
        retreat: tuple[float, ...] | None) -> None:
    decision = Follower(replace(PARAMS, **changes)).tick(
        seen(0.0, (2.4, 0.0, 2.0), velocity, acceleration=np.array(acceleration)))
    if retreat is None:
        assert decision.retreat is None
    else:
        assert decision.retreat == pytest.approx(retreat, abs=0.01)


def fallback(distance: float, closing: float, turning: float, own_speed: float,
             params: PlannerParams) -> FallbackRetreat | None:
    """Return the retreat from a leader ahead; speeds towards it, and its acceleration, are +."""
    n = seen(0.0, (distance, 0.0, 2.0), (-closing, 0.0, 0.0),
             acceleration=np.array([-turning, 0.0, 0.0]))
    return fallback_from([n], own_speed, params)


def fallback_from(neighbors: Sequence[Neighbor], own_speed: float,
                  params: PlannerParams) -> FallbackRetreat | None:
    me = own(0.0, velocity=(own_speed, 0.0, 0.0))
    memory, scene = survey(Memory(now=0.0, own=me, neighbors={n.name: n for n in neighbors}), me,
                           State.TRACK, False, params, params.period)
    return fallback_retreat(memory, scene, params)


def test_the_retreat_is_from_the_nearest_one_that_comes() -> None:
    goes = seen(0.0, (-1.6, 0.0, 2.0), (-0.3, 0.0, 0.0), 'nearest')
    ahead = seen(0.0, (2.4, 0.0, 2.0), (-0.3, 0.0, 0.0), 'farthest')
    left = seen(0.0, (0.0, 2.0, 2.0), (0.0, -0.2, 0.0), 'nearer')
    found = fallback_from([ahead, left, goes], 0.0, PARAMS)
    assert found is not None and found.velocity == pytest.approx([0.0, -0.4, 0.0], abs=0.01)


@pytest.mark.parametrize(('distance', 'closing', 'turning', 'v_max'), [
    (2.12, 0.0, 0.0, 0.5), (2.12, 0.0, 0.15, 2.0), (2.3, -0.5, 0.0, 1.0), (1.6, -1.0, 0.15, 2.0),
    (2.3, -1.9, 0.5, 2.0)], ids=['hovers', 'noise', 'goes on', 'near', 'slows down'])
def test_nobody_who_could_come_near_causes_no_retreat(distance: float, closing: float,
                                                      turning: float, v_max: float) -> None:
    params = replace(PARAMS, v_max=v_max)
    assert fallback(distance, closing, turning, max(-closing, 0.0), params) is None


@given(st.floats(1.4, 2.8), st.floats(0.11, 1.0), st.floats(0.5, 2.0))
def test_drift_does_not_let_a_constant_approach_near(distance: float, closing: float,
                                                     v_max: float) -> None:
    found = fallback(distance, closing, 0.0, 0.0, replace(PARAMS, v_max=v_max))
    assert found is not None
    longest = min(PARAMS.retreat_max, RETREAT_TIME * v_max) + min(2.0 * closing, 3.0)
    assert math.hypot(*found.velocity) >= min(
        closing + DRIFT_SPEED, v_max, longest / ODOMETRY_GAP) - 1e-6


@given(st.floats(1.4, 2.8), st.floats(-1.0, 1.0), st.floats(0.21, 2.0), st.floats(0.0, 1.0),
       st.floats(0.1, 3.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(-1.0, 1.0))
def test_retreat_from_one_that_turns_leaves_the_margin(
        distance: float, share: float, turning: float, own_share: float, v_max: float,
        speeding: float, fastest: float, wrong: float) -> None:
    """At the end of the gap, for every leader within its limits, or the retreat is the longest."""
    params = replace(PARAMS, v_max=v_max)
    own_speed, closing = own_share * v_max, share * v_max
    found = fallback(distance, closing, turning, own_speed, params)
    speed = 0.0 if found is None else math.hypot(*found.velocity)
    assert speed <= v_max * (1.0 + 1e-9)
    coming = 0.0 if found is None else found.approach
    longest = min(params.retreat_max, RETREAT_TIME * v_max) + min(2.0 * coming, 3.0)
    assert speed * ODOMETRY_GAP <= longest * (1.0 + 1e-9)
    permitted = min(v_max, longest / ODOMETRY_GAP)
    # The leader accelerates by a part of the assumed limit, up to a part of v_max.
    rate, end = speeding * params.leader_acceleration_max, max(closing, fastest * v_max)
    gained = min((end - closing) / rate if rate > 0.0 else ODOMETRY_GAP, ODOMETRY_GAP)
    came = closing * ODOMETRY_GAP + rate * gained * (ODOMETRY_GAP - 0.5 * gained)
    flown = (speed + (DRIFT_SPEED * wrong if speed else 0.0)) * (ODOMETRY_GAP - STOPPING_TIME)
    left = distance - came - own_speed * STOPPING_TIME + flown
    assert left >= params.edges.near + params.edges.margin - 1e-9 or (
        speed >= permitted * (1.0 - 1e-9))
