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

"""Two velocities are compared on average, and what was found is remembered in flight."""

import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.mavlink.velocity_check import LATCH_TIME, VelocityComparison


def compared(differences, tolerance=0.25, flying=True, rate=20.0):
    """Return the comparison after differences of a time each, and the time of the last."""
    comparison, now = VelocityComparison(), 0.0
    for difference in differences:
        now += 1.0 / rate
        comparison.take(np.array([difference, 0.0, 0.0]), tolerance, flying, now)
    return comparison, now


@pytest.mark.parametrize('rate', [10.0, 20.0, 50.0])
def test_one_wrong_sample_whatever_it_says_is_no_disagreement(rate):
    for wrong in (3.0, 1e9, 1.7e308):
        comparison, now = compared([0.0] * 10 + [wrong], rate=rate)
        assert comparison.disagreeing_for(now) == -math.inf


@pytest.mark.parametrize(('difference', 'within'), [(0.7, 0.2), (0.3, 0.6), (50.0, 0.2)])
def test_what_goes_on_is_found_the_sooner_the_larger_it_is(difference, within):
    comparison, now = compared([difference] * round(within * 20))
    assert comparison.disagreeing_for(now) >= 0.0


def test_noise_that_is_often_above_the_tolerance_is_averaged():
    noise = np.random.default_rng(1).normal(0.0, 0.2, 2000)
    assert np.mean(np.abs(noise) > 0.25) > 0.2
    comparison, now = compared(noise)
    assert comparison.disagreeing_for(now) == -math.inf


def test_what_disagreed_for_long_does_so_until_it_no_longer_flies():
    comparison, now = compared([0.7] * 20)
    for _ in range(100):
        now += 0.05
        comparison.take(np.zeros(3), 0.25, True, now)
    assert comparison.disagreeing_for(now) > 5.0
    comparison.take(None, 0.25, True, now)  # nothing to compare either
    assert comparison.disagreeing_for(now) > 5.0
    comparison.take(np.zeros(3), 0.25, False, now)
    assert comparison.disagreeing_for(now) == -math.inf


def test_what_disagreed_for_a_moment_is_forgotten():
    comparison, now = compared([0.7] * 4)
    assert 0.0 <= comparison.disagreeing_for(now) < LATCH_TIME
    for _ in range(5):
        now += 0.05
        comparison.take(np.zeros(3), 0.25, True, now)
    assert comparison.disagreeing_for(now) == -math.inf


@given(st.lists(st.tuples(*[st.floats(-1.7e308, 1.7e308)] * 3), max_size=30))
def test_no_difference_whatever_is_beyond_it(differences):
    comparison = VelocityComparison()
    for k, difference in enumerate(differences):
        comparison.take(np.array(difference), 0.25, True, 0.05 * k)
        assert not math.isnan(comparison.disagreeing_for(0.05 * k))
