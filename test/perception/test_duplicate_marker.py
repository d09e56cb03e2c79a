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


@pytest.mark.parametrize('seed', [0, 1])
def test_a_print_on_a_wall_is_not_taken_for_a_hidden_leader(seed: int) -> None:
    frames = list(DuplicateFlight(seed).frames())
    assert wrong(frames) == []
    found = [frame.time for frame in frames if 'leader' in frame.sighting.estimates]
    assert [time for time in found if HIDDEN <= time < BACK] == []
    assert min(time for time in found if time >= BACK) <= BACK + 1.0
    assert len([time for time in found if time >= BACK + 1.0]) > 20
