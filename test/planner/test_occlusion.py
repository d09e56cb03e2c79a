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

"""Occlusion: images that should show the marker and do not; the follower brakes."""

import math

from flown import Follower, own, seen
import numpy as np
import pytest

from flock_follower.planner.inputs import Neighbor
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.sight import FieldOfView, Occlusion, occlusion

VIEW = (FieldOfView(0.5, 0.5, 0.35, 0.35),)
ME = own(1.0)


def leader(stamp: float, x: float = 2.0, y: float = 0.0, z: float = 2.0) -> Neighbor:
    return seen(stamp, (x, y, z))


def frames(*stamps: float) -> list[float]:
    return [0.6, 0.7, *stamps]


def test_three_images_in_a_row_without_it_make_it_occluded() -> None:
    assert occlusion(None, leader(0.7), ME, frames(0.8, 0.9), VIEW, 0.0) is None
    assert occlusion(None, leader(0.7), ME, frames(0.8, 0.9, 1.0), VIEW, 0.0) == Occlusion(0.7)
    # What is not ahead of the camera, or too near to the edge, has left the image.
    for beside in (leader(0.7, y=1.0), leader(0.7, y=-1.0), leader(0.7, z=2.8),
                   leader(0.7, z=1.2), leader(0.7, x=-2.0), leader(0.7, x=0.3)):
        assert occlusion(None, beside, ME, frames(0.8, 0.9, 1.0), VIEW, 0.0) is None


def test_a_camera_that_is_tilted_by_an_acceleration_looks_elsewhere() -> None:
    high, images = leader(0.7, z=2.25), frames(0.8, 0.9, 1.0)
    assert occlusion(None, high, ME, images, VIEW, 0.0)
    assert occlusion(None, high, ME, images, VIEW, 2.5) is None
    assert occlusion(None, high, ME, images, VIEW, -2.5)


def test_without_a_calibration_or_by_hearsay_nothing_is_occluded() -> None:
    images = frames(0.8, 0.9, 1.0)
    assert occlusion(None, leader(0.7), ME, images, (), 0.0) is None
    assert occlusion(None, None, ME, images, VIEW, 0.0) is None
    reported = seen(0.7, received=True)
    assert occlusion(None, reported, ME, images, VIEW, 0.0) is None


def test_three_detections_in_a_row_end_it() -> None:
    before = occlusion(Occlusion(0.2), leader(0.8), ME, frames(0.8), VIEW, 0.0)
    assert before == Occlusion(0.2, 0.8)
    before = occlusion(before, leader(0.9), ME, frames(0.8, 0.9), VIEW, 0.0)
    assert before == Occlusion(0.2, 0.8)
    assert occlusion(before, leader(1.0), ME, frames(0.8, 0.9, 1.0), VIEW, 0.0) is None
    assert occlusion(before, leader(0.9), ME, frames(0.8, 0.9, 1.0, 1.1, 1.2), VIEW, 0.0) == (
        Occlusion(0.9))
    assert occlusion(Occlusion(0.7), leader(0.7), ME, frames(0.8), VIEW, 0.0) == Occlusion(0.7)


@pytest.mark.parametrize('heading', [0.0, math.pi / 2.0, math.pi, -math.pi / 2.0])
def test_of_several_cameras_the_one_that_should_show_it_counts(heading: float) -> None:
    sides = tuple(FieldOfView(0.6, 0.6, 0.4, 0.4, at) for at in (0.0, math.pi / 2.0, math.pi))
    there = leader(0.7, 2.0 * math.cos(heading), 2.0 * math.sin(heading))
    found = occlusion(None, there, ME, frames(0.8, 0.9, 1.0), sides, 0.0)
    assert (found is not None) == (heading >= 0.0)


def test_it_brakes_at_once_and_follows_again() -> None:
    """Behind a leader that is hidden from 1 to 2 s."""
    follower, speed, stamps = Follower(PlannerParams(v_max=2.0)), np.array([0.5, 0.0, 0.0]), []
    follower.velocity, follower.now, states = speed, 0.1, []
    for tick in range(1, 40):
        now = follower.now
        stamps += [now - 0.1 + 0.033 * k for k in range(1, 4)]
        decision = follower.tick(*[
            seen(s, np.array([2.1, 0.0, 2.0]) + s * speed, speed) for s in stamps[-3:]
            if s < 1.0 or s > 2.0], looked=now, view=VIEW, frames=stamps[-20:])
        states.append(decision.state)
        if tick == 19:
            assert abs(follower.velocity[0]) < 0.15
    assert states[:10] == [State.TRACK] * 10 and states[10:20] == [State.HOLD] * 10
    assert State.TRACK in states[20:23] and states[-1] is State.TRACK
