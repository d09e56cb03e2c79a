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

"""Received states of neighbors, used without a sighting, and the search for a lost leader."""

from __future__ import annotations

from dataclasses import replace
import math

from flown import commanded, Follower, own, PARAMS, seen, step, STILL
import numpy as np
from numpy.typing import ArrayLike
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.inputs import Neighbor
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import Member, PlannerParams
from flock_follower.planner.scene import Decision


def reported(stamp: float, x: float = 2.0, received: bool = True, name: str = 'leader',
             variance: float = 0.0, speed: float = 0.0) -> Neighbor:
    return seen(stamp, (x, 0.0, 2.0), (speed, 0.0, 0.0), name,
                position_covariance=variance * np.eye(3), received=received)


def decide(memory: Memory, now: float, *neighbors: Neighbor,
           params: PlannerParams = PARAMS) -> tuple[Memory, Decision]:
    return step(memory, now, True, own(now), neighbors, params)


def place(memory: Memory, name: str = 'leader') -> float:
    return float(memory.neighbors[name].position[0])


def test_a_fresh_sighting_is_never_replaced_by_a_received_state() -> None:
    memory, _ = decide(Memory(), 0.0, reported(0.0, 2.0, received=False))
    memory, decision = decide(memory, 0.3, reported(0.3, 2.4))
    assert place(memory) == 2.0 and decision.rejected == ()
    memory, decision = decide(memory, 0.51, reported(0.5, 2.4))
    assert place(memory) == 2.4 and decision.state is State.TRACK


@pytest.mark.parametrize('x', [2.1, 4.0])  # a little, and a jump
def test_sighting_replaces_received_state_even_a_newer_one(x: float) -> None:
    memory, _ = decide(Memory(), 0.1, reported(0.1, 2.0))
    memory, decision = decide(memory, 0.2, reported(0.05, x, received=False))
    assert place(memory) == x and decision.rejected == ()
    assert set(memory.flock) == {'leader'}  # none at the place that was only received


def test_received_states_are_used_up_to_an_age_of_their_own() -> None:
    memory, states = Memory(), []
    for tick in range(14):
        memory, decision = decide(memory, 0.1 * tick, *([reported(0.0)] if tick == 0 else []))
        states.append(decision.state)
    assert states == [State.TRACK] * 11 + [State.COAST] * 3
    late = decide(Memory(), 1.2, reported(0.1))[1]
    assert late.state is State.SEARCH
    assert [r.reason for r in late.rejected] == ['received estimate too old']


def command(variance: float) -> Array:
    decision = decide(Memory(), 0.0, reported(0.0, 1.6, variance=variance, speed=-0.1))[1]
    assert decision.acceleration is not None
    return decision.acceleration


def test_uncertain_received_state_keeps_it_farther_away() -> None:
    pushed = [command(variance)[0] for variance in (0.0, 0.02, 0.04, 0.08)]
    assert pushed[0] > -0.3
    assert np.all(np.diff(pushed[:3]) < 0.0) and max(pushed[2:]) < -1.0
    refused = decide(Memory(), 0.0, reported(0.0, variance=0.09))[1]
    assert [r.reason for r in refused.rejected] == ['received estimate too uncertain']


def test_one_in_sight_comes_before_a_nearer_received_one() -> None:
    ahead, behind = seen(0.0, (1.1, 0.0, 2.0), (-0.2, 0.0, 0.0)), (-1.0, 0.0, 2.0)
    for received in (True, False):
        decision = decide(Memory(), 0.0, ahead, seen(0.0, behind, name='B', received=received))[1]
        assert (commanded(decision)[0] < -0.3) == received  # else the nearer one is first


FLOCK = PlannerParams(resume_timeout=12.0, vehicles={
    'leader': Member(), 'behind': Member('follower'), 'ahead': Member('follower')})
PLACES = {'leader': (2.0, 0.0, 2.0), 'behind': (-1.9, 0.0, 2.0), 'ahead': (2.0, 0.0, 2.0)}


def fly(seconds: float, in_sight: str, received: str, follower: Follower | None = None
        ) -> tuple[Follower, list[Decision]]:
    """Hover with those seen and received around, the nose where it is commanded to be."""
    follower, decisions = follower or Follower(FLOCK), []
    for _ in range(round(seconds / 0.1)):
        follower.position, follower.velocity = np.array([0.0, 0.0, 2.0]), np.zeros(3)
        decisions.append(follower.tick(*(
            seen(follower.now, PLACES[name], name=name, received=name in received.split())
            for name in (*in_sight.split(), *received.split()))))
    return follower, decisions


def test_after_resume_timeout_it_turns_to_the_one_received() -> None:
    follower, _ = fly(1.0, 'leader', 'behind')
    follower, decisions = fly(FLOCK.resume_timeout + 8.0, '', 'behind', follower)
    assert abs(decisions[-1].yaw or 0.0) == pytest.approx(np.pi, abs=0.05)
    assert not any('looks for' in warning for warning in decisions[-1].warnings)


def test_received_leader_is_searched_if_no_neighbor_is_in_view() -> None:
    follower, _ = fly(1.0, 'ahead', 'leader behind')
    follower, _ = fly(3.0, 'ahead', 'behind', follower)
    assert not follower.memory.looking  # it stays with the one ahead
    follower, decisions = fly(3.0, '', 'behind', follower)
    assert follower.memory.looking and abs(decisions[-1].yaw or 0.0) < 2.0


@pytest.mark.parametrize(('in_sight', 'received', 'then_seen', 'then_received'), [
    ('leader behind', '', 'behind', ''),  # another one is in view: it stays with that
    ('leader', 'behind', '', 'leader behind'),  # it is received
    ('ahead', 'behind', '', 'behind')])  # no leader was known
def test_it_does_not_look_for(in_sight: str, received: str, then_seen: str,
                              then_received: str) -> None:
    follower, _ = fly(1.0, in_sight, received)
    follower, decisions = fly(3.0, then_seen, then_received, follower)
    assert not follower.memory.looking
    assert not any('looks for' in warning for d in decisions for warning in d.warnings)


def beside_silent(place: ArrayLike, velocity: ArrayLike = STILL, variance: float = 0.0,
                  ahead: ArrayLike = (2.0, 0.0, 2.0)) -> Array:
    """Return the command beside a follower that was received for the last time 1.2 s ago."""
    memory, _ = decide(Memory(), 0.0, seen(0.0, ahead))
    silent = seen(0.0, place, velocity, 'behind', position_covariance=variance * np.eye(3),
                  received=True, member=Member('follower'))
    memory = memory._replace(flock={**memory.flock, 'behind': silent})
    return commanded(decide(memory, 1.2, seen(1.2, ahead))[1])


def test_silent_follower_hovers_where_its_stop_ends() -> None:
    place, velocity = np.array([-1.5, -0.2, 2.0]), np.array([0.6, 0.3, -0.2])
    speed = float(np.linalg.norm(velocity))
    stop = place + (0.5 + 0.5 * speed / (0.6 * PARAMS.a_max)) * velocity
    assert beside_silent(place, velocity) == pytest.approx(beside_silent(stop))
    assert beside_silent(place)[0] < beside_silent(stop)[0]
    # Where it was is known up to two standard deviations.
    assert beside_silent((-1.4, 0.0, 2.0), STILL, 0.01) == pytest.approx(
        beside_silent((-1.2, 0.0, 2.0)))


@pytest.mark.parametrize('angle', [0.7, 1.6, 2.5, -0.4])
def test_silent_follower_is_passed_alike_in_every_direction(angle: float) -> None:
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    places = np.array([-1.2, 0.1, 2.0]), np.array([2.0, 0.0, 2.0])
    first = beside_silent(places[0], ahead=places[1])
    there, ahead = (turned @ place for place in places)
    assert beside_silent(there, ahead=ahead) == pytest.approx(turned @ first, abs=1e-6)
    assert first[1] > 0.1  # beside it


def test_pushed_back_it_passes_beside_silent_follower() -> None:
    """The computer of the one behind failed 4 s before the leader comes back."""
    follower = Follower(replace(PARAMS, v_max=1.0), 0.2)
    behind, leader = np.array([-1.8, 0.0, 2.0]), np.array([2.0, 0.0, 2.0])
    nearest = math.inf
    for tick in range(140):
        coming = -0.5 if tick >= 50 else 0.0
        leader = leader + 0.1 * coming * np.array([1.0, 0.0, 0.0])
        told = [seen(follower.now, behind, name='behind', received=True)] if tick < 10 else []
        follower.tick(seen(follower.now, leader, (coming, 0.0, 0.0)), *told)
        nearest = min(nearest, math.dist(follower.position, behind))
        assert math.dist(follower.position, leader) > 0.9
    assert nearest > 0.9 and follower.position[0] < -3.0
