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

"""What disturbs the vehicle is found from what was sent and what became of it."""

import math

from bridge_flight import Flight
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from flock_follower.gate.disturbance import (
    CONTRADICTION_TIME,
    DisturbanceObserver,
    HeightWatch,
    THRUST_ERROR_MAX,
    WIND_MAX,
)

STEP = 0.05
WIND = np.array([7.5, 0.0, 0.0])
"""m/s; the embedded vehicle's drag, 0.1 1/s, makes 0.75 m/s^2 of it."""


def test_estimate_stays_without_velocity_ends_without_setpoints():
    observer = DisturbanceObserver()
    for k in range(120):
        observer.step(np.zeros(3), np.array([0.05 * k, 0.0, 0.0]) if k < 100 else None, k * STEP)
    assert np.linalg.norm(observer.acceleration) > 0.5
    observer.step(None, np.zeros(3), 121 * STEP)
    assert not np.any(observer.acceleration)


def test_setpoints_that_are_not_flown_teach_no_wind():
    observer, estimates = DisturbanceObserver(), []
    for k in range(100):
        observer.step(np.array([1.9, 0.0, 0.0]), np.zeros(3), k * STEP)  # held back
        estimates.append(observer.acceleration[0])
    frozen = round((1.0 + CONTRADICTION_TIME) / STEP)
    assert estimates[frozen] > -WIND_MAX and set(estimates[frozen:]) == {estimates[frozen]}


ANY = arrays(float, 3, elements=st.floats(-1e300, 1e300))


@given(st.lists(st.tuples(st.none() | ANY, st.none() | ANY, st.floats(-1.0, 1.0)), max_size=20))
@example([(np.zeros(3), np.zeros(3), 0.1), (np.zeros(3), np.array([0.0, 0.0, 99.0]), 0.1)])
def test_whatever_comes_the_estimate_is_bounded(steps):
    observer, now = DisturbanceObserver(), 0.0
    for sent, velocity, pause in steps:
        now += pause
        with np.errstate(over='ignore'):
            observer.step(None if sent is None else np.clip(sent, -20.0, 20.0), velocity, now)
        assert np.linalg.norm(observer.acceleration[:2]) <= WIND_MAX
        assert abs(observer.acceleration[2]) <= THRUST_ERROR_MAX


@pytest.mark.slow
@pytest.mark.parametrize(('compensation', 'planner', 'least', 'most'), [
    # Braking hovers in the wind where it is set against, and the wind carries none beyond v_max.
    ('never', None, 0.15, 9.0), ('auto', None, -0.03, 0.03), ('auto', (2.0, 0.0, 0.0), 0.2, 0.52)])
def test_the_wind_is_set_against(compensation, planner, least, most):
    flight = Flight(bridge={'wind_compensation': compensation})
    flight.engage()
    flight.controller.wind = WIND
    flight.planner = planner and np.array(planner)
    flight.fly(8.0)
    for _ in range(10):
        flight.fly(0.1)
        assert least < flight.vehicle.velocity[0] < most and abs(flight.vehicle.velocity[1]) < 0.03


def watched(heights, commanded):
    """Return the first height at which the watch hands the vehicle over; None if at none."""
    watch = HeightWatch()
    for height, wanted in zip(heights, commanded):
        watch.step(height, wanted)
        if watch.reason:
            return height
    return None


RUNAWAY = [3.0 + 0.01 * k for k in range(200)]


@pytest.mark.parametrize(('heights', 'commanded', 'expected'), [
    (RUNAWAY, [3.0] * 200, 3.81),
    ([6.0 - height for height in RUNAWAY], [3.0] * 200, 2.19),
    ([3.0] * 200, RUNAWAY, None),  # the commanded height leaves the vehicle
    (RUNAWAY, [height + 1.5 for height in RUNAWAY], None),
    (RUNAWAY, [None] * 200, None), (RUNAWAY, [math.nan] * 200, None),
    ([4.5 - 0.01 * k for k in range(200)], [3.0] * 200, None)])  # it returns
def test_a_height_that_leaves_the_commanded_one_is_handed_over(heights, commanded, expected):
    assert watched(heights, commanded) == (
        None if expected is None else pytest.approx(expected, abs=0.03))
