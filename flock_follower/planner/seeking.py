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

"""
A leader that left the view while others still tell where they are: look for it.

Whoever is heard of needs no watching, and nobody but its own eyes will find a leader that has no
radio. So whoever saw it last looks where it was, to both sides, then all round, and meanwhile
stays with the others by what they tell, and keeps clear of where the leader may be as it would
alone. It turned to one of them otherwise, and the whole flock hovered without a leader that had
been hidden for seconds.

Who of the flock is neither seen nor heard of, said in words: nothing keeps clear of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from flock_follower.planner.inputs import at, NeighborEstimate, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.neighborhood import Neighborhood, role
from flock_follower.planner.params import AVOID, LEADER, PlannerParams
from flock_follower.planner.vertical_yaw import facing, searching


class LostLeader(NamedTuple):
    """A leader that left the view, and is looked for."""

    last: NeighborEstimate
    """What was known of it last."""
    age: float
    """How long ago, s."""

    @property
    def said(self) -> str:
        """Return it in words."""
        return f'looks for {self.last.name}, not known of for {self.age:.1f} s'

    def expected(self, params: PlannerParams) -> NeighborEstimate:
        """Return where it is by now, or was after ``coast_timeout``: beyond is a guess."""
        return at(self.last, self.last.stamp + min(self.age, params.coast_timeout))


def sought(memory: Memory, hood: Neighborhood, me: OwnState,
           params: PlannerParams) -> LostLeader | None:
    """
    Return the leader to look for, up to ``resume_timeout`` after it was known of last.

    It begins within ``coast_timeout``, where everyone else is only heard of: who has another one
    in view stays with that. It ends where a leader is at hand again, seen or heard of.
    """
    last = memory.leader
    if last is None or _leaders(hood, params):
        return None
    age = me.stamp - last.stamp
    if not memory.looking and (age > params.coast_timeout
                               or any(not n.heard for n in hood.flock)):
        return None
    return LostLeader(last, age) if age <= params.resume_timeout else None


def last_known(memory: Memory, hood: Neighborhood,
               params: PlannerParams) -> NeighborEstimate | None:
    """Return the newest of a leader that it has once faced with its own eyes."""
    guide = hood.guide
    if guide is not None and not guide.heard and role(guide, params) == LEADER:
        return guide
    if memory.leader is None:
        return None
    return next((n for n in _leaders(hood, params) if n.name == memory.leader.name), memory.leader)


def looking(last: float, lost: LostLeader, me: OwnState, params: PlannerParams,
            elapsed: float) -> float:
    """Return the yaw that turns after whom it looks for, and then looks round."""
    there = lost.expected(params)
    if lost.age <= params.coast_timeout:
        return facing(last, me, there, params, elapsed)
    x, y, _ = there.position - me.position
    return searching(last, math.atan2(y, x), lost.age - params.coast_timeout, params, elapsed)


def _leaders(hood: Neighborhood, params: PlannerParams) -> list[NeighborEstimate]:
    return [n for n in hood.flock if role(n, params) == LEADER]


def unknown(memory: Memory, hood: Neighborhood, me: OwnState,
            params: PlannerParams) -> tuple[str, ...]:
    """
    Return that somebody who flies along is not known of, while others are; () where all are.

    Who flies along is told beforehand, or was known in this flight up to ``resume_timeout`` ago.
    """
    missing = {name for name, who in params.vehicles.items() if who.role != AVOID}
    missing.update(name for name, n in memory.met.items()
                   if me.stamp - n.stamp <= params.resume_timeout)
    missing -= memory.flock.keys()  # with those lost a moment ago
    if not missing:
        return ()
    help_wanted = '' if any(n.heard for n in hood.flock) else (
        ': not a formation for what its cameras see; more of them, or words, would help')
    return (f'{", ".join(sorted(missing))} neither seen nor heard of, and not kept clear of'
            f'{help_wanted}',)
