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

"""Flocks of followers that each plan for themselves, flown as points: near, and not too near."""

from __future__ import annotations

from dataclasses import replace

from flock_flight import Flight, Flown, grid, line, ring, wedge
import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.params import PlannerParams

PARAMS = PlannerParams()
NEAREST = 0.9  # m


def kept(flown: Flown, in_band: float = 0.98) -> None:
    assert flown.nearest >= NEAREST
    assert flown.in_band >= in_band
    assert flown.tracked == 1.0


@pytest.mark.parametrize('starts', [line(4), wedge(4), ring(4)], ids=['line', 'wedge', 'ring'])
@pytest.mark.parametrize('guard', [True, False], ids=['guard', 'law'])
def test_four_followers_keep_their_distances(starts: Array, guard: bool) -> None:
    flown = Flight(starts, replace(PARAMS, guard=guard)).fly()
    kept(flown)
    assert flown.changes <= 6  # of about ten edges, in 20 s of noise


def test_where_one_is_gone_the_others_close_up() -> None:
    flown = Flight(line(4), duration=30.0, gone={2: 5.0}).fly()
    kept(flown, 0.8)  # while they close the gap that is as long as two
    assert set(flown.decisions[-1][3].edges) == {'follower_1', 'follower_4'}
    gap = flown.positions[-1][1] - flown.positions[-1][3]
    assert np.linalg.norm(gap) < PARAMS.law.d1 ** 0.5


def test_four_that_hear_all_and_see_only_the_leader_keep_their_distances() -> None:
    flown = Flight(ring(4), telling=lambda _, other, __: other == 0, duration=10.0).fly()
    kept(flown)
    known = flown.decisions[-1][1].known
    assert [each.seen for each in known] == [False] * 3 + [True]


def test_followers_that_start_too_far_apart_gather_and_nobody_comes_too_near() -> None:
    starts = np.array([[-4.0, 0.0, 0.0], [-4.0, 4.0, 0.0], [0.0, 4.5, 0.0]])
    flown = Flight(starts, replace(PARAMS, v_max=1.0), duration=15.0).fly()
    assert flown.nearest >= NEAREST and flown.tracked == 1.0
    last = flown.positions[-1]
    for i, decision in flown.decisions[-1].items():
        for name in decision.edges:
            j = 0 if name == 'leader' else int(name[-1])
            assert np.linalg.norm(last[i] - last[j]) < PARAMS.law.d1 ** 0.5


@pytest.mark.slow
@pytest.mark.parametrize('guard', [True, False], ids=['guard', 'law'])
@pytest.mark.parametrize('starts', [grid(12), wedge(12)], ids=['grid', 'wedge'])
def test_twelve_followers_keep_their_distances(starts: Array, guard: bool) -> None:
    kept(Flight(starts, replace(PARAMS, guard=guard), duration=15.0).fly())
