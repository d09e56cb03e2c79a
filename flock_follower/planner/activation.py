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
Whether somebody flies the planner's commands: what the bridge says on ``mavlink_bridge/state``.

Its text is a word and, after a colon, the reason::

    NO_AUTOPILOT: none heard yet
    INACTIVE: offboard was not requested
    READY: waiting for offboard mode
    ACTIVE
    TAKEN_OVER: offboard was left for POSCTL

The bridge sends it where it changes, and at 2 Hz: a bridge that died would else leave ``ACTIVE``
on the latched topic for ever. Nothing here reads a clock.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

NO_AUTOPILOT, INACTIVE, READY, ACTIVE, TAKEN_OVER = WORDS = (
    'NO_AUTOPILOT', 'INACTIVE', 'READY', 'ACTIVE', 'TAKEN_OVER')
TOPIC = 'mavlink_bridge/state'
#: Where the vehicle was armed, in the frame of the odometry; latched.
ARMED_AT_TOPIC = 'mavlink_bridge/armed_at'
SILENCE = 1.0  # s: two of the bridge's repetitions may get lost
_LONGEST_REASON = 200  # characters


class BridgeState(NamedTuple):
    """One of ``WORDS``, and why it is that one."""

    word: str
    reason: str = ''

    def __str__(self) -> str:
        return f'{self.word}: {self.reason}' if self.reason else self.word


def parse(text: str) -> BridgeState:
    """Return what a message says; an unknown word, or none, counts as ``INACTIVE``."""
    word, reason = re.fullmatch(  # type: ignore[union-attr]  # matches any text
        r'\s*([^:\s]*)[:\s]*(.*)', text, re.DOTALL).groups()
    if word not in WORDS:
        return BridgeState(INACTIVE, f'the bridge says {text[:40]!r}, which means nothing here')
    return BridgeState(word, ' '.join(reason.split())[:_LONGEST_REASON])


def believed(said: BridgeState | None, age: float) -> BridgeState:
    """
    Return what to believe of the bridge.

    :param said: what it said last, None where it never did.
    :param age: how long ago that was, s, by a clock that neither stops nor jumps.
    """
    if said is None or math.isinf(age):
        return BridgeState(NO_AUTOPILOT, f'nothing heard on {TOPIC} (where somebody else flies '
                           'the commands, require_bridge:=false)')
    if not age <= SILENCE:  # written so that NaN fails
        return BridgeState(NO_AUTOPILOT, f'nothing heard on {TOPIC} for {age:.1f} s')
    return said
