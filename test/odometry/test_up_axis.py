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

"""Which axis points up: of a vehicle that leans in flight, and where base_link lies otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.geometry import Array, quaternion_from_rpy, quaternion_to_matrix
from flock_follower.odometry.reader import UpAxis

CAMERA = (-np.pi / 2.0, 0.0, -np.pi / 2.0)  # x right, y down, z ahead


def seen(R_base_child: Array, lean: float) -> UpAxis:
    """Return what is seen in 5 s of a flight that leans to and fro."""
    watched = UpAxis()
    for k in range(100):
        t = 0.05 * k
        R = quaternion_to_matrix(quaternion_from_rpy(lean * np.sin(3.0 * t), 0.0, 0.7 * t))
        watched.take(t, R @ R_base_child)
    return watched


@pytest.mark.parametrize(('rpy', 'lean', 'axis'), [
    ((0.0, 0.0, 0.0), 0.5, 'z'), (CAMERA, 0.5, '-y'), ((np.pi / 2.0, 0.0, 0.0), 0.5, 'y'),
    ((0.0, np.pi / 2.0, 0.0), 0.5, '-x'), ((0.0, -np.pi / 2.0, 0.0), 0.5, 'x'),
    ((np.pi, 0.0, 0.0), 0.5, '-z'), ((0.8, 0.5, 0.0), 0.0, '')])  # the last: between two axes
def test_another_axis_than_z_is_named(
        rpy: tuple[float, float, float], lean: float, axis: str) -> None:
    assert UpAxis().fault == ''
    watched = seen(quaternion_to_matrix(quaternion_from_rpy(*rpy)), lean)
    assert watched.axis == axis
    assert (f'has {axis} up instead of z: set odom_child_rpy' in watched.fault) == (
        axis not in ('', 'z'))
