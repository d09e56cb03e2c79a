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

"""The limits hold for every input, and change nothing within them."""

from __future__ import annotations

import math

from flown import assert_within_limits
from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.bound_keeping import (
    Bound,
    COHESION,
    keep_bounds,
    limit_horizontal,
    SPEED_TIME,
)
from flock_follower.planner.limits import brake, limit_command, limit_norm, SENT_INSIDE

A_MAX = 2.5
V_MAX = 0.5
T = 0.1

Vector = tuple[float, float, float]
ANYTHING = st.tuples(*[st.floats()] * 3)  # NaN, infinities, 1e308 and denormals among them


FLYABLE = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
LIMIT = st.floats(0.01, 100.0)
PERIOD = st.floats(0.01, 1.0)


@given(ANYTHING, ANYTHING, LIMIT, LIMIT, PERIOD, st.sampled_from([None, (0.0, 0.6, -0.8)]))
@example((0.0, 1.0, 0.0), (1e308, 0.0, 0.0), 2.5, 0.5, 0.1, (0.0, 0.6, -0.8))
def test_any_input_gives_a_finite_acceleration_within_a_max(
        a: Vector, v: Vector, a_max: float, v_max: float, period: float,
        axis: Vector | None) -> None:
    command = limit_command(a, v, a_max, v_max, period, None if axis is None else np.array(axis))
    assert np.all(np.isfinite(command.acceleration))
    assert np.linalg.norm(command.acceleration) <= a_max


@pytest.mark.parametrize(('vector', 'limited'), [
    ([1.7e308, -1.7e308], [1.5, -1.5]),  # longer than the largest number
    ([1e200, 0.0], [1.5 * math.sqrt(2.0), 0.0]), ([1.0, 1.5], [1.0, 1.5]),
    *(([wrong, other], [0.0, 0.0]) for wrong in (math.inf, math.nan) for other in (0, math.nan))])
@pytest.mark.filterwarnings('error')
def test_what_is_not_finite_counts_as_nothing_a_long_one_not(
        vector: list[float], limited: list[float]) -> None:
    assert limit_norm(vector, 1.5 * math.sqrt(2.0)) == pytest.approx(np.array(limited), rel=1e-9)


@given(ANYTHING, FLYABLE, LIMIT, st.floats(0.0, 6.0), PERIOD)
def test_speed_ends_within_v_max_or_does_not_rise(a: Vector, v: Vector, a_max: float,
                                                  v_max: float, period: float) -> None:
    command = limit_command(a, v, a_max, v_max, period)
    speed = float(np.linalg.norm(v))
    reached = float(np.linalg.norm(v + command.acceleration * period))
    assert reached <= (v_max if speed <= v_max else speed)


@given(FLYABLE, FLYABLE)
def test_a_limited_command_passes_a_second_time_unchanged(a: Vector, v: Vector) -> None:
    once = limit_command(a, np.clip(v, -0.28, 0.28), A_MAX, V_MAX, T).acceleration
    again = limit_command(once, np.clip(v, -0.28, 0.28), A_MAX, V_MAX, T)
    assert np.array_equal(again.acceleration, once)
    assert not again.reason


@given(st.tuples(*[st.floats(-1.4, 1.4)] * 3), st.tuples(*[st.floats(-0.1, 0.1)] * 3))
def test_a_command_within_the_limits_is_returned_bit_for_bit(a: Vector, v: Vector) -> None:
    command = limit_command(a, v, A_MAX, V_MAX, T)
    assert command.acceleration.tobytes() == np.array(a).tobytes()
    assert command.reason == ''


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
    # It slows down, but not enough.
    ([-0.5, 0, 0], [0.6, 0, 0], [-1.0, 0, 0], 'v_max'),
    ([-0.05, 0, 0], [0.6, 0, 0], [-1.0, 0, 0], 'v_max'),
    ([math.nan, 0, 0], [0.1, 0, 0], [-1.0, 0, 0], 'acceleration not finite'),
    ([math.inf, 0, 0], [0, 0, 4.0], [0, 0, -2.5], 'acceleration not finite'),
    ([1.0, 0, 0], [0, math.nan, 0], [0, 0, 0], 'velocity not finite'),
    ([math.nan] * 3, [math.inf] * 3, [0, 0, 0], 'velocity not finite'),
])
def test_limits_act_as_specified(a: list[float], v: list[float], expected: list[float],
                                 reason: str) -> None:
    command = limit_command(a, v, A_MAX, V_MAX, T)
    assert command.acceleration == pytest.approx(np.array(expected), abs=1e-6)
    assert command.reason == reason


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


@given(ANYTHING, st.floats(-2.0, 2.0), ANYTHING)
@pytest.mark.filterwarnings('ignore:overflow')
def test_what_the_altitude_leaves_is_within_both_limits_too(a: Vector, vertical: float,
                                                            v: Vector) -> None:
    for drag in (None, [0.1, -0.3, 0.0]):
        command = limit_horizontal(a, vertical, v, A_MAX, V_MAX, T, drag=drag)
        assert_within_limits(command.acceleration, v, A_MAX, V_MAX, T)


@pytest.mark.parametrize('drag', [None, [0.1, -0.3, 0.0]], ids=['at once', 'smoothly'])
def test_the_altitude_goes_before_the_horizontal_pull(drag: Vector | None) -> None:
    v = np.array([V_MAX, 0.0, 0.0])
    command = limit_horizontal([2.0, 0.0, 9.0], 1.0, v, A_MAX, V_MAX, T, drag=drag)
    assert command.acceleration[2] == pytest.approx(1.0)
    assert np.linalg.norm(v + T * command.acceleration) <= V_MAX
    assert command.reason == 'v_max'


def test_room_is_left_for_the_climb_that_is_coming() -> None:
    wanted, v = [2.0, 0.0, 0.0], [0.3, 0.0, 0.0]
    for climb, fastest in ((0.0, 0.5), (0.3, 0.4), (-0.4, 0.3), (0.6, 0.0)):
        command = limit_horizontal(wanted, 0.0, v, A_MAX, V_MAX, T, climb)
        assert v[0] + T * command.acceleration[0] == pytest.approx(
            max(fastest, 0.3 - A_MAX * T), abs=1e-6)
        assert bool(command.reason) == (climb != 0.0)


@pytest.mark.parametrize('pull', [[1.0, 0.0, 0.0], [1.0, 0.5, 0.0]])
def test_at_v_max_noise_of_the_velocity_is_not_a_command(pull: Vector) -> None:
    """Within one period, errors of 0.02 m/s would be commands of 0.2 m/s^2."""
    speeds = np.linspace(V_MAX - 0.02, V_MAX + 0.02, 9)
    commands = [limit_horizontal(pull, 0.0, [speed, 0.0, 0.0], A_MAX, V_MAX, T,
                                 drag=[0.0] * 3).acceleration for speed in speeds]
    assert np.ptp(commands, axis=0).max() <= 0.04 / SPEED_TIME + 1e-6


def test_at_v_max_cohesion_turns_the_velocity_within_speed_time() -> None:
    """Within one period it would turn as hard as ``a_max`` permits, and back in the next one."""
    beside = Bound([0.0, 1.0, 0.0], 20.0, COHESION)
    command = keep_bounds([0.0] * 3, [V_MAX, 0.0, 0.0], [beside], A_MAX, V_MAX, T)
    assert command.acceleration[1] == pytest.approx(V_MAX / SPEED_TIME, rel=0.01)


@given(st.integers(0, 2 ** 32))
def test_what_keeps_clear_of_a_neighbor_is_cut_last(seed: int) -> None:
    """No sampled acceleration within the limits keeps more of what is wanted along ``axis``."""
    rng = np.random.default_rng(seed)
    v, wanted, axis = rng.uniform(-0.4, 0.4, 3), rng.uniform(-4.0, 4.0, 3), rng.normal(size=3)
    axis = axis / np.linalg.norm(axis)
    if seed % 4 == 0:
        v = rng.uniform(-1.5, 1.5) * axis  # the centers and the direction on one line
    a = limit_command(wanted, v, A_MAX, V_MAX, T, axis).acceleration
    fastest = max(V_MAX, float(np.linalg.norm(v)))
    assert np.linalg.norm(a) <= A_MAX and np.linalg.norm(v + T * a) <= fastest
    samples = np.vstack([rng.uniform(-A_MAX, A_MAX, (3000, 3)),
                         a + 0.1 * rng.normal(size=(3000, 3))])
    inside = samples[(np.linalg.norm(samples, axis=1) <= A_MAX)
                     & (np.linalg.norm(v + T * samples, axis=1) <= fastest)]
    kept = min(float(axis @ wanted), float((inside @ axis).max()))
    assert axis @ a >= kept - 1e-5 or axis @ wanted <= 0.0


@given(st.integers(0, 2 ** 32))
def test_across_axis_command_stays_as_near_as_limits_allow(seed: int) -> None:
    """No sampled acceleration within the limits with the same part along ``axis`` is nearer."""
    rng = np.random.default_rng(seed)
    v, wanted, axis = rng.uniform(-0.5, 0.5, 3), rng.uniform(-4.0, 4.0, 3), rng.normal(size=3)
    axis = axis / np.linalg.norm(axis)
    if seed % 4 == 0:
        v = rng.uniform(-1.5, 1.5) * axis
    a = limit_command(wanted, v, A_MAX, V_MAX, T, axis).acceleration
    plain = limit_command(wanted, v, A_MAX, V_MAX, T).acceleration
    assert axis @ a >= axis @ plain  # less would be nearer to the neighbor
    if axis @ a == axis @ plain or axis @ wanted <= 0.0:
        assert np.array_equal(a, plain)
        return
    samples = np.vstack([rng.uniform(-A_MAX, A_MAX, (3000, 3)),
                         a + 0.1 * rng.normal(size=(3000, 3))])
    samples = samples + np.outer(axis @ a - samples @ axis, axis)
    fastest = max(V_MAX, float(np.linalg.norm(v)))
    inside = samples[(np.linalg.norm(samples, axis=1) <= A_MAX * SENT_INSIDE)
                     & (np.linalg.norm(v + T * samples, axis=1) <= fastest)]
    nearest = np.linalg.norm(inside - wanted, axis=1).min(initial=math.inf)
    assert np.linalg.norm(a - wanted) <= nearest + 1e-5
