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

"""Scale and mounting by a marker at rest: as wrong as they are, with honest deviations."""

from __future__ import annotations

import numpy as np
from observed import attitude, between, CAMERA, LEADER, position, velocity
import pytest

from flock_follower.checks.resting_marker import fit_rest, OwnPath, RestFit, Sightings
from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)

TIMES = np.arange(0.0, 5.0, 0.1)


def own_path(times: Array, noise: float = 0.0, seed: int = 0) -> OwnPath:
    """Return how the vehicle of ``observed`` moves; the odometry's errors last for 0.5 s."""
    rng = np.random.default_rng(seed)
    errors = np.zeros((len(times), 3))
    for n in range(1, len(times)):
        keep = np.exp(-(times[n] - times[n - 1]) / 0.5)
        errors[n] = keep * errors[n - 1] + noise * (1.0 - keep**2)**0.5 * rng.standard_normal(3)
    return OwnPath(
        times, np.array([position(t) for t in times]) + errors,
        np.array([velocity(t) for t in times]),
        np.array([quaternion_to_matrix(attitude(t)) for t in times]),
        np.array([between(t - 0.001, t + 0.001) / 0.002 for t in times]))


def seen_from(times: Array, scale: float = 1.0, turn: Array | None = None, noise: float = 0.0,
              place: Array | None = None, seed: int = 0) -> Sightings:
    """Return how it sees a leader at ``place`` (n, 3), at rest where that is None."""
    rng = np.random.default_rng(seed + 100)
    R = np.array([quaternion_to_matrix(attitude(t)) for t in times])
    mounted = np.eye(3) if turn is None else rotation_vector_to_matrix(turn)
    away = (LEADER if place is None else place) - np.array([position(t) for t in times])
    arms = scale * (((np.swapaxes(R, 1, 2) @ away[:, :, None])[:, :, 0] - CAMERA) @ mounted)
    return Sightings(arms + noise * rng.standard_normal(arms.shape),
                     np.full(len(times), max(noise, 0.002)),
                     mounted.T @ np.swapaxes(R, 1, 2), CAMERA)


def fitted(seen: Sightings, own: OwnPath) -> RestFit:
    fit = fit_rest(seen, own)
    assert fit is not None
    return fit


def test_scale_and_mounting_are_found_together() -> None:
    turn = np.deg2rad([-25.0, 6.0, 10.0])
    fit = fitted(seen_from(TIMES, 0.9, turn), own_path(TIMES))
    np.testing.assert_allclose(fit.turn, turn, atol=0.01)
    assert fit.scale == pytest.approx(0.9, abs=0.01)
    assert fit.deviation < 0.03 and fit.at_rest


def test_deviations_are_honest_where_errors_last() -> None:
    off = []
    for seed in range(20):
        fit = fitted(seen_from(TIMES, noise=0.01, seed=seed), own_path(TIMES, 0.02, seed))
        off.append([(fit.scale - 1.0) / fit.deviation, *fit.turn / fit.turn_deviations])
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    assert (rms < 1.3).all(), rms
    assert (rms > 0.3).all(), rms
    assert np.abs(off).max() < 4.0


@pytest.mark.parametrize('gain', [0.1, 0.5, 0.9])
@pytest.mark.parametrize('rates', [(0.9, 1.4), (0.4, 0.3)])
def test_a_leader_that_goes_its_way_is_told_no_other_size(
        gain: float, rates: tuple[float, float]) -> None:
    place = LEADER + gain * np.array([[np.sin(rates[0] * t), np.cos(rates[1] * t), 0.0]
                                      for t in TIMES])
    fit = fitted(seen_from(TIMES, place=place), own_path(TIMES))
    assert not fit.at_rest or abs(fit.scale - 1.0) < max(0.05, 3.0 * fit.deviation)


def test_a_leader_that_turns_is_not_at_rest() -> None:
    seen = seen_from(TIMES)
    turning = np.array([quaternion_to_matrix(quaternion_from_rpy(0.0, 0.0, 0.4 * np.sin(t)))
                        for t in TIMES])
    fit = fitted(seen._replace(attitudes=seen.attitudes @ turning), own_path(TIMES))
    assert fit.scale == pytest.approx(1.0, abs=0.01)
    assert not fit.at_rest


def test_single_sightings_far_out_change_little() -> None:
    seen = seen_from(TIMES, 0.8)
    seen.arms[::9] += 0.5
    fit = fitted(seen, own_path(TIMES))
    assert fit.scale == pytest.approx(0.8, abs=0.03)
