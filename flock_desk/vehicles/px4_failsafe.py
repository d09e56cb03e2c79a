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
What PX4 flies where it cannot fly the mode that somebody chose.

Measured on PX4 1.16, and as its source has it: each answer that cannot be flown gives way to the
next; sticks are not looked for. A pilot's modes without sticks then descend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

from flock_desk.vehicles.arming_checks import (
    Check,
    GLOBAL_POSITION,
    LOCAL_POSITION,
    may_run,
    OFFBOARD_SIGNAL,
)

OFFBOARD: Final[str] = 'OFFBOARD'
HOLD: Final[str] = 'AUTO.LOITER'
LAND: Final[str] = 'AUTO.LAND'
TAKEOFF: Final[str] = 'AUTO.TAKEOFF'
RETURN: Final[str] = 'AUTO.RTL'
STICK_MODES: Final[tuple[str, ...]] = ('MANUAL', 'POSCTL', 'ALTCTL', 'STABILIZED')
#: The answers in the order in which they give way, by the number that EVENTs have for them.
_ANSWERS: Final[Mapping[str, int]] = MappingProxyType({
    'POSCTL': 2, 'ALTCTL': 3, 'STABILIZED': 4, HOLD: 5, RETURN: 6, LAND: 7})
_DESCENT, _DISARMING, _TERMINATION = 8, 9, 10
#: COM_OBL_RC_ACT; what is not here is Position.
_LOSS_ACTIONS: Final[Mapping[int, str]] = MappingProxyType({
    1: 'ALTCTL', 2: 'STABILIZED', 3: RETURN, 4: LAND, 5: HOLD})
_TERMINATE, _DISARM = 6, 7


class Failsafe(NamedTuple):
    """What a failsafe does."""

    mode: str
    number: int
    disarms: bool = False

    @property
    def event(self) -> str:
        """Return what the name of its event ends in."""
        disengaged = self.number in (_ANSWERS['ALTCTL'], _ANSWERS['STABILIZED'], _DESCENT)
        return 'autopilot_disengaged' if disengaged else 'generic'


def failsafe(chosen: str, failing: Sequence[Check], loss_action: int) -> Failsafe | None:
    """
    Return what an armed vehicle does instead of a mode, None where that can be flown.

    :param loss_action: COM_OBL_RC_ACT.
    """
    estimate = [check for check in failing if check in (LOCAL_POSITION, GLOBAL_POSITION)]
    if chosen == OFFBOARD and OFFBOARD_SIGNAL in failing:
        if loss_action in (_TERMINATE, _DISARM):
            return Failsafe(LAND, _TERMINATION if loss_action == _TERMINATE else _DISARMING,
                            disarms=True)
        first = _LOSS_ACTIONS.get(loss_action, 'POSCTL')
    elif may_run(estimate, chosen):
        return None
    elif chosen == 'POSCTL':
        first = 'ALTCTL'
    else:
        first = RETURN
    names = list(_ANSWERS)
    possible = [name for name in names[names.index(first):] if may_run(estimate, name)]
    return Failsafe(possible[0], _ANSWERS[possible[0]]) if possible else Failsafe(LAND, _DESCENT)
