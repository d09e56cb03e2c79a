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

"""The flights that are rendered: exact derivatives, limits, and a marker always in view."""

import numpy as np
import pytest

from flock_desk.scenarios.trajectories import fly, leader_course, TRACK_STEP
from flock_follower.geometry import quaternion_to_matrix

DRAG, GRAVITY = 0.25, 9.81


@pytest.fixture(scope='module')
def flight():
    return fly(20.0)


def test_leader_velocity_and_acceleration_derive_its_course():
    times = np.arange(4001) * TRACK_STEP
    p, v, a, heading = leader_course(times)
    np.testing.assert_allclose(np.gradient(p, TRACK_STEP, axis=0)[1:-1], v[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(v, TRACK_STEP, axis=0)[1:-1], a[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.arctan2(v[:, 1], v[:, 0]), heading, atol=1e-6)


@pytest.mark.parametrize('number', [0, 1])
def test_the_rotors_push_along_acceleration_drag_and_gravity(flight, number):
    track = flight[number]
    for k in range(0, len(track.positions), 50):
        thrust = track.accelerations[k] + DRAG * track.velocities[k] + [0.0, 0.0, GRAVITY]
        up = quaternion_to_matrix(track.quaternions[k])[:, 2]
        assert np.arccos(up @ thrust / np.linalg.norm(thrust)) < np.deg2rad(1.5)  # buffeting
