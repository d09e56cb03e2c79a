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

from flown import Follower, seen
import numpy as np
import pytest

from flock_follower.planner.params import Member, PlannerParams
from flock_follower.planner.step import Decision

PARAMS = PlannerParams(resume_timeout=12.0, vehicles={
    'leader': Member(), 'behind': Member('follower'), 'ahead': Member('follower')})
PLACES = {'leader': (2.0, 0.0, 2.0), 'behind': (-1.9, 0.0, 2.0), 'ahead': (2.0, 0.0, 2.0)}


def fly(seconds: float, in_sight: str, received: str, follower: Follower | None = None
        ) -> tuple[Follower, list[Decision]]:
    """Hover with those seen and heard around, the nose where it is commanded to be."""
    follower, decisions = follower or Follower(PARAMS), []
    for _ in range(round(seconds / 0.1)):
        follower.position, follower.velocity = np.array([0.0, 0.0, 2.0]), np.zeros(3)
        decisions.append(follower.tick(*(
            seen(follower.now, PLACES[name], name=name, received=name in received.split())
            for name in (*in_sight.split(), *received.split()))))
    return follower, decisions


def test_after_resume_timeout_it_turns_to_whom_it_hears_of() -> None:
    follower, _ = fly(1.0, 'leader', 'behind')
    follower, decisions = fly(PARAMS.resume_timeout + 8.0, '', 'behind', follower)
    assert abs(decisions[-1].yaw or 0.0) == pytest.approx(np.pi, abs=0.05)
    assert not any('looks for' in warning for warning in decisions[-1].warnings)


def test_it_looks_for_a_leader_that_it_only_received_if_nobody_is_in_view() -> None:
    follower, _ = fly(1.0, 'ahead', 'leader behind')
    follower, _ = fly(3.0, 'ahead', 'behind', follower)
    assert not follower.memory.looking  # it stays with the one ahead
    follower, decisions = fly(3.0, '', 'behind', follower)
    assert follower.memory.looking and abs(decisions[-1].yaw or 0.0) < 2.0


@pytest.mark.parametrize(('in_sight', 'received', 'then_seen', 'then_received'), [
    ('leader behind', '', 'behind', ''),  # another one is in view: it stays with that
    ('leader', 'behind', '', 'leader behind'),  # it is heard of
    ('ahead', 'behind', '', 'behind')])  # no leader was known
def test_it_does_not_look_for(in_sight: str, received: str, then_seen: str,
                              then_received: str) -> None:
    follower, _ = fly(1.0, in_sight, received)
    follower, decisions = fly(3.0, then_seen, then_received, follower)
    assert not follower.memory.looking
    assert not any('looks for' in warning for d in decisions for warning in d.warnings)
