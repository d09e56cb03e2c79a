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

"""Who of the flock is neither seen nor heard of, said in words: nothing keeps clear of them."""

from __future__ import annotations

from flock_follower.planner.inputs import OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.neighborhood import Neighborhood
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.roles import AVOID


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
