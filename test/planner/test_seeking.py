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

"""A leader that leaves the view while others still talk is looked for."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.params import Member, PlannerParams
from flock_follower.planner.step import Decision, step

PARAMS = PlannerParams(resume_timeout=12.0, vehicles={
    'leader': Member(), 'behind': Member('follower'), 'ahead': Member('follower')})
PLACES = {'leader': (2.0, 0.0, 2.0), 'behind': (-1.9, 0.0, 2.0), 'ahead': (2.0, 0.0, 2.0)}


def fly(seconds: float, seen: str, heard: str, memory: Memory | None = None
        ) -> tuple[Memory, list[Decision]]:
    """Hover with those seen and heard around, the nose where it is commanded to be."""
    memory, decisions = memory or Memory(), []
    for _ in range(round(seconds / 0.1)):
        now = 0.0 if memory.now is None else memory.now + 0.1
        yaw = 0.0 if memory.yaw is None else memory.yaw
        memory, decision = step(
            memory, now, True, OwnState(now, np.array([0.0, 0.0, 2.0]), np.zeros(3), yaw),
            [Neighbor(name, now, np.array(PLACES[name]), np.zeros(3),
                              heard=name in heard.split())
             for name in (*seen.split(), *heard.split())], PARAMS)
        decisions.append(decision)
    return memory, decisions


def test_it_looks_where_the_leader_was_then_to_both_sides_then_all_round() -> None:
    memory, _ = fly(1.0, 'leader', 'behind')
    memory, there = fly(2.0, '', 'behind', memory)
    assert max(abs(d.yaw or 0.0) for d in there) < 0.1
    memory, round_about = fly(9.0, '', 'behind', memory)
    yaws = np.unwrap([d.yaw for d in round_about])
    assert yaws.max() > 0.7 and yaws.min() < -1.5
    assert all(d.state.value == 'TRACK' for d in there + round_about)
    assert any(w.startswith('looks for leader, not known of for 1.') for w in there[-1].warnings)


def test_after_resume_timeout_it_turns_to_whom_it_hears_of() -> None:
    memory, _ = fly(1.0, 'leader', 'behind')
    memory, decisions = fly(PARAMS.resume_timeout + 8.0, '', 'behind', memory)
    assert abs(decisions[-1].yaw or 0.0) == pytest.approx(np.pi, abs=0.05)
    assert not any('looks for' in warning for warning in decisions[-1].warnings)


def test_one_that_comes_into_view_meanwhile_does_not_end_it() -> None:
    memory, _ = fly(1.0, 'leader', 'behind')
    memory, _ = fly(3.0, '', 'behind', memory)
    memory, _ = fly(1.0, 'behind', '', memory)
    assert memory.looking
    memory, decisions = fly(4.0, 'leader', 'behind', memory)
    assert not memory.looking and abs(decisions[-1].yaw or 0.0) < 0.05


@pytest.mark.parametrize(('seen', 'heard', 'then_seen', 'then_heard'), [
    ('leader behind', '', 'behind', ''),  # another one is in view: it stays with that
    ('leader', 'behind', '', 'leader behind'),  # it is heard of
    ('ahead', 'behind', '', 'behind'),  # whoever talks will be heard of again
    ('', 'leader behind', '', 'behind')])  # never seen: others know better where it was
def test_it_does_not_look_for(seen: str, heard: str, then_seen: str, then_heard: str) -> None:
    memory, _ = fly(1.0, seen, heard)
    memory, decisions = fly(3.0, then_seen, then_heard, memory)
    assert not memory.looking
    assert not any('looks for' in warning for d in decisions for warning in d.warnings)
