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

"""The size of a marker at rest: as wrong as it is, with honest deviations."""

from __future__ import annotations

import numpy as np
from observed import attitude, CAMERA, LEADER, position
import pytest

from flock_follower.checks.marker_size import distance_ratio, Ratio
from flock_follower.geometry import Array, quaternion_to_matrix
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix

TIMES = np.arange(0.0, 5.0, 0.1)
R = np.array([quaternion_to_matrix(attitude(t)) for t in TIMES])


def ratio(scale: float = 1.0, degrees: tuple[float, ...] = (0.0, 0.0, 0.0), noise: float = 0.0,
          seed: int = 0, leader: Array = LEADER) -> Ratio:
    """
    Return the ratio for the vehicle of ``observed``; odometry's errors, m, last for 0.5 s.

    :param degrees: rotation vector by which the camera is mounted otherwise than configured.
    """
    rng = np.random.default_rng(seed)
    own = np.array([position(t) for t in TIMES])
    seen = ((np.swapaxes(R, 1, 2) @ (leader - own)[:, :, None])[:, :, 0] - CAMERA
            ) @ rotation_vector_to_matrix(np.radians(degrees))
    errors, keep = np.zeros(own.shape), np.exp(-0.1 / 0.5)
    for n in range(1, len(errors)):
        errors[n] = keep * errors[n - 1] + noise * (1.0 - keep**2)**0.5 * rng.standard_normal(3)
    found = distance_ratio(scale * seen + 0.5 * noise * rng.standard_normal(own.shape),
                           own + errors, R, CAMERA)
    assert found is not None
    return found


@pytest.mark.parametrize('degrees', [(0.0, 0.0, 0.0), (-8.0, 6.0, 10.0)])
def test_the_ratio_is_found_whatever_the_mounting(degrees: tuple[float, ...]) -> None:
    found = ratio(0.9, degrees)
    assert found.at_rest
    assert found.ratio == pytest.approx(0.9, abs=0.03)


def test_deviations_are_honest_if_errors_last() -> None:
    found = [ratio(noise=0.02, seed=seed) for seed in range(40)]
    off = np.array([(one.ratio - 1.0) / one.deviation for one in found])
    assert 0.2 < np.sqrt(np.mean(off**2)) < 1.3
    assert np.abs(off).max() < 4.0


@pytest.mark.parametrize('gain', [0.1, 0.5, 0.9])
@pytest.mark.parametrize('rates', [(0.9, 1.4), (0.4, 0.3)])
def test_a_leader_that_moves_has_no_other_size(gain: float, rates: tuple[float, float]) -> None:
    moved = np.array([[np.sin(rates[0] * t), np.cos(rates[1] * t), 0.0] for t in TIMES])
    found = ratio(leader=LEADER + gain * moved)
    assert not found.at_rest or abs(found.ratio - 1.0) < max(0.05, 3.0 * found.deviation)
