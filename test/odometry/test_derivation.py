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

"""Velocities from positions: how far they lag and tremble, what steps do, and what they admit."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.odometry.derivation import DerivedVelocity


def motion(t: float) -> tuple[Array, Array]:
    """Return position and velocity of a lively flight."""
    return (np.array([np.sin(0.7 * t), 1.2 * np.cos(0.5 * t), 0.2 * np.sin(t)]),
            np.array([0.7 * np.cos(0.7 * t), -0.6 * np.sin(0.5 * t), 0.2 * np.cos(t)]))


def errors(rate: float, noise: float, steps: float = 0.0) -> tuple[Array, Array]:
    """
    Return errors of the velocity (n, 3), m/s, and the deviations (n,) it admits.

    Positions are wrong by white ``noise``, m, and by a step of ``steps``, m, every two seconds.
    """
    rng, derived = np.random.default_rng(0), DerivedVelocity()
    off, admitted = [], []
    for k in range(round(20.0 * rate)):
        t = k / rate
        position, velocity = motion(t)
        moved = steps * np.array([t // 2.0 % 2.0, 0.0, 0.0])
        derived.take(t, position + moved + noise * rng.standard_normal(3))
        if t > 3.0:
            off.append(derived.velocity_at(t) - velocity)
            admitted.append(np.sqrt(derived.variance_of_velocity))
    return np.array(off), np.array(admitted)


def rms(off: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


@pytest.mark.parametrize('rate', [10.0, 200.0])
@pytest.mark.parametrize(('noise', 'most'), [(0.0, 0.005), (0.003, 0.055)])
def test_the_velocity_is_found_at_any_rate(rate: float, noise: float, most: float) -> None:
    assert rms(errors(rate, noise)[0]) < most


@pytest.mark.parametrize('rate', [10.0, 100.0])
@pytest.mark.parametrize('step', [0.05, 1.0])
def test_a_step_of_the_position_is_no_motion(rate: float, step: float) -> None:
    without, _ = errors(rate, 0.002)
    off, _ = errors(rate, 0.002, step)
    assert np.abs(off).max() < np.abs(without).max() + 0.03


def test_a_velocity_that_changes_at_once_is_followed() -> None:
    derived = DerivedVelocity()
    for k in range(100):
        t = k / 20.0
        derived.take(t, np.array([0.0 if t < 3.0 else 1.5 * (t - 3.0), 0.0, 0.0]))
    np.testing.assert_allclose(derived.rate, [1.5, 0.0, 0.0], atol=0.1)


def test_positions_that_make_no_sense_do_not_run_away() -> None:
    rng, derived = np.random.default_rng(0), DerivedVelocity()
    for k in range(1000):
        derived.take(k / 20.0, 5.0 * rng.standard_normal(3))
        assert np.linalg.norm(derived.rate) < 50.0


@pytest.mark.parametrize('rate', [10.0, 30.0, 200.0])
def test_it_admits_what_it_errs_by(rate: float) -> None:
    off, admitted = errors(rate, 0.003)
    nees = np.sum(off**2, axis=1) / admitted**2 / 3.0
    assert 0.1 < nees.mean() < 1.0  # white noise is the easy case: see CORRELATED


def test_at_the_start_noise_is_not_taken_for_steps() -> None:
    """Steps in a row, each extrapolated, made motion of what positions wander at 30 Hz."""
    speeds = []
    for seed in range(30):
        rng, derived, wander = np.random.default_rng(seed), DerivedVelocity(), np.zeros(3)
        for k in range(15):
            wander = wander + rng.normal(0.0, 0.02 / 30.0**0.5, 3)
            derived.take(k / 30.0, wander + rng.normal(0.0, 0.003, 3))
            if k >= 5:
                speeds.append(derived.rate)
    assert np.sqrt(np.mean(np.sum(np.square(speeds), axis=1))) < 0.25
