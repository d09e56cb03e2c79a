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
What the bridge reports to other nodes and programs, and how they read it.

``mavlink_bridge/state`` reports whether the vehicle flies the planner's commands. Its text is a
state and, after a colon, the reason::

    NO_AUTOPILOT: none received yet
    INACTIVE: offboard was not requested
    READY: waiting for offboard mode
    ACTIVE
    TAKEN_OVER: offboard was left for POSCTL

The bridge publishes its state at each change, and at 2 Hz, because the latched topic would show
``ACTIVE`` after the end of a bridge. The values of its diagnostics are texts with the keys below.
Only this module reads these texts: other code calls ``parse`` and ``read_flag``. No function reads
a clock.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Final, NamedTuple

NO_AUTOPILOT, INACTIVE, READY, ACTIVE, TAKEN_OVER = BRIDGE_STATES = (
    'NO_AUTOPILOT', 'INACTIVE', 'READY', 'ACTIVE', 'TAKEN_OVER')
TOPIC = 'mavlink_bridge/state'
#: Where the vehicle was armed, in the frame of the odometry; latched.
ARMED_AT_TOPIC = 'mavlink_bridge/armed_at'
# Keys of the diagnostics of the bridge, which writes them; ``check`` and ``follow`` read them.
PARAMETER: Final = 'parameter '
MISSING: Final = 'missing parameter '
UNPROVEN: Final = 'unproven firmware'
NOT_READY: Final = 'not ready to arm'
UNREAD: Final = 'parameters unread'
#: That the autopilot answers nothing, or ''; the questions that have no answer.
NO_ANSWERS: Final = 'no answers'
UNANSWERED: Final = 'unanswered questions'
REFUSED: Final = 'offboard would be refused'
LINK_FAULT: Final = 'link fault'

ARMED: Final = 'armed'
#: Whether the autopilot reports that the vehicle is in the air.
FLYING: Final = 'flying'

SILENCE_MAX = 1.0  # s: two of the bridge's repetitions may get lost
#: Begins the reason after an autopilot was received; the state before follows.
LOST: Final = 'lost, '
_LONGEST_REASON = 200  # characters


class BridgeState(NamedTuple):
    """One of ``BRIDGE_STATES``, and the reason for it."""

    name: str
    reason: str = ''

    @property
    def last_known(self) -> BridgeState:
        """Return the state; if the autopilot is lost, the state before the loss."""
        lost = self.name == NO_AUTOPILOT and self.reason.startswith(LOST)
        return parse(self.reason.removeprefix(LOST)) if lost else self

    def __str__(self) -> str:
        return f'{self.name}: {self.reason}' if self.reason else self.name


def read_flag(values: Mapping[str, str], key: str) -> bool | None:
    """Return a value of the diagnostics as True or False; None if the value is unknown."""
    return {'True': True, 'False': False}.get(values.get(key, ''))


def parse(text: str) -> BridgeState:
    """Return the state in a message; an unknown or missing state counts as ``INACTIVE``."""
    name = ''.join(text.split()[:1]).partition(':')[0]
    reason = text.lstrip()[len(name):].lstrip(': \t\r\n')
    if name not in BRIDGE_STATES:
        return BridgeState(INACTIVE, f'unknown state of the bridge: {text[:40]!r}')
    return BridgeState(name, ' '.join(reason.split())[:_LONGEST_REASON])


def effective_state(reported: BridgeState | None, age: float) -> BridgeState:
    """
    Return the state of the bridge; absent if the bridge has been silent for too long.

    :param reported: the state in its last message; None without one.
    :param age: of that message, s, by a clock that neither stops nor jumps.
    """
    if reported is None or math.isinf(age):
        return BridgeState(NO_AUTOPILOT, f'nothing received on {TOPIC} (if another program flies '
                           'the commands, set require_bridge:=false)')
    if not age <= SILENCE_MAX:  # written so that NaN fails
        return BridgeState(NO_AUTOPILOT, f'nothing received on {TOPIC} for {age:.1f} s')
    return reported
