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

"""The altitude follows the neighbour's within its bounds, and offsets errors of the thrust."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.vertical_yaw import (
    Altitude,
    ALTITUDE_MARGIN,
    CLIMB_ACCELERATION,
    THRUST_BIAS_MAX,
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
        altitude = altitude.following(it, params, PERIOD)
    return altitude


def flown(seconds: float, leads: Callable[[float], tuple[float, float]] = lambda t: (2.0, 0.0),
          error: float = 0.0, params: PlannerParams = PARAMS, first: float = 2.0,
          late: int = 0) -> Iterator[tuple[Altitude, float, float]]:
    """
    Yield the altitude held, the own height and climb at every tick.

    :param leads: height and climb of the leader at a time; :param first: own height at first.
    :param error: of the thrust, m/s^2; :param late: periods after which a command is flown.
    """
    altitude, height, speed = Altitude.begun(me(first), 0.0, params), first, 0.0
    waiting = [0.0] * late
    for tick in range(round(seconds / PERIOD)):
        altitude = altitude.following(leader(*leads(tick * PERIOD)), params, PERIOD)
        altitude, vertical = altitude.controlled(me(height, speed), params, PERIOD)
        waiting.append(vertical)
        acting = waiting.pop(0) + error
        for _ in range(10):
            speed += 0.1 * PERIOD * acting
            height += 0.1 * PERIOD * speed
        yield altitude, height, speed


@pytest.mark.parametrize('error', [-0.6, 0.6])
def test_a_wrong_thrust_is_offset_where_a_neighbor_leaves_no_speed_for_the_climb(
        error: float) -> None:
    """It sank by 0.4 m in 3 s, until the marker left the image."""
    altitude, height, speed, lowest = Altitude.begun(me(2.0), 0.0, PARAMS), 2.0, 0.0, 0.0
    for _ in range(60):
        altitude, vertical = altitude.controlled(me(height, speed), PARAMS, PERIOD, -0.0, 0.0)
        speed += PERIOD * (vertical + error)
        height += PERIOD * speed
        lowest = max(lowest, abs(height - 2.0))
    assert lowest < 0.25 and abs(speed) < 0.02
    assert altitude.thrust_bias == pytest.approx(-error, abs=0.05)


@pytest.mark.parametrize(('at_floor', 'error'), [(True, -0.8), (True, -1.0), (False, 0.8)])
def test_a_neighbor_that_presses_beyond_a_bound_of_the_altitude_does_not_unlearn_the_thrust(
        at_floor: bool, error: float) -> None:
    """The offset was discharged: it was 0.4 m below its floor after 2 s."""
    lowest, highest = (2.0, 10.0) if at_floor else (0.0, 2.0)
    altitude, height, speed = Altitude(2.0, lowest, highest, thrust_bias=-error), 2.0, 0.0
    least, most = (-math.inf, -0.4) if at_floor else (0.4, math.inf)
    for _ in range(60):
        altitude, vertical = altitude.controlled(me(height, speed), PARAMS, PERIOD, least, most)
        speed += PERIOD * (vertical + error)
        height += PERIOD * speed
        assert abs(height - 2.0) < 0.02


def heights(*args: Any, **options: Any) -> list[float]:
    return [height for _, height, _ in flown(*args, **options)]


def test_a_climb_as_small_as_its_noise_is_none_and_a_real_one_counts() -> None:
    params = replace(PARAMS, v_max=2.0)
    for climb, least, most in ((0.03, 0.0, 0.001), (-0.03, -0.001, 0.0), (0.2, 0.18, 0.201),
                               (-0.2, -0.201, -0.18), (0.7, 0.699, 0.701)):
        altitude = Altitude.begun(me(20.0), 0.0, params)
        for _ in range(30):
            # At a height that is no news.
            altitude = altitude.following(leader(altitude.held, climb), params, PERIOD)
        altitude = altitude.following(
            leader(altitude.held + altitude.climb * PERIOD, climb), params, PERIOD)
        assert least <= altitude.climb <= most


def test_an_absurd_acceleration_of_the_leader_does_no_harm() -> None:
    altitude = Altitude.begun(me(2.0), 0.0, PARAMS)
    for _ in range(5):
        altitude = altitude.following(leader(2.0, 0.0, 1e300), PARAMS, PERIOD)
    assert abs(altitude.climb) <= PARAMS.climb_rate
    assert abs(altitude.held - 2.0) <= 5 * PERIOD * PARAMS.climb_rate


def test_after_a_loss_the_climb_begins_gently_and_does_not_overshoot() -> None:
    """The vehicle flies each command 0.2 s late, as flights do."""
    before = 0.0
    for altitude, height, speed in flown(6.0, lambda t: (3.0, 0.0), late=2):
        assert abs(altitude.climb - before) <= CLIMB_ACCELERATION * PERIOD + 1e-9
        assert speed < PARAMS.v_max and height < 3.2
        before = altitude.climb
    assert height == pytest.approx(3.0, abs=0.1)


def test_without_a_leader_it_is_held() -> None:
    altitude = Altitude.begun(me(2.0), 0.0, PARAMS)
    assert followed(altitude, None, 5.0) == altitude


def test_the_least_altitude_counts_from_where_it_was_armed() -> None:
    low, high = (followed(Altitude.begun(me(3.0), 0.4, replace(PARAMS, altitude_max=6.0)),
                          leader(z), 30.0) for z in (-5.0, 50.0))
    assert (low.held, high.held) == pytest.approx((1.4 + ALTITUDE_MARGIN, 6.4 - ALTITUDE_MARGIN))
    assert (low.climb, high.climb) == pytest.approx((0.0, 0.0))


def test_behind_one_that_climbs_it_stops_at_the_greatest_altitude() -> None:
    params = replace(PARAMS, altitude_max=3.0)
    altitude = Altitude.begun(me(2.5), 0.0, params)
    for tick in range(60):
        altitude = altitude.following(leader(2.5 + 0.02 * tick, 0.2), params, PERIOD)
        assert altitude.held <= 3.0
    assert (altitude.held, altitude.climb) == (
        pytest.approx(3.0 - ALTITUDE_MARGIN), pytest.approx(0.0, abs=1e-3))


def test_begun_below_the_least_altitude_it_neither_jumps_nor_descends() -> None:
    altitude = Altitude.begun(me(0.6), 0.0, PARAMS)
    assert followed(altitude, leader(0.2), 10.0).held == 0.6
    assert followed(altitude, leader(1.8), 10.0).held == pytest.approx(1.8)


def test_without_a_known_ground_it_does_not_go_below_where_it_began() -> None:
    altitude = Altitude.begun(me(3.0), None, PARAMS)
    assert followed(altitude, leader(1.0), 10.0).held == 3.0


def test_behind_a_leader_that_climbs_steadily_nothing_lags() -> None:
    flight = heights(20.0, lambda t: (2.0 + 0.2 * t, 0.2))
    assert flight[-1] == pytest.approx(2.0 + 0.2 * 20.0, abs=0.05)


def test_what_the_thrust_errs_by_is_taken_up() -> None:
    flight = heights(30.0, error=-0.8)
    assert min(flight) > 2.0 - 0.8 / PARAMS.altitude_frequency ** 2
    assert flight[-1] == pytest.approx(2.0, abs=0.01)


def test_the_thrust_correction_is_bounded_and_does_not_wind_up() -> None:
    for height, thrust_bias in ((1.6, 1.2), (9.0, 0.0)):  # near, and so far off that limits act
        altitude = Altitude(2.0, 0.0, 10.0)
        for _ in range(100):
            altitude, _ = altitude.controlled(me(height), PARAMS, PERIOD)
        assert altitude.thrust_bias == thrust_bias


@given(st.floats(-1e308, 1e308), st.floats(-50.0, 50.0), st.floats(-1e308, 1e308),
       st.floats(-1.0, 1.0), st.floats(0.0, 0.2))
def test_no_finite_input_asks_for_more_than_allowed(z: float, climb: float, held: float,
                                                    thrust_bias: float, elapsed: float) -> None:
    altitude, vertical = Altitude(held, 0.0, 10.0, 0.3, thrust_bias).controlled(
        me(z, climb), PARAMS, elapsed)
    assert abs(vertical) <= PARAMS.max_vertical_acceleration + THRUST_BIAS_MAX
    assert abs(vertical) <= PARAMS.a_max
    assert abs(altitude.thrust_bias) <= THRUST_BIAS_MAX


@pytest.mark.parametrize('error', [-0.2, 0.2])
@pytest.mark.parametrize(('v_max', 'sign'), [(0.5, -1.0), (2.0, -1.0), (2.0, 1.0)])
def test_it_stops_in_time_before_the_least_and_the_greatest_altitude(
        v_max: float, sign: float, error: float) -> None:
    """Behind one that goes on beyond them, each command flown 0.2 s late, the thrust wrong."""
    params = replace(PARAMS, v_max=v_max, altitude_min=1.0, altitude_max=7.0)

    def leads(t: float) -> tuple[float, float]:
        gone = min(max(t - 10.0, 0.0), 10.0)
        return 4.0 + sign * v_max * gone, sign * v_max * (0.0 < gone < 10.0)

    for _, height, _ in flown(25.0, leads, error, params, first=4.0, late=2):
        assert 0.9 < height < 7.1
    assert height == pytest.approx(4.0 + sign * 3.0, abs=0.15)
