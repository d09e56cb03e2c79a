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
``mavlink_bridge/state`` reports whether the vehicle flies the planner's commands.

Its text is a state and, after a colon, the reason::

    NO_AUTOPILOT: none received yet
    INACTIVE: offboard was not requested
    READY: waiting for offboard mode
    ACTIVE
    TAKEN_OVER: offboard was left for POSCTL

The bridge sends it at each change, and at 2 Hz: otherwise ``ACTIVE`` of a dead bridge would stay
on the latched topic. Nothing here reads a clock.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

NO_AUTOPILOT, INACTIVE, READY, ACTIVE, TAKEN_OVER = BRIDGE_STATES = (
    'NO_AUTOPILOT', 'INACTIVE', 'READY', 'ACTIVE', 'TAKEN_OVER')
TOPIC = 'mavlink_bridge/state'
#: Where the vehicle was armed, in the frame of the odometry; latched.
ARMED_AT_TOPIC = 'mavlink_bridge/armed_at'
SILENCE_MAX = 1.0  # s: two of the bridge's repetitions may get lost
_LONGEST_REASON = 200  # characters


class BridgeState(NamedTuple):
    """One of ``BRIDGE_STATES``, and the reason for it."""

    name: str
    reason: str = ''

    def __str__(self) -> str:
        return f'{self.name}: {self.reason}' if self.reason else self.name


def parse(text: str) -> BridgeState:
    """Return the state in a message; an unknown state, or none, counts as ``INACTIVE``."""
    name, reason = re.fullmatch(  # type: ignore[union-attr]  # matches any text
        r'\s*([^:\s]*)[:\s]*(.*)', text, re.DOTALL).groups()
    if name not in BRIDGE_STATES:
        return BridgeState(INACTIVE, f'unknown state of the bridge: {text[:40]!r}')
    return BridgeState(name, ' '.join(reason.split())[:_LONGEST_REASON])


def effective_state(reported: BridgeState | None, age: float) -> BridgeState:
    """
    Return the state of the bridge; after a silence it counts as absent.

    :param reported: the state in its last message; None without one.
    :param age: of that message, s, by a clock that neither stops nor jumps.
    """
    if reported is None or math.isinf(age):
        return BridgeState(NO_AUTOPILOT, f'nothing received on {TOPIC} (if another program flies '
                           'the commands, set require_bridge:=false)')
    if not age <= SILENCE_MAX:  # written so that NaN fails
        return BridgeState(NO_AUTOPILOT, f'nothing received on {TOPIC} for {age:.1f} s')
    return reported
