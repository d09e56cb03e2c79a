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

"""Simulated leaders fly as their scenario says, within its bounds; formations; the wind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flock_desk.scenarios.courses import Course, course, COURSE_STEP, turn_rate, wind_course
from flock_desk.scenarios.flock import facing_ahead, Flock, FORMATIONS, places
from flock_desk.scenarios.scenario import LeaderMotion, Leg, Scenario, Start, Wind
from flock_desk.scenarios.scenario_file import load

SHUTTLE = LeaderMotion('legs', legs=(Leg(6.0, (1.2, 0.0, 0.0)), Leg(6.0, (-1.2, 0.0, 0.0))),
                       repeat=True)
MOTIONS = {
    'legs': SHUTTLE,
    'circle': LeaderMotion('circle', speed=(1.2, 1.2), size=1.6),
    'figure_eight': LeaderMotion('figure_eight', speed=(1.2, 1.2), size=2.0),
    'wander': LeaderMotion('wander', speed=(0.4, 0.4)),
}
RANDOM = [f'{speed}{name}' for speed in ('', 'fast_')
          for name in ('spline', 'random_walk', 'stairs', 'approach')]


def flown(motion: LeaderMotion, **start: tuple[float, float]) -> Course:
    return course(Scenario('test', '', leader=motion, start=Start(**start)), 0)


@pytest.mark.parametrize('name', MOTIONS)
def test_acceleration_and_jerk_are_bounded_and_speed_is_reached(name: str) -> None:
    motion = MOTIONS[name]
    c = flown(motion)
    speeds = np.linalg.norm(c.velocities, axis=1)
    jerks = np.linalg.norm(np.diff(c.accelerations, axis=0), axis=1) / COURSE_STEP
    assert np.linalg.norm(c.accelerations, axis=1).max() <= 1.02 * motion.acceleration
    assert jerks.max() <= 1.2 * motion.jerk
    wanted = 1.2 if name == 'legs' else motion.speed[0]
    assert 0.9 * wanted <= speeds.max() <= wanted + 1e-9
    assert np.all(speeds[:round(motion.wait / COURSE_STEP)] == 0.0)
    # Positions, velocities and accelerations fit together.
    assert np.gradient(c.positions, COURSE_STEP, axis=0)[1:-1] == pytest.approx(
        c.velocities[1:-1], abs=1e-4)
    assert np.gradient(c.velocities, COURSE_STEP, axis=0) == pytest.approx(c.accelerations)
    p, v, _, _ = c.at(10.0 + COURSE_STEP / 2)
    assert p == pytest.approx(c.positions[1200:1202].mean(axis=0))
    assert v == pytest.approx(c.velocities[1200:1202].mean(axis=0))
    assert np.array_equal(c.at(1e9)[0], c.positions[-1])


def test_a_circle_is_round_and_a_figure_eight_crosses_itself() -> None:
    later = flown(MOTIONS['circle']).positions[1200:, :2]
    center = (later.max(axis=0) + later.min(axis=0)) / 2
    assert np.linalg.norm(later - center, axis=1) == pytest.approx(1.6, abs=0.02)
    eight = flown(MOTIONS['figure_eight'], bearing=(0.0, 0.0)).positions
    assert np.linalg.norm(eight[1200:] - eight[0], axis=1).min() < 0.05
    assert np.abs(eight[:, 0] - eight[0, 0]).max() == pytest.approx(2.0, abs=0.02)


def test_heading_follows_course_or_away_at_a_pilots_rate() -> None:
    c = flown(replace(MOTIONS['circle'], heading='course'))
    moving = c.velocities[1200:]
    assert c.headings[1200:] == pytest.approx(np.arctan2(moving[:, 1], moving[:, 0]))
    assert not flown(MOTIONS['circle']).headings.any()
    heading, offset = 0.0, np.array([0.0, 2.0, 0.3])
    for _ in range(round(4.0 / COURSE_STEP)):
        rate = turn_rate(heading, offset)
        assert abs(rate) <= 1.0
        heading += COURSE_STEP * float(rate)
    assert heading == pytest.approx(np.pi / 2.0, abs=0.01)
    assert turn_rate(np.array([3.0, -3.0]), np.array([[-1.0, 0.0, 0.0]] * 2)) == pytest.approx(
        [2.0 * (np.pi - 3.0), -2.0 * (np.pi - 3.0)])


@pytest.mark.parametrize('name', RANDOM)
def test_random_courses_differ_and_keep_their_limits(name: str) -> None:
    scenario = load(name)
    motion, courses = scenario.leader, [course(scenario, run) for run in range(8)]
    for c in courses:
        v, a = c.velocities, c.accelerations
        assert np.linalg.norm(v, axis=1).max() <= motion.speed[1] + 1e-9
        assert np.abs(v[:, 2]).max() <= motion.climb + 1e-9
        assert np.linalg.norm(a, axis=1).max() <= 1.02 * motion.acceleration
        assert np.abs(a[:, 2]).max() <= 1.02 * motion.climb_acceleration
        height = c.positions[:, 2] - scenario.start.altitude
        assert np.abs(height).max() <= 1.3 * motion.height
    assert np.array_equal(courses[3].positions, course(scenario, 3).positions)
    assert not np.array_equal(courses[3].positions, courses[4].positions)


def test_gusts_have_their_size_and_wind_its_own_direction() -> None:
    calm = wind_course(Wind((2.0, 2.0), 0.0), 100, 0.05, np.random.default_rng(1))
    assert np.linalg.norm(calm, axis=1) == pytest.approx(2.0)
    assert not calm[:, 2].any()
    gusty = wind_course(Wind((0.0, 0.0), 1.0, 2.0), 40_000, 0.05, np.random.default_rng(1))
    assert gusty.std(axis=0) == pytest.approx([1.0, 1.0, 0.5], rel=0.15)
    lag = round(2.0 / 0.05)
    assert np.corrcoef(gusty[lag:, 0], gusty[:-lag, 0])[0, 1] == pytest.approx(
        np.exp(-1.0), abs=0.1)


@pytest.mark.parametrize('formation', FORMATIONS)
@pytest.mark.parametrize('count', [1, 4, 19])
def test_formation_keeps_spacing_and_each_faces_the_one_ahead(
        formation: str, count: int) -> None:
    found = places(Flock(count, formation, spacing=1.8))
    points = np.array([np.zeros(3), *(place.offset for place in found)])
    apart = np.linalg.norm(points[:, None] - points, axis=2) + 10.0 * np.eye(count + 1)
    assert len(found) == count and apart.min() >= 1.8 - 1e-9
    for number, (place, yaw) in enumerate(zip(found, facing_ahead(found)), start=1):
        assert 0 <= place.ahead < number
        ahead = apart[number, place.ahead] * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        assert place.offset + ahead == pytest.approx(points[place.ahead], abs=1e-9)
