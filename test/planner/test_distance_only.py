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

"""Of whom only the distance is known: kept clear of along the line of the loss, never followed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.bounds import clear_of_sphere, DEVIATIONS
from flock_follower.planner.inputs import distance_known, Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.step import Decision, step

PARAMS = PlannerParams()
AHEAD = np.array([1.0, 0.0, 0.0])


def spread(along: float, across: float, towards: Array = AHEAD) -> Array:
    """Return a covariance (3, 3) of these standard deviations, m."""
    outer = np.outer(towards, towards)
    return along ** 2 * outer + across ** 2 * (np.eye(3) - outer)


def ranged(stamp: float, distance: float, rate: float = 0.0, towards: Array = AHEAD,
           height: float = 2.0, along: float = 0.06, across: float = 1.0) -> Neighbor:
    """Return an estimate as ranges make it, of a follower at rest at the origin."""
    return Neighbor(
        'leader', stamp, distance * towards + [0.0, 0.0, height], rate * towards,
        spread(along, across, towards), spread(0.2, 2.0, towards))


def known(stamp: float = 0.0, distance: float = 2.0) -> Neighbor:
    return Neighbor('leader', stamp, distance * AHEAD, np.zeros(3))


def own(stamp: float = 0.0, velocity: tuple[float, ...] = (0.0, 0.0, 0.0)) -> OwnState:
    return OwnState(stamp, np.array([0.0, 0.0, 2.0]), np.array(velocity), 0.0)


@pytest.mark.parametrize(('along', 'across', 'known'), [
    (0.06, 1.0, True), (0.28, 1.0, True), (0.30, 1.0, False), (0.06, 0.3, False),
    (0.06, 10.0, True), (0.5, 0.5, False), (0.28, 0.29, False), (0.29, 0.29, False),
    (float('nan'), 1.0, False)])
def test_the_distance_is_known_where_the_line_is_and_the_rest_is_not(
        along: float, across: float, known: bool) -> None:
    turned = np.array([0.6, 0.8, 0.0])
    n = ranged(0.0, 2.0, towards=turned, along=along, across=across)
    assert distance_known(n, own(), PARAMS.max_position_std) is known
    assert not distance_known(n, None, PARAMS.max_position_std)


def test_nobody_is_on_a_sphere_around_whoever_touches_him() -> None:
    n = Neighbor('leader', 0.0, np.array([0.0, 0.0, 2.0]), np.zeros(3), np.eye(3))
    assert not distance_known(n, own(), PARAMS.max_position_std)
    assert clear_of_sphere(n, known(), own(), np.zeros(3), PARAMS) is None


def test_it_backs_away_on_the_line_of_the_loss_wherever_the_estimate_has_wandered() -> None:
    straight = clear_of_sphere(ranged(0.0, 1.3, -0.4), known(), own(), np.zeros(3), PARAMS)
    aside = clear_of_sphere(ranged(0.0, 1.3, -0.4, np.array([0.6, 0.8, 0.0])), known(), own(),
                            np.zeros(3), PARAMS)
    assert straight is not None and aside is not None
    for found in (straight, aside):
        assert found.direction == pytest.approx(-AHEAD)
        assert found.distance == pytest.approx(1.3)
        assert found.seen and math.isinf(found.highest)
    assert aside.lowest == pytest.approx(straight.lowest)
    assert straight.lowest > 1.0
    elsewhere = clear_of_sphere(ranged(0.0, 1.3, towards=np.array([0.0, 1.0, 0.0])), None, own(),
                                np.zeros(3), PARAMS)
    assert elsewhere is not None
    assert elsewhere.direction == pytest.approx([0.0, -1.0, 0.0])
    assert not elsewhere.seen


@pytest.mark.parametrize(('age', 'sure'), [(0.0, True), (4.7, True), (4.8, False), (30.0, False)])
def test_fences_go_before_it_once_the_leader_may_have_come_round(age: float, sure: bool) -> None:
    """At 0.5 m/s it has come 2.36 m, to the side at 1.25 m, in 4.7 s."""
    found = clear_of_sphere(ranged(0.0, 1.25), known(-age), own(), np.zeros(3), PARAMS)
    assert found is not None
    assert found.seen is sure
    assert found.direction == pytest.approx(-AHEAD)


def test_an_uncertain_distance_is_taken_for_less_and_an_old_one_ever_less() -> None:
    def lowest(n: Neighbor) -> float:
        found = clear_of_sphere(n, known(), own(), np.zeros(3), PARAMS)
        assert found is not None
        return found.lowest

    sure, less = ranged(0.0, 1.5, along=0.0), ranged(0.0, 1.5 + 0.2 * DEVIATIONS, along=0.2)
    assert lowest(less) == pytest.approx(lowest(sure))
    ages = [lowest(ranged(-age, 2.0)) for age in (0.0, 0.4, 0.8, 1.2)]
    assert ages[0] < ages[1] < ages[2] < ages[3]


class Blind:
    """A point mass in lock step with a leader that it has seen, and then only ranges."""

    def __init__(self, params: PlannerParams = PARAMS, distance: float = 1.8) -> None:
        self.params, self.memory, self.now = params, Memory(), 0.0
        self.position, self.velocity = np.array([0.0, 0.0, 2.0]), np.zeros(3)
        self.leader = np.array([distance, 0.0, 2.0])
        self.least = math.inf
        self.decision = Decision(State.IDLE)

    def tick(self, kind: str, speed: Array | None = None) -> Decision:
        me = OwnState(self.now, self.position.copy(), self.velocity.copy(), 0.0)
        speed = np.zeros(3) if speed is None else speed
        n = Neighbor('leader', self.now, self.leader.copy(), speed.copy())
        if kind == 'ranged':
            sight = self.leader - self.position
            towards = sight / np.linalg.norm(sight)
            n = Neighbor('leader', self.now, self.leader.copy(), speed.copy(),
                                 spread(0.05, 2.0, towards), spread(0.2, 2.0, towards))
        self.memory, self.decision = step(
            self.memory, self.now, True, me, [] if kind == 'nothing' else [n], self.params,
            ground=0.0)
        assert self.decision.acceleration is not None
        for _ in range(10):
            self.velocity = self.velocity + 0.01 * self.decision.acceleration
            self.position = self.position + 0.01 * self.velocity
            self.leader = self.leader + 0.01 * speed
            self.least = min(self.least, math.dist(self.leader, self.position))
        self.now += 0.1
        return self.decision


def blind(distance: float = 1.8, params: PlannerParams = PARAMS) -> Blind:
    follower = Blind(params, distance)
    for _ in range(10):
        follower.tick('seen')
    assert follower.decision.state is State.TRACK
    return follower


def test_of_whom_only_the_distance_is_known_is_not_followed() -> None:
    follower = blind()
    states = [follower.tick('ranged', 0.4 * AHEAD).state for _ in range(40)]
    assert states[-1] is State.HOLD
    assert State.TRACK not in states[7:]
    assert not follower.decision.rejected
    assert follower.decision.warnings == ('leader out of sight, 3.4 m away by its ranges',)
    assert np.linalg.norm(follower.velocity) < 0.02
    assert abs(follower.position[0]) < 0.3  # it neither goes after it nor away from it


@pytest.mark.parametrize('distance', [1.3, 1.8, 2.6])
def test_one_that_comes_unseen_is_kept_at_its_distance(distance: float) -> None:
    with_ranges, without = blind(distance), blind(distance)
    for _ in range(50):
        with_ranges.tick('ranged', -0.45 * AHEAD)
        without.tick('nothing', -0.45 * AHEAD)
    assert with_ranges.least > 1.0
    assert with_ranges.least > without.least or without.least > 1.3


def test_as_long_as_it_stays_away_nobody_retreats() -> None:
    with_ranges, without = blind(2.2), blind(2.2)
    for _ in range(50):
        with_ranges.tick('ranged')
        without.tick('nothing')
    assert abs(with_ranges.position[0]) < 0.15
    assert without.position[0] < -0.7  # where nothing is known it has to


def test_where_ranges_end_it_is_as_if_there_had_been_none_a_moment_later() -> None:
    follower = blind(2.2)
    for _ in range(20):
        follower.tick('ranged')
    for _ in range(40):
        follower.tick('nothing')
    assert follower.memory.ranged == {}
    assert follower.position[0] < -0.7


def test_seen_again_it_is_followed_and_no_more_kept_on_a_sphere() -> None:
    follower = blind()
    for _ in range(30):
        follower.tick('ranged')
    assert set(follower.memory.ranged) == {'leader'}
    assert follower.tick('seen').state is State.TRACK
    assert follower.memory.ranged == {}
