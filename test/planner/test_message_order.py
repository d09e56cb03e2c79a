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

"""The order of the messages between two ticks has no influence: equal inputs give equal bits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from itertools import permutations
from typing import Any

from flown import own, seen, step
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.messages import OdometryState
from flock_follower.messages.accelerations import AccelerationState
from flock_follower.planner.inputs import Neighbor
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.memory import Memory
from flock_follower.planner.params import Member, PlannerParams, ROLES
from flock_follower.planner.scene import Decision

TICKS = 14
NAMES = 'abcde'
SEEDS = st.integers(0, 2**32 - 1)
Round = list[Neighbor]


def bits(value: Any) -> Any:
    """Return a value in a form that is equal only if all bits are; mappings keep their order."""
    match value:
        case np.ndarray():
            return value.shape, value.tobytes()
        case float():
            return value.hex()
        case Mapping():
            return [(key, bits(each)) for key, each in value.items()]
        case Set():
            return sorted(value)
        case tuple() | list():
            return [bits(each) for each in value]
    return value


def drawn(rng: np.random.Generator) -> tuple[PlannerParams, list[Round]]:
    """
    Return parameters, and the estimates of some neighbors before each tick.

    Stamps are equal, distances too: the places mirror each other. Some are lost, in one image or
    one after the other; some estimates jump, are uncertain, not finite, or contradict others.
    """
    count = int(rng.integers(1, len(NAMES) + 1))
    names = [NAMES[k] for k in rng.permutation(len(NAMES))[:count]]
    members = {name: Member(str(rng.choice(ROLES)), float(rng.choice([0.0, 0.2])))
               for name in names if rng.random() < 0.7}
    params = PlannerParams(vehicles=members, altitude_mode=str(rng.choice(['follow', 'hold'])))
    places = {name: np.array([rng.choice([1.3, 1.8, 2.4]), rng.choice([-1.0, 1.0]) * rng.choice(
        [0.4, 0.9]), 2.0 + rng.choice([-0.4, 0.0, 0.4])]) for name in names}
    velocities = {name: rng.choice([-0.3, 0.0, 0.3], 3) * [1.0, 1.0, 0.3] for name in names}
    together = int(rng.integers(3, TICKS))
    lost = {name: together if rng.random() < 0.7 else int(rng.integers(2, TICKS))
            for name in names}
    sources = {name: [[False], [True], [False, True]][rng.integers(3)] for name in names}
    rounds = []
    for tick in range(TICKS):
        estimates: Round = []
        for stamp in (0.1 * tick - 0.07, 0.1 * tick - 0.035):
            for name in names:
                if tick >= lost[name] and not (tick > lost[name] + 5 and rng.random() < 0.3):
                    continue
                estimates += [_estimate(name, stamp, places[name], velocities[name], received, rng)
                              for received in sources[name]
                              for _ in range(1 + int(rng.random() < 0.1))]
        rounds.append(estimates)
    return params, rounds


def _estimate(name: str, stamp: float, place: Any, velocity: Any, received: bool,
              rng: np.random.Generator) -> Neighbor:
    kind = rng.random()
    position = place + stamp * velocity + (1.5 if kind > 0.97 else 0.0)
    if kind < 0.02:
        position = position * np.nan
    std = np.diag([0.01, 0.6, 0.6]) if 0.9 < kind < 0.96 else 0.03 * np.eye(3)
    return seen(stamp, position, velocity + rng.choice([-0.05, 0.0, 0.05], 3), name,
                position_covariance=std @ std, velocity_covariance=0.01 * np.eye(3),
                acceleration=None if received else rng.choice([0.0, 0.4], 3),
                received=received)


def flown(params: PlannerParams, rounds: Sequence[Round], shuffle: np.random.Generator | None,
          relative: bool = False) -> list[Any]:
    """Return decisions and memories of a flight, with the estimates in some order."""
    memory, yaw, found = Memory(), 0.0, []
    position, velocity = np.array([0.0, 0.0, 2.0]), np.zeros(3)
    for tick, estimates in enumerate(rounds):
        now = 0.1 * tick
        order = range(len(estimates)) if shuffle is None else shuffle.permutation(len(estimates))
        me = own(now, position, velocity, yaw)._replace(relative=relative)
        memory, decision = step(memory, now, True, me, [estimates[k] for k in order], params,
                                ground=0.0)
        found.append((bits(decision), bits(memory)))
        if decision.acceleration is not None:
            velocity = velocity + 0.1 * decision.acceleration
            yaw = decision.yaw or 0.0
        position = position + 0.1 * velocity
    return found


@settings(max_examples=25)
@given(SEEDS, st.booleans())
def test_the_order_of_estimates_changes_no_bit(seed: int, relative: bool) -> None:
    rng = np.random.default_rng(seed)
    params, rounds = drawn(rng)
    first = flown(params, rounds, None, relative)
    for _ in range(2):
        assert flown(params, rounds, rng, relative) == first


def lost_together(order: Sequence[int], params: PlannerParams) -> Decision:
    """Return the last decision after two leaders were lost in one image."""
    both = [('left', (1.5, 1.0, 2.6)), ('right', (1.5, -1.0, 1.4))]
    memory, now = Memory(), 0.0
    for tick in range(12):
        now = 0.1 * tick
        estimates = [seen(now, place, name=name) for name, place in both] if tick < 3 else []
        memory, decision = step(memory, now, True, own(now), [
            estimates[k] for k in order[:len(estimates)]], params, ground=0.0)
    return decision


def test_two_lost_in_one_image_are_looked_for_alike_in_any_order() -> None:
    one, other = (lost_together(order, PlannerParams()) for order in ((0, 1), (1, 0)))
    assert bits(one) == bits(other)


@pytest.mark.parametrize('nearer', ['x', 'z'])
def test_of_two_lost_in_one_image_the_nearer_one_counts(nearer: str) -> None:
    memory, now = Memory(), 0.0
    for tick in range(16):
        now = 0.1 * tick
        estimates = [seen(now, (1.4 if name == nearer else 1.9, side, 2.0), name=name)
                     for name, side in (('x', 1.0), ('z', -1.0))] if tick < 3 else []
        memory, decision = step(memory, now, True, own(now), estimates, PlannerParams(),
                                ground=0.0)
    assert memory.lost is not None and memory.lost.name == nearer
    assert decision.yaw is not None and (decision.yaw > 0.0) == (nearer == 'x')


def state(name: str, stamp: int, position: Sequence[float], frame: str = 'odom') -> OdometryState:
    covariance = np.diag([1e-3] * 6)
    return OdometryState(stamp, frame, name, np.array(position), np.array([0.0, 0.0, 0.0, 1.0]),
                         np.zeros(3), np.zeros(3), covariance, covariance, np.eye(3))


def test_states_and_accelerations_may_come_in_any_order() -> None:
    """Each state gets the acceleration of its own image, whichever message comes first."""
    tick, image = 100_000_000, 33_000_000
    first = None
    for order in permutations(range(4)):
        loop = PlannerLoop(require_bridge=False)
        loop.engage(True)
        for now in (tick, 2 * tick):
            loop.take_odometry(state('base_link', now, (0.0, 0.0, 2.0)), now)
            stamps = now - 2 * image, now - image
            messages = [*(state('leader', stamp, (2.0, 0.0, 2.0)) for stamp in stamps),
                        *(AccelerationState(stamp, 'leader', np.array([1e-9 * stamp, 0.0, 0.0]))
                          for stamp in stamps)]
            for k in order:
                message = messages[k]
                if isinstance(message, AccelerationState):
                    loop.take_acceleration(message)
                else:
                    loop.take_neighbor(message)
            decision, command = loop.tick(now, PlannerParams())
        assert command is not None
        known = loop.memory.neighbors['leader'].acceleration
        assert known is not None and known[0] == pytest.approx(1e-9 * (2 * tick - image))
        first = first or bits((decision, loop.memory))
        assert bits((decision, loop.memory)) == first
