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

"""The altitude follows the neighbor's within its bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
import math
from typing import Any

from flown import Follower, seen
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.gate.disturbance import HeightWatch
from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.vertical_yaw import (
    Altitude,
    ALTITUDE_MARGIN,
    CLIMB_ACCELERATION,
)

PARAMS = PlannerParams()
PERIOD = PARAMS.period


def me(z: float, climb: float = 0.0) -> OwnState:
    return OwnState(0.0, np.array([0.0, 0.0, z]), np.array([0.0, 0.0, climb]), 0.0)


def leader(z: float, climb: float = 0.0, rising: float | None = None) -> Neighbor:
    return Neighbor(
        'leader', 0.0, np.array([2.0, 0.0, z]), np.array([0.0, 0.0, climb]),
        acceleration=None if rising is None else np.array([0.0, 0.0, rising]))


def followed(altitude: Altitude, it: Neighbor | None, seconds: float,
             params: PlannerParams = PARAMS) -> Altitude:
    for _ in range(round(seconds / PERIOD)):
        altitude = altitude.follow(it, params, PERIOD)
    return altitude


def flown(seconds: float, leads: Callable[[float], tuple[float, float]] = lambda t: (2.0, 0.0),
          params: PlannerParams = PARAMS, first: float = 2.0, late: int = 0
          ) -> Iterator[tuple[Altitude, float, float]]:
    """
    Yield the altitude held, the own height and climb at every tick.

    :param leads: height and climb of the leader at a time; :param first: own height at first.
    :param late: periods after which a command is flown.
    """
    altitude, height, speed = Altitude.begin(me(first), 0.0, params), first, 0.0
    waiting = [0.0] * late
    for tick in range(round(seconds / PERIOD)):
        altitude = altitude.follow(leader(*leads(tick * PERIOD)), params, PERIOD)
        altitude, vertical = altitude.control(me(height, speed), params)
        waiting.append(vertical)
        acting = waiting.pop(0)
        for _ in range(10):
            speed += 0.1 * PERIOD * acting
            height += 0.1 * PERIOD * speed
        yield altitude, height, speed


def heights(*args: Any, **options: Any) -> list[float]:
    return [height for _, height, _ in flown(*args, **options)]


def test_climb_below_noise_counts_as_none_a_real_one_counts() -> None:
    params = replace(PARAMS, v_max=2.0)
    for climb, least, most in ((0.03, 0.0, 0.001), (-0.03, -0.001, 0.0), (0.2, 0.18, 0.201),
                               (-0.2, -0.201, -0.18), (0.7, 0.699, 0.701)):
        altitude = Altitude.begin(me(20.0), 0.0, params)
        for _ in range(30):
            # At a height that is no news.
            altitude = altitude.follow(leader(altitude.held, climb), params, PERIOD)
        altitude = altitude.follow(
            leader(altitude.held + altitude.climb * PERIOD, climb), params, PERIOD)
        assert least <= altitude.climb <= most


def test_an_absurd_acceleration_of_the_leader_does_no_harm() -> None:
    altitude = Altitude.begin(me(2.0), 0.0, PARAMS)
    for _ in range(5):
        altitude = altitude.follow(leader(2.0, 0.0, 1e300), PARAMS, PERIOD)
    assert abs(altitude.climb) <= PARAMS.climb_rate
    assert abs(altitude.held - 2.0) <= 5 * PERIOD * PARAMS.climb_rate


def test_climb_after_loss_begins_gently_without_overshoot() -> None:
    """The vehicle flies each command 0.2 s late, as flights do."""
    before = 0.0
    for altitude, height, speed in flown(6.0, lambda t: (3.0, 0.0), late=2):
        assert abs(altitude.climb - before) <= CLIMB_ACCELERATION * PERIOD + 1e-9
        assert speed < PARAMS.v_max and height < 3.2
        before = altitude.climb
    assert height == pytest.approx(3.0, abs=0.1)


def test_without_a_leader_it_is_held() -> None:
    altitude = Altitude.begin(me(2.0), 0.0, PARAMS)
    assert followed(altitude, None, 5.0) == altitude


def test_the_least_altitude_counts_from_where_it_was_armed() -> None:
    low, high = (followed(Altitude.begin(me(3.0), 0.4, replace(PARAMS, altitude_max=6.0)),
                          leader(z), 30.0) for z in (-5.0, 50.0))
    assert (low.held, high.held) == pytest.approx((1.4 + ALTITUDE_MARGIN, 6.4 - ALTITUDE_MARGIN))
    assert (low.climb, high.climb) == pytest.approx((0.0, 0.0))


def test_behind_climbing_leader_it_stops_at_altitude_max() -> None:
    params = replace(PARAMS, altitude_max=3.0)
    altitude = Altitude.begin(me(2.5), 0.0, params)
    for tick in range(60):
        altitude = altitude.follow(leader(2.5 + 0.02 * tick, 0.2), params, PERIOD)
        assert altitude.held <= 3.0
    assert (altitude.held, altitude.climb) == (
        pytest.approx(3.0 - ALTITUDE_MARGIN), pytest.approx(0.0, abs=1e-3))


def test_start_below_altitude_min_neither_jumps_nor_descends() -> None:
    altitude = Altitude.begin(me(0.6), 0.0, PARAMS)
    assert followed(altitude, leader(0.2), 10.0).held == 0.6
    assert followed(altitude, leader(1.8), 10.0).held == pytest.approx(1.8)


def test_unknown_ground_limits_it_to_its_starting_height() -> None:
    altitude = Altitude.begin(me(3.0), None, PARAMS)
    assert followed(altitude, leader(1.0), 10.0).held == 3.0
    below = Altitude.begin(me(3.0), None, replace(PARAMS, altitude_min=-9.0, altitude_max=-2.0))
    assert (below.lowest, below.highest) == (3.0, 3.0)


@pytest.mark.parametrize(('ground', 'begun', 'changes', 'lowest', 'highest'), [
    (0.5, 4.0, {'altitude_max': 3.0}, 1.6, 3.4), (0.5, 4.0, {'altitude_min': 5.0}, 5.6, 100.4),
    (0.5, 1.0, {'altitude_max': 3.0}, 1.0, 3.4),  # it began below altitude_min
    # A looser bound does not move it.
    (0.5, 1.0, {'altitude_min': 0.8}, 1.0, 100.4),
    (0.5, 200.0, {'altitude_max': 150.0}, 1.6, 200.0),
    (0.5, 4.0, {'altitude_min': 2.0, 'altitude_max': 2.0}, 2.5, 2.5),  # the margins overlap
    (None, 4.0, {'altitude_max': 3.0}, 4.0, 7.0), (None, 4.0, {'altitude_min': 2.0}, 4.0, 104.0)])
def test_bounds_that_change_in_flight_count_at_once(
        ground: float | None, begun: float, changes: dict[str, float], lowest: float,
        highest: float) -> None:
    altitude, params = Altitude.begin(me(begun), ground, PARAMS), replace(PARAMS, **changes)
    assert altitude.with_limits_of(PARAMS) is altitude
    bounded = altitude.with_limits_of(params)
    assert (bounded.lowest, bounded.highest) == pytest.approx((lowest, highest))
    assert bounded.with_limits_of(params) is bounded


@pytest.mark.parametrize(('mode', 'limits', 'height'), [
    ('follow', {'altitude_max': 2.5}, 2.4), ('hold', {'altitude_max': 2.5}, 2.4),
    ('hold', {'altitude_max': 1.5}, 1.4), ('hold', {'altitude_min': 5.0}, 5.1)])
def test_bounds_changed_in_flight_are_obeyed_without_handover(
        mode: str, limits: dict[str, float], height: float) -> None:
    follower, watch = Follower(replace(PARAMS, altitude_mode=mode)), HeightWatch()
    follower.position[2] = 3.0
    for tick in range(150):
        if tick == 20:
            follower.params = replace(follower.params, **limits)  # type: ignore[arg-type]
        decision = follower.tick(seen(follower.now, (2.12, 0.0, 3.0)))
        watch.step(float(follower.position[2]), decision.altitude)
        assert not watch.reason
    assert follower.position[2] == pytest.approx(height, abs=0.05)


def test_bounds_stay_where_they_are_however_often_odometry_jumps() -> None:
    follower, reached = Follower(replace(PARAMS, altitude_max=3.0)), []
    for tick in range(600):
        if tick % 100 == 50:
            up = 0.5 if tick % 200 == 50 else -0.8
            follower.jumped = follower.jumped + np.array([0.0, 0.0, up])
        above = 0.3 if tick < 400 else -0.3
        follower.tick(seen(follower.now, follower.position + follower.jumped + (2.1, 0.0, above)))
        reached.append(follower.position[2])
    assert max(reached) == pytest.approx(2.9, abs=0.05)
    assert reached[-1] == pytest.approx(1.1, abs=0.05)


def test_behind_a_leader_that_climbs_steadily_nothing_lags() -> None:
    flight = heights(20.0, lambda t: (2.0 + 0.2 * t, 0.2))
    assert flight[-1] == pytest.approx(2.0 + 0.2 * 20.0, abs=0.05)


@given(st.floats(-1e308, 1e308), st.floats(-50.0, 50.0), st.floats(-1e308, 1e308))
def test_no_finite_input_asks_for_more_than_allowed(z: float, climb: float, held: float) -> None:
    _, vertical = Altitude(held, 0.0, 10.0, 0.3).control(me(z, climb), PARAMS)
    assert abs(vertical) <= PARAMS.max_vertical_acceleration


@pytest.mark.parametrize(('least', 'most', 'raised', 'expected'), [
    (-math.inf, math.inf, -math.inf, 3.0), (-math.inf, math.inf, 4.0, 4.0),
    (-math.inf, -0.1, -math.inf, math.nan), (0.45, math.inf, -math.inf, math.nan),
    (-0.1, 1.6, -math.inf, 3.0)])
def test_commanded_altitude_is_unknown_while_climb_is_limited(
        least: float, most: float, raised: float, expected: float) -> None:
    altitude, _ = Altitude(3.0, 0.0, 10.0).control(
        me(2.5), PARAMS, least, most, raised=raised)
    assert altitude.commanded == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize('late', [0, 1, 2])
@pytest.mark.parametrize('lag', [0.1, 0.3])
def test_late_odometry_lets_the_height_settle(lag: float, late: int) -> None:
    follower = Follower(lag=lag, late=late)
    climbs = []
    for _ in range(150):
        follower.tick(seen(follower.now, (2.12, 0.0, 2.3)))
        climbs.append(abs(follower.velocity[2]))
    assert max(climbs[100:]) < 0.01
    assert follower.position[2] == pytest.approx(2.3, abs=0.01)
