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

"""The limits hold for every input there is, and change nothing that is within them."""

from __future__ import annotations

import math
from typing import Any

from exhaustive_projection import Ball, Bound, farthest, Lens, lexicographic
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.limits import (
    brake,
    limit_command,
    limit_horizontal,
    limit_norm,
    SENT_INSIDE,
)

A_MAX = 2.5
V_MAX = 0.5
T = 0.1

Vector = tuple[float, float, float]
ANYTHING = st.tuples(*[st.floats()] * 3)  # NaN, infinities, 1e308 and denormals among them
FINITE = st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3)
FLYABLE = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
LIMIT = st.floats(0.01, 100.0)
PERIOD = st.floats(0.01, 1.0)


@given(ANYTHING, ANYTHING, LIMIT, LIMIT, PERIOD)
def test_any_input_gives_a_finite_acceleration_within_a_max(
        a: Vector, v: Vector, a_max: float, v_max: float, period: float) -> None:
    command = limit_command(a, v, a_max, v_max, period)
    assert np.all(np.isfinite(command.acceleration))
    assert np.linalg.norm(command.acceleration) <= a_max
    assert command.limited == bool(command.reason)


@given(ANYTHING, FLYABLE, LIMIT, st.floats(0.0, 6.0), PERIOD)
def test_speed_ends_within_v_max_or_does_not_rise(a: Vector, v: Vector, a_max: float,
                                                  v_max: float, period: float) -> None:
    command = limit_command(a, v, a_max, v_max, period)
    speed = float(np.linalg.norm(v))
    reached = float(np.linalg.norm(v + command.acceleration * period))
    assert reached <= (v_max if speed <= v_max else speed)


@given(FINITE, FINITE)
def test_absurd_velocities_are_braked_not_multiplied_into_nan(a: Vector, v: Vector) -> None:
    command = limit_command(a, v, A_MAX, V_MAX, T)
    if math.hypot(*v) > V_MAX + A_MAX * T:
        assert np.linalg.norm(command.acceleration) == pytest.approx(A_MAX)
        assert np.asarray(v) / math.hypot(*(x / 4 for x in v)) @ command.acceleration <= 0.0


@given(FLYABLE, FLYABLE)
def test_a_limited_command_passes_a_second_time_unchanged(a: Vector, v: Vector) -> None:
    once = limit_command(a, np.clip(v, -0.28, 0.28), A_MAX, V_MAX, T).acceleration
    again = limit_command(once, np.clip(v, -0.28, 0.28), A_MAX, V_MAX, T)
    assert np.array_equal(again.acceleration, once)
    assert not again.limited


@given(st.tuples(*[st.floats(-1.4, 1.4)] * 3), st.tuples(*[st.floats(-0.1, 0.1)] * 3))
def test_a_command_within_the_limits_is_returned_bit_for_bit(a: Vector, v: Vector) -> None:
    command = limit_command(a, v, A_MAX, V_MAX, T)
    assert command.acceleration.tobytes() == np.array(a).tobytes()
    assert (command.limited, command.reason) == (False, '')


@given(ANYTHING | FLYABLE, FLYABLE, st.floats(0.01, 20.0), st.floats(0.0, 3e-7),
       st.sampled_from([0.1, 0.3]))
def test_what_is_sent_in_single_precision_is_within_a_max_too(
        a: Vector, v: Vector, a_max: float, short: float, period: float) -> None:
    near = limit_norm(a, a_max * (1.0 - short))
    for sent in (limit_command(a, v, a_max, V_MAX, period).acceleration,
                 limit_command(near, [0.0] * 3, a_max, 50.0, period).acceleration,
                 limit_horizontal(near, min(abs(v[2]), a_max), v, a_max, 50.0,
                                  period).acceleration,
                 brake(v, a_max)):
        assert np.linalg.norm(sent.astype(np.float32).astype(float)) <= a_max


@given(st.tuples(*[st.floats(-1e6, 1e6)] * 3))
def test_a_limited_vector_keeps_its_direction(vector: Vector) -> None:
    limited = limit_norm(vector, A_MAX)
    assert np.cross(limited, vector) == pytest.approx(np.zeros(3), abs=1e-9 * (1 + max(map(
        abs, vector))))
    assert limited @ np.array(vector) >= 0.0


@pytest.mark.parametrize(('a', 'v', 'expected', 'reason'), [
    ([2.5 * SENT_INSIDE, 0, 0], [0, 0, 0], [2.5, 0, 0], ''),
    ([2.5, 0, 0], [0, 0, 0], [2.5, 0, 0], 'a_max'),
    ([0, 25.0, 0], [0, 0, 0], [0, 2.5, 0], 'a_max'),
    ([1e308, 1e308, 0], [0, 0, 0], [2.5 / math.sqrt(2), 2.5 / math.sqrt(2), 0], 'a_max'),
    ([1.0, 0, 0], [0.5, 0, 0], [0, 0, 0], 'v_max'),
    ([1.0, 0, 0], [0.45, 0, 0], [0.5, 0, 0], 'v_max'),
    ([9.0, 0, 0], [0.45, 0, 0], [0.5, 0, 0], 'a_max, v_max'),
    ([-1.0, 0, 0], [0.5, 0, 0], [-1.0, 0, 0], ''),
    ([0, 0, 0], [0, 0, 0.6], [0, 0, -1.0], 'v_max'),
    ([0, 0, 0], [0, -3.0, 0], [0, 2.5, 0], 'v_max'),
    ([math.nan, 0, 0], [0.1, 0, 0], [-1.0, 0, 0], 'acceleration not finite'),
    ([math.inf, 0, 0], [0, 0, 4.0], [0, 0, -2.5], 'acceleration not finite'),
    ([1.0, 0, 0], [0, math.nan, 0], [0, 0, 0], 'velocity not finite'),
    ([math.nan] * 3, [math.inf] * 3, [0, 0, 0], 'velocity not finite'),
])
def test_limits_act_as_specified(a: list[float], v: list[float], expected: list[float],
                                 reason: str) -> None:
    command = limit_command(a, v, A_MAX, V_MAX, T)
    assert command.acceleration == pytest.approx(np.array(expected), abs=1e-6)
    assert (command.limited, command.reason) == (bool(reason), reason)


def test_at_top_speed_a_turn_costs_speed_not_the_turn() -> None:
    command = limit_command([0.0, 2.0, 0.0], [0.5, 0.0, 0.0], A_MAX, V_MAX, T)
    reached = np.array([0.5, 0.0, 0.0]) + command.acceleration * T
    assert np.linalg.norm(reached) == pytest.approx(V_MAX)
    assert reached[1] / reached[0] == pytest.approx(0.2 / 0.5)


@given(ANYTHING, LIMIT, st.floats(0.05, 5.0))
def test_braking_is_finite_within_a_max_and_against_the_motion(v: Vector, a_max: float,
                                                               tau: float) -> None:
    a = brake(v, a_max, tau)
    assert np.all(np.isfinite(a))
    assert np.linalg.norm(a) <= a_max
    if not np.all(np.isfinite(v)):
        assert np.array_equal(a, np.zeros(3))
    elif 1e-100 < math.hypot(*v) < 1e100:
        assert a @ np.array(v) < 0.0


def test_braking_falls_with_the_time_constant_and_ends_at_rest() -> None:
    assert brake([0.3, 0.0, -0.06], A_MAX) == pytest.approx(np.array([-1.0, 0.0, 0.2]))
    assert brake([0.0, 9.0, 0.0], A_MAX, 0.5) == pytest.approx(np.array([0.0, -2.5, 0.0]))
    v: Array = np.array([3.0, -1.0, 0.5])
    for _ in range(40):
        v = v + brake(v, A_MAX) * T
    assert np.linalg.norm(v) < 1e-3


@pytest.mark.parametrize(('change', 'message'), [
    ({'a_max': 0.0}, r'^a_max = 0\.0: must be a number in \(0, 100\] m/s\^2$'),
    ({'a_max': math.nan}, r'^a_max = nan'),
    ({'v_max': -0.1}, r'^v_max = -0\.1: must be a number in \[0, 100\] m/s$'),
    ({'v_max': math.inf}, r'^v_max = inf'),
    ({'period': 0.0}, r'^period = 0\.0: must be a number in \(0, 10\] s$'),
    ({'acceleration': [0.0, 0.0]}, r'^acceleration has shape \(2,\): must be \(3,\)$'),
    ({'velocity': [[0.0] * 3]}, r'^velocity has shape \(1, 3\): must be \(3,\)$'),
])
def test_bad_limits_are_named_with_value_and_range(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {
        'acceleration': np.zeros(3), 'velocity': np.zeros(3), 'a_max': A_MAX, 'v_max': V_MAX,
        'period': T}
    with pytest.raises(ValueError, match=message):
        limit_command(**{**arguments, **change})


def test_bad_braking_parameters_are_named() -> None:
    valid = r'must be a number in \(0, 10\] s$'
    with pytest.raises(ValueError, match=rf'^time_constant = 0\.0: {valid}'):
        brake(np.zeros(3), A_MAX, 0.0)
    with pytest.raises(ValueError, match=r'^a_max = -1\.0'):
        brake(np.zeros(3), -1.0)


@given(ANYTHING, st.floats(-2.0, 2.0), ANYTHING)
@pytest.mark.filterwarnings('ignore:overflow')
def test_what_the_altitude_leaves_is_within_both_limits_too(a: Vector, vertical: float,
                                                            v: Vector) -> None:
    command = limit_horizontal(a, vertical, v, A_MAX, V_MAX, T)
    assert np.all(np.isfinite(command.acceleration))
    assert np.linalg.norm(command.acceleration) <= A_MAX
    speed = math.hypot(*v)
    if speed < 100.0:
        reached = np.linalg.norm(np.array(v) + command.acceleration * T)
        assert reached <= max(V_MAX, speed * (1.0 + 1e-15))


def test_the_altitude_goes_before_the_horizontal_pull() -> None:
    v = np.array([V_MAX, 0.0, 0.0])
    command = limit_horizontal([2.0, 0.0, 9.0], 1.0, v, A_MAX, V_MAX, T)
    assert command.acceleration[2] == pytest.approx(1.0)
    assert np.linalg.norm(v + T * command.acceleration) <= V_MAX
    assert command.reason == 'v_max'


def test_room_is_left_for_the_climb_that_is_coming() -> None:
    wanted, v = [2.0, 0.0, 0.0], [0.3, 0.0, 0.0]
    for climb, fastest in ((0.0, 0.5), (0.3, 0.4), (-0.4, 0.3), (0.6, 0.0)):
        command = limit_horizontal(wanted, 0.0, v, A_MAX, V_MAX, T, climb)
        assert v[0] + T * command.acceleration[0] == pytest.approx(
            max(fastest, 0.3 - A_MAX * T), abs=1e-6)
        assert command.limited == (climb != 0.0)


@given(st.integers(0, 2 ** 32))
def test_what_keeps_clear_of_a_neighbor_is_cut_last(seed: int) -> None:
    """Held to the search over all active sets, in three dimensions."""
    rng = np.random.default_rng(seed)
    v, wanted = rng.uniform(-0.4, 0.4, 3), rng.uniform(-4.0, 4.0, 3)
    away = rng.normal(size=3)
    away = away / np.linalg.norm(away)
    if seed % 4 == 0:
        v = rng.uniform(-0.6, 0.6) * away  # the centres and the direction on one line
    command = limit_command(wanted, v, A_MAX, V_MAX, T, away)
    assert np.linalg.norm(command.acceleration) <= A_MAX
    speed = float(np.linalg.norm(v))
    assert np.linalg.norm(v + T * command.acceleration) <= max(V_MAX, speed)
    if command.limited and away @ wanted > 0.0:
        lens = Lens(Ball(np.zeros(3), A_MAX), Ball(-v / T, max(V_MAX, speed) / T))
        level = min(away @ wanted, away @ farthest(away, [], lens))
        best = lexicographic(wanted, [Bound(away, level), Bound(-away, -level)], lens)
        clipped = limit_command(wanted, v, A_MAX, V_MAX, T).acceleration
        assert away @ command.acceleration >= max(away @ clipped, level - 1e-5)
        if level > away @ clipped + 1e-3:
            assert command.acceleration == pytest.approx(best, abs=3e-3)
