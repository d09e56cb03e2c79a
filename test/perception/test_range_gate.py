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

"""Distances by radio: which are believed, and what is learned of their errors."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.perception.range_gate import (
    RANGE_GATE,
    RANGE_WILD,
    RangeBias,
    RangeGate,
    UNKNOWN_BIAS,
)

WILD = -1.01 * np.sqrt(RANGE_WILD * RANGE_GATE)
AGAIN = 25.0 / RANGE_GATE  # factor for a deviation of 5


@pytest.mark.parametrize(('most', 'deviations', 'factors'), [
    # One too long is refused until several in a row are; then the prediction was wrong.
    (4, [5.0, 5.0, 0.0, 5.0, 5.0, 5.0, 5.0], [None, None, (1, 1), None, None, None, (AGAIN, 1)]),
    # One too short is used with care, and the next one is believed.
    (6, [-5.0, -5.0], [(1, AGAIN), (AGAIN, 1)]),
    (3, [WILD, WILD, WILD], [None, None, (1.01**2 * RANGE_WILD, 1)]),
    (2, [np.nan, np.inf, -np.inf, 0.0, 1.0], [None, None, None, (1, 1), (1, 1)])])
def test_distances_outside_gate_are_refused_or_weigh_less(
        most: int, deviations: list[float],
        factors: list[tuple[float, float] | None]) -> None:
    gate = RangeGate(most)
    for deviation, expected in zip(deviations, factors):
        judged = gate.judge(deviation, 1.0)
        assert judged == (expected and pytest.approx(expected))


def learned(seed: int, true: float, seconds: float = 20.0, outliers: float = 0.05) -> RangeBias:
    """Return what is learned at 20 Hz from ranges of 0.1 m noise, some on a detour up to 1 m."""
    bias, rng = RangeBias(), np.random.default_rng(seed)
    for k in range(round(20 * seconds)):
        detour = rng.uniform(0.0, 1.0) if rng.random() < outliers else 0.0
        bias.learn(k / 20, true + rng.normal(0.0, 0.1) + detour, 0.01)
    return bias


@pytest.mark.parametrize('true', [-0.3, 0.1])
def test_the_bias_is_found_through_noise_and_detours(true: float) -> None:
    errors = np.array([learned(seed, true).value - true for seed in range(20)])
    assert np.abs(errors).max() < 0.05
    assert abs(errors.mean()) < 0.02  # detours do not pull it along
    deviation = float(np.sqrt(learned(0, true).variance(20.0)))
    assert 0.005 < deviation < 0.03
    assert np.sqrt(np.mean(errors ** 2)) < 1.7 * deviation


def test_a_bias_that_jumps_is_followed() -> None:
    bias, rng = learned(3, 0.0), np.random.default_rng(4)
    for k in range(200):
        bias.learn(20.0 + k / 20, 0.6 + rng.normal(0.0, 0.1), 0.01)
    assert bias.value == pytest.approx(0.6, abs=0.05)


def test_bias_grows_uncertain_unlearned_up_to_unknown() -> None:
    bias = learned(5, 0.1)
    variances = [bias.variance(20.0 + t) for t in (0.0, 5.0, 60.0, 1e6)]
    assert variances == sorted(variances)
    assert variances[-1] == UNKNOWN_BIAS ** 2
    assert RangeBias().variance(3.0) == UNKNOWN_BIAS ** 2
