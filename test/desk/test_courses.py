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

"""Simulated leaders fly what their scenario says, within its acceleration and jerk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flock_desk.scenarios.courses import Course, course, STEP
from flock_desk.scenarios.scenario import LeaderMotion, Leg, Scenario, Start

SHUTTLE = LeaderMotion('legs', legs=(Leg(6.0, (1.2, 0.0, 0.0)), Leg(6.0, (-1.2, 0.0, 0.0))),
                       repeat=True)
MOTIONS = {
    'legs': SHUTTLE,
    'circle': LeaderMotion('circle', speed=1.2, size=1.6),
    'figure_eight': LeaderMotion('figure_eight', speed=1.2, size=2.0),
    'wander': LeaderMotion('wander', speed=0.4),
}


def flown(motion: LeaderMotion, run: int = 0, **start: tuple[float, float]) -> Course:
    return course(Scenario('test', '', leader=motion, start=Start(**start)), run)


@pytest.mark.parametrize('name', MOTIONS)
@pytest.mark.parametrize('run', [0])
def test_acceleration_and_jerk_are_bounded_and_speed_is_reached(name: str, run: int) -> None:
    motion = MOTIONS[name]
    c = flown(motion, run)
    speeds = np.linalg.norm(c.velocities, axis=1)
    jerks = np.linalg.norm(np.diff(c.accelerations, axis=0), axis=1) / STEP
    assert np.linalg.norm(c.accelerations, axis=1).max() <= 1.02 * motion.acceleration
    assert jerks.max() <= 1.2 * motion.jerk
    wanted = 1.2 if name == 'legs' else motion.speed[0]
    assert 0.9 * wanted <= speeds.max() <= wanted + 1e-9
    assert np.all(speeds[:round(motion.wait / STEP)] == 0.0)


@pytest.mark.parametrize('name', MOTIONS)
def test_positions_velocities_and_accelerations_fit_together(name: str) -> None:
    c = flown(MOTIONS[name])
    assert np.gradient(c.positions, STEP, axis=0)[1:-1] == pytest.approx(
        c.velocities[1:-1], abs=1e-4)
    assert np.gradient(c.velocities, STEP, axis=0) == pytest.approx(c.accelerations)
    p, v, _, _ = c.at(10.0 + STEP / 2)
    assert p == pytest.approx(c.positions[1200:1202].mean(axis=0))
    assert v == pytest.approx(c.velocities[1200:1202].mean(axis=0))
    assert np.array_equal(c.at(1e9)[0], c.positions[-1])


def test_a_circle_is_round_and_a_figure_eight_crosses_itself() -> None:
    circle = flown(MOTIONS['circle'])
    later = circle.positions[1200:, :2]
    centre = (later.max(axis=0) + later.min(axis=0)) / 2
    assert np.linalg.norm(later - centre, axis=1) == pytest.approx(1.6, abs=0.02)
    eight = flown(MOTIONS['figure_eight'], bearing=(0.0, 0.0))
    start = eight.positions[0]
    again = np.linalg.norm(eight.positions[1200:] - start, axis=1)
    assert again.min() < 0.05
    assert np.abs(eight.positions[:, 0] - start[0]).max() == pytest.approx(2.0, abs=0.02)


def test_heading_is_fixed_or_along_the_course() -> None:
    motion = replace(MOTIONS['circle'], heading='course')
    c = flown(motion)
    moving = c.velocities[1200:]
    expected = np.arctan2(moving[:, 1], moving[:, 0])
    assert c.headings[1200:] == pytest.approx(expected)
    assert not flown(MOTIONS['circle']).headings.any()


def test_a_motion_that_needs_more_acceleration_is_refused() -> None:
    with pytest.raises(ValueError, match=r'^leader: needs 2\.25 m/s\^2: must be at most '
                       r'acceleration = 1 m/s\^2 \(slower, or a larger size\)$'):
        flown(LeaderMotion('circle', speed=1.5, size=1.0))
