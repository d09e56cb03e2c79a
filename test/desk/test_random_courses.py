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

"""Leaders that fly at random keep what the scenario allows them, and use it."""

from __future__ import annotations

import numpy as np
import pytest

from flock_desk.scenarios.courses import Course, course, STEP, turn_rate
from flock_desk.scenarios.scenario import LeaderMotion, Scenario
from flock_desk.scenarios.scenario_file import load

NAMES = ['spline', 'random_walk', 'stairs', 'approach']
RANDOM = [*NAMES, *(f'fast_{name}' for name in NAMES)]


def courses(scenario: Scenario, count: int = 8) -> list[Course]:
    return [course(scenario, run) for run in range(count)]


@pytest.mark.parametrize('name', RANDOM)
def test_speed_climb_acceleration_and_height_are_bounded_in_every_run(name: str) -> None:
    scenario = load(name)
    motion = scenario.leader
    for flown in courses(scenario):
        v, a = flown.velocities, flown.accelerations
        assert np.linalg.norm(v, axis=1).max() <= motion.speed[1] + 1e-9
        assert np.abs(v[:, 2]).max() <= motion.climb + 1e-9
        assert np.linalg.norm(a, axis=1).max() <= 1.02 * motion.acceleration
        assert np.abs(a[:, 2]).max() <= 1.02 * motion.climb_acceleration
        height = flown.positions[:, 2] - scenario.start.altitude
        assert np.abs(height).max() <= 1.3 * motion.height


@pytest.mark.parametrize('name', RANDOM)
def test_each_run_draws_another_and_the_same_again(name: str) -> None:
    scenario = load(name)
    one, other, again = (course(scenario, run).positions for run in (3, 4, 3))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(('change', 'message'), [
    ({'climb': 0.5, 'speed': (0.3, 0.6)}, r'^climb = 0\.5: must be at most speed = 0\.3$'),
    ({'climb': 0.1, 'climb_acceleration': 2.0},
     r'^climb_acceleration = 2: must be at most acceleration = 1$'),
])
def test_a_climb_that_does_not_fit_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LeaderMotion('random_walk', **change)  # type: ignore[arg-type]


def test_it_turns_its_tail_to_the_follower_no_faster_than_a_pilot() -> None:
    heading, offset = 0.0, np.array([0.0, 2.0, 0.3])
    for _ in range(round(4.0 / STEP)):
        rate = turn_rate(heading, offset)
        assert abs(rate) <= 1.0
        heading += STEP * float(rate)
    assert heading == pytest.approx(np.pi / 2.0, abs=0.01)
    assert turn_rate(np.array([3.0, -3.0]), np.array([[-1.0, 0.0, 0.0]] * 2)) == pytest.approx(
        [2.0 * (np.pi - 3.0), -2.0 * (np.pi - 3.0)])
