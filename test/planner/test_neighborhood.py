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

"""Neighbor selection: the edges of one vehicle, and the neighbor that it faces."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.flock.neighbor_graph import HELD_FACTOR
from flock_follower.geometry import Array
from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.neighborhood import build_neighborhood, edges
from flock_follower.planner.params import AVOID, FOLLOWER, LEADER, Member, PlannerParams

PARAMS = PlannerParams()


def own(position: Sequence[float] | Array = (0.0, 0.0, 0.0)) -> OwnState:
    return OwnState(0.0, np.array(position), np.zeros(3), 0.0)


def at(name: str, *position: float, received: bool = False, role: str = '',
       radius: float = 0.0) -> Neighbor:
    role = role or (FOLLOWER if received else LEADER)
    return Neighbor(name, 0.0, np.array(position), np.zeros(3), received=received,
                    member=Member(role, radius))


def chosen(places: Array, held: Sequence[set[str]] | None = None) -> list[set[str]]:
    """Return the edges of every vehicle, by the others' indices as names."""
    flock = [at(str(k), *place) for k, place in enumerate(places)]
    return [edges(held[k] if held else set(), own(place), [*flock[:k], *flock[k + 1:]], PARAMS)
            for k, place in enumerate(places)]


def connected(joined: list[set[str]]) -> bool:
    """Return whether edges lead from the first vehicle to every other."""
    reached, news = {0}, {0}
    while news := {int(name) for k in news for name in joined[k]} - reached:
        reached |= news
    return len(reached) == len(joined)


def mutual(joined: list[set[str]]) -> bool:
    return all(str(k) in joined[int(name)] for k, names in enumerate(joined) for name in names)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2 ** 32), st.integers(2, 25), st.booleans())
def test_the_graph_is_connected_and_mutual_where_all_is_known(seed: int, count: int,
                                                              flat: bool) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-5.0, 5.0, (count, 3)) * ([1.0, 1.0, 0.0] if flat else 1.0)
    joined = chosen(places)
    assert connected(joined) and mutual(joined)
    # And so it stays as they move and keep what they have.
    for _ in range(3):
        places = places + rng.normal(0.0, 0.5, places.shape)
        joined = chosen(places, joined)
        assert connected(joined) and mutual(joined)


@pytest.mark.parametrize(('nearer', 'kept'), [(1.0, True), (HELD_FACTOR - 0.01, True),
                                              (HELD_FACTOR + 0.01, False)])
def test_an_edge_goes_when_another_is_clearly_nearer_to_both(nearer: float, kept: bool) -> None:
    far = at('far', 3.0, 0.0, 0.0)
    between = at('between', 1.5, ((3.0 / nearer) ** 2 - 2.25) ** 0.5, 0.0)
    assert ('far' in edges({'far'}, own(), [far, between], PARAMS)) == kept
    assert ('far' in edges(set(), own(), [far, between], PARAMS)) == (nearer == 1.0)


def test_only_leader_in_sight_keeps_edge_whatever_is_received() -> None:
    leader = at('leader', 3.0, 0.0, 0.0)
    between = at('follower_2', 1.5, 0.0, 0.0, received=True)
    assert edges(set(), own(), [leader, between], PARAMS) == {'leader', 'follower_2'}
    other = at('follower_3', -2.0, 0.0, 0.0, role=FOLLOWER)
    assert edges(set(), own(), [leader, between, other], PARAMS) == {'follower_2', 'follower_3'}


@pytest.mark.parametrize(('distance', 'held', 'kept'), [
    (2.8, 'between', True), (2.9, 'between', False), (2.9, 'leader', True)])
def test_no_edge_to_only_leader_in_sight_begins_beyond_band(
        distance: float, held: str, kept: bool) -> None:
    flock = [at('between', 0.5 * distance, 0.0, 0.0, received=True), at('leader', distance, 0, 0)]
    assert ('leader' in edges({held}, own(), flock, PARAMS)) is kept


def test_one_to_avoid_has_no_edge_and_removes_none() -> None:
    flock = [at('leader', 3.0, 0.0, 0.0), at('stranger', 1.5, 0.0, 0.0, role=AVOID)]
    assert edges(set(), own(), flock, PARAMS) == {'leader'}
    neighbors = build_neighborhood(Memory(), own(), flock, PARAMS, 0.1)
    assert neighbors.faced is neighbors.level is neighbors.flock[0]


@pytest.mark.parametrize(('before', 'expected'), [('', 'b'), ('a', 'a'), ('b', 'b')])
def test_the_faced_neighbor_changes_for_one_clearly_nearer(before: str, expected: str) -> None:
    a, b, near = at('a', 2.0, 0.0, 0.0), at('b', 0.0, 1.9, 0.0), at('c', -1.5, 0.0, 0.0)
    for flock, found in (([a, b], expected), ([a, b, near], 'c')):
        faced = build_neighborhood(Memory(faced=before), own(), flock, PARAMS, 0.1).faced
        assert faced is not None and faced.name == found


def test_column_member_faces_follower_ahead_not_leader_beyond() -> None:
    flock = [at('ahead', 1.8, 0.0, 0.0, role=FOLLOWER), at('leader', 3.0, 1.0, 0.0)]
    faced = build_neighborhood(Memory(), own(), flock, PARAMS, 0.1).faced
    assert faced is not None and faced.name == 'ahead'


def test_an_edge_comes_and_goes_over_the_time_of_a_handover() -> None:
    def after(memory: Memory, *flock: Neighbor) -> Memory:
        found = build_neighborhood(memory, own(), flock, PARAMS, 0.1)
        return Memory(shares=found.shares, edges=found.edges)

    a, b, c = at('a', 2.0, 0.0, 0.0), at('b', 0.0, 2.0, 0.0), at('c', -2.0, 0.0, 0.0)
    memory, shares = after(Memory(), a, b), []
    assert memory == Memory(shares={'a': 1.0, 'b': 1.0}, edges=frozenset('ab'))
    for _ in range(6):
        memory = after(memory, a, b, c)
        shares.append(memory.shares['c'])
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0, 1.0])
    assert after(memory, a) == Memory(shares={'a': 1.0}, edges=frozenset('a'))
