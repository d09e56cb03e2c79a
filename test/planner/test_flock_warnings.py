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

"""That somebody of the flock is known neither by sight nor by word is said."""

from __future__ import annotations

import numpy as np

from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.params import Member, PlannerParams
from flock_follower.planner.step import step

FOUR = {'leader': Member(), 'a': Member('follower'), 'b': Member('follower'),
        'tower': Member('avoid')}
PARAMS = PlannerParams(vehicles=FOUR)
NOT_KEPT_CLEAR = ' neither seen nor received, not kept clear of'
CAMERA = ': more cameras or flock messages are needed for this formation'
PLACES = {'leader': (2.0, 0.0, 2.0), 'a': (1.0, 1.8, 2.0), 'b': (0.0, -2.1, 2.0)}


def reported(memory: Memory, now: float, seen: str = '', received: str = '',
         params: PlannerParams = PARAMS) -> tuple[Memory, tuple[str, ...]]:
    """Take one step with those seen and heard, by their first letters."""
    estimates = [Neighbor(name, now, np.array(place), np.zeros(3), received=name[0] in received)
                 for name, place in PLACES.items() if name[0] in seen + received]
    memory, decision = step(memory, now, True, OwnState(now, np.array([0.0, 0.0, 2.0]),
                                                        np.zeros(3), 0.0), estimates, params)
    return memory, decision.warnings


def test_who_flies_along_and_is_known_of_by_nothing_is_told() -> None:
    assert reported(Memory(), 0.0, seen='lab')[1] == ()
    assert reported(Memory(), 0.0, seen='l', received='ab')[1] == ()
    assert reported(Memory(), 0.0, seen='l')[1] == ('a, b' + NOT_KEPT_CLEAR + CAMERA,)
    assert reported(Memory(), 0.0, seen='l', received='a')[1] == ('b' + NOT_KEPT_CLEAR,)


def test_who_was_there_is_missed_once_it_is_not_kept_clear_of_any_more() -> None:
    params = PlannerParams(resume_timeout=5.0)
    memory, _ = reported(Memory(), 0.0, seen='la', params=params)
    missed = []
    for tick in range(1, 70):
        memory, warnings = reported(memory, 0.1 * tick, seen='l', params=params)
        missed.append('a' + NOT_KEPT_CLEAR + CAMERA in warnings)
    assert missed == [False] * 20 + [True] * 30 + [False] * 19
