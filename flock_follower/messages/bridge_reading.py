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
How the planner and the views read ``mavlink_bridge/state``; see ``bridge_state``.

No function reads a clock.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from flock_follower.messages.bridge_state import (
    BRIDGE_STATES,
    INACTIVE,
    LOST,
    NO_AUTOPILOT,
    TOPIC,
)

SILENCE_MAX = 1.0  # s: two of the bridge's repetitions may get lost
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
