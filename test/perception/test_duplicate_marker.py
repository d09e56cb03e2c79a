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

"""A second print of the leader's marker: which of the two the leader is."""

from __future__ import annotations

from duplicate_flight import BACK, DuplicateFlight, HIDDEN, wrong
import pytest


@pytest.mark.parametrize('seed', [2, 3])
def test_a_print_that_comes_into_view_while_the_leader_is_hidden_gives_way_when_it_is_back(
        seed: int) -> None:
    frames = list(DuplicateFlight(seed, appears=HIDDEN + 1.0).frames())
    assert [time for time in wrong(frames) if time >= BACK + 1.0] == []
    found = [frame for frame in frames if 'leader' in frame.sighting.estimates]
    assert len([frame for frame in found if frame.time >= BACK + 1.0]) > 20


@pytest.mark.parametrize('seed', [0, 1])
def test_a_print_on_a_wall_is_not_taken_for_a_hidden_leader(seed: int) -> None:
    frames = list(DuplicateFlight(seed).frames())
    assert wrong(frames) == []
    found = [frame.time for frame in frames if 'leader' in frame.sighting.estimates]
    assert [time for time in found if HIDDEN <= time < BACK] == []
    assert min(time for time in found if time >= BACK) <= BACK + 1.0
    assert len([time for time in found if time >= BACK + 1.0]) > 20
