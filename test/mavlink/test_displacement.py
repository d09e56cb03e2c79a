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

"""Displacements of two sources over five seconds: what differs, and what only jumped."""

import math

import numpy as np
import pytest

from flock_follower.mavlink.velocity_check import difference, Path, WINDOW

PERIOD = 0.05


def paths(seconds, one, other, turn=0.0, velocity=None):
    """Return two paths of positions by functions of time; the first one's frame is turned."""
    cos, sin = math.cos(turn), math.sin(turn)
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]).T
    first, second = Path(), Path()
    for k in range(round(seconds / PERIOD) + 1):
        now = k * PERIOD
        first.take(axes @ np.asarray(one(now), dtype=float), velocity, now)
        second.take(np.asarray(other(now), dtype=float), None, now)
    return first, second, seconds


def test_equal_motions_differ_by_nothing_in_frames_that_are_turned():
    for turn in (0.0, 1.0, -2.5):
        first, second, now = paths(
            8.0, lambda t: (0.4 * t, 0.1 * t, 0.2 * t),
            lambda t: (5.0 + 0.4 * t, 0.1 * t - 3.0, 0.2 * t), turn)
        assert np.linalg.norm(difference(first, second, turn, now)) < 1e-9


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_a_velocity_error_adds_up_over_the_window(axis):
    drift = np.eye(3)[axis]
    first, second, now = paths(12.0, lambda t: 0.2 * t * drift, lambda t: 0.0 * drift)
    np.testing.assert_allclose(difference(first, second, 0.0, now), 0.2 * WINDOW * drift,
                               atol=1e-9)
    first, second, now = paths(2.0, lambda t: 0.2 * t * drift, lambda t: 0.0 * drift)
    np.testing.assert_allclose(difference(first, second, 0.0, now), 0.4 * drift, atol=0.02)


def test_a_jump_that_the_velocity_does_not_match_is_counted_and_taken_out():
    first, second, now = paths(
        8.0, lambda t: (1.5 * (t > 6.0), 0.0, 0.0), lambda t: (0.0, 0.0, 0.0),
        velocity=np.zeros(3))
    assert first.jumps == 1 and np.linalg.norm(difference(first, second, 0.0, now)) < 1e-9


def test_what_is_old_or_interrupted_is_not_compared():
    first, second, now = paths(8.0, lambda t: (t, 0.0, 0.0), lambda t: (0.0, 0.0, 0.0))
    assert difference(first, second, 0.0, now + 0.6) is None
    assert difference(first, Path(), 0.0, now) is None
    for path in (first, second):
        path.take(np.array([99.0, 0.0, 0.0]), None, now + 1.0)  # after a gap it begins again
    assert difference(first, second, 0.0, now + 1.0) is None
