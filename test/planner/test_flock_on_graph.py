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
    kept(Flight(starts, replace(PARAMS, guard=guard)).fly())


@pytest.mark.slow
@pytest.mark.parametrize('starts', [grid(12), wedge(12)], ids=['grid', 'wedge'])
def test_twelve_followers_keep_their_distances(starts: Array) -> None:
    kept(Flight(starts).fly())
