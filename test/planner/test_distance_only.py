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

"""A neighbor of which only the distance is known: kept clear of, never followed."""

from __future__ import annotations

import math

from flown import Follower, own, PARAMS, seen
import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.bound_keeping import SEPARATION
from flock_follower.planner.bounds import clear_of_sphere, DEVIATIONS
from flock_follower.planner.inputs import distance_known, Neighbor
from flock_follower.planner.modes import State
from flock_follower.planner.step import Decision

AHEAD = np.array([1.0, 0.0, 0.0])


def spread(along: float, across: float, towards: Array = AHEAD) -> Array:
    """Return a covariance (3, 3) of these standard deviations, m."""
    outer = np.outer(towards, towards)
    return along ** 2 * outer + across ** 2 * (np.eye(3) - outer)


def ranged(stamp: float, distance: float, rate: float = 0.0, towards: Array = AHEAD,
           height: float = 2.0, along: float = 0.06, across: float = 1.0) -> Neighbor:
    """Return an estimate as ranges make it, of a follower at rest at the origin."""
    return seen(stamp, distance * towards + [0.0, 0.0, height], rate * towards,
                position_covariance=spread(along, across, towards),
                velocity_covariance=spread(0.2, 2.0, towards))


@pytest.mark.parametrize(('along', 'across', 'known'), [
    (0.06, 1.0, True), (0.28, 1.0, True), (0.30, 1.0, False), (0.06, 0.3, False),
    (0.06, 10.0, True), (0.5, 0.5, False), (0.28, 0.29, False), (0.29, 0.29, False),
    (float('nan'), 1.0, False)])
def test_distance_is_known_along_line_and_unknown_elsewhere(
        along: float, across: float, known: bool) -> None:
    turned = np.array([0.6, 0.8, 0.0])
    n = ranged(0.0, 2.0, towards=turned, along=along, across=across)
    assert distance_known(n, own(), PARAMS.max_position_std) is known
    assert not distance_known(n, None, PARAMS.max_position_std)


def test_a_neighbor_at_the_own_place_is_on_no_sphere() -> None:
    n = seen(0.0, (0.0, 0.0, 2.0), position_covariance=np.eye(3))
    assert not distance_known(n, own(), PARAMS.max_position_std)
    assert clear_of_sphere(n, seen(), own(), np.zeros(3), PARAMS) == []


def test_retreat_follows_line_of_loss_wherever_estimate_drifts() -> None:
    straight, = clear_of_sphere(ranged(0.0, 1.3, -0.4), seen(), own(), np.zeros(3), PARAMS)
    aside, = clear_of_sphere(ranged(0.0, 1.3, -0.4, np.array([0.6, 0.8, 0.0])), seen(), own(),
                             np.zeros(3), PARAMS)
    for found in (straight, aside):
        assert found.normal == pytest.approx(-AHEAD)
        assert found.distance == pytest.approx(1.3)
        assert found.seen and found.reason == SEPARATION
    assert aside.least == pytest.approx(straight.least)
    assert straight.least > 1.0
    elsewhere, = clear_of_sphere(ranged(0.0, 1.3, towards=np.array([0.0, 1.0, 0.0])), None, own(),
                                 np.zeros(3), PARAMS)
    assert elsewhere.normal == pytest.approx([0.0, -1.0, 0.0])
    assert not elsewhere.seen


@pytest.mark.parametrize(('age', 'sure'), [(0.0, True), (4.7, True), (4.8, False), (30.0, False)])
def test_fences_go_before_it_once_the_leader_may_have_come_round(age: float, sure: bool) -> None:
    """At 0.5 m/s it has come 2.36 m, to the side at 1.25 m, in 4.7 s."""
    found, = clear_of_sphere(ranged(0.0, 1.25), seen(-age), own(), np.zeros(3), PARAMS)
    assert found.seen is sure
    assert found.normal == pytest.approx(-AHEAD)


def test_uncertain_distance_counts_as_less_old_one_ever_less() -> None:
    def lowest(n: Neighbor) -> float:
        return clear_of_sphere(n, seen(), own(), np.zeros(3), PARAMS)[0].least

    sure, less = ranged(0.0, 1.5, along=0.0), ranged(0.0, 1.5 + 0.2 * DEVIATIONS, along=0.2)
    assert lowest(less) == pytest.approx(lowest(sure))
    ages = [lowest(ranged(-age, 2.0)) for age in (0.0, 0.4, 0.8, 1.2)]
    assert ages[0] < ages[1] < ages[2] < ages[3]


class Ranging(Follower):
    """A follower whose leader is ahead, at first in sight."""

    def __init__(self, distance: float = 1.8) -> None:
        super().__init__()
        self.leader, self.least = np.array([distance, 0.0, 2.0]), math.inf
        for _ in range(10):
            decision = self.tick(seen(self.now, self.leader))
        assert decision.state is State.TRACK

    def unseen(self, rate: float, ranges: bool = True) -> Decision:
        """Take a step while only the distance to the leader, which moves, is known, or nothing."""
        towards = self.leader - self.position
        towards = towards / np.linalg.norm(towards)
        decision = self.tick(*[seen(
            self.now, self.leader, rate * AHEAD, position_covariance=spread(0.05, 2.0, towards),
            velocity_covariance=spread(0.2, 2.0, towards))] * ranges)
        self.leader = self.leader + 0.1 * rate * AHEAD
        self.least = min(self.least, math.dist(self.leader, self.position))
        return decision


def test_neighbor_with_only_distance_known_is_not_followed() -> None:
    follower = Ranging()
    decisions = [follower.unseen(0.4) for _ in range(40)]
    assert decisions[-1].state is State.HOLD
    assert State.TRACK not in [decision.state for decision in decisions[7:]]
    assert not decisions[-1].rejected
    assert np.linalg.norm(follower.velocity) < 0.02
    assert abs(follower.position[0]) < 0.3  # it neither goes after it nor away from it


@pytest.mark.parametrize('distance', [1.3, 1.8, 2.6])
def test_one_that_comes_unseen_is_kept_at_its_distance(distance: float) -> None:
    with_ranges, without = Ranging(distance), Ranging(distance)
    for _ in range(50):
        with_ranges.unseen(-0.45)
        without.unseen(-0.45, ranges=False)
    assert with_ranges.least > 1.0
    assert with_ranges.least > without.least or without.least > 1.3
