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

"""Why a command is refused: a value for comparisons in code, and a text for people."""

from __future__ import annotations

import enum
from typing import NamedTuple


class Obstacle(enum.Enum):
    """Reason not to send a command; its value is the text of a ``Refusal`` without details."""

    WITHHELD = 'not permitted'
    DISARMED = 'disarmed'
    LINK_LOST = 'link lost'
    MODE_UNKNOWN = 'mode unknown'
    NO_VELOCITY = 'no velocity'
    VELOCITY_STALE = 'velocity stale'
    YAWS_DISAGREE = 'yaws of odom and of the autopilot disagree'
    VELOCITIES_DISAGREE = 'velocities of odom and of the autopilot disagree'
    DISPLACED = 'displacements differ'
    HEIGHT_STALE = 'height stale'
    HEIGHT_JUMPED = 'height jumped'
    NOT_RELATIVE = 'relative command not permitted'
    MARKER_LOST = 'marker lost'
    NO_HEIGHT = 'no height'
    ON_GROUND = 'on the ground'
    NO_COMMAND = 'no command'
    COMMAND_INVALID = 'command not finite'
    COMMAND_STALE = 'command stale'


class Refusal(NamedTuple):
    """A refusal of a command: the obstacle, and details."""

    cause: Obstacle
    detail: str = ''
    """The text for people; '' for the text of the obstacle."""

    def __str__(self) -> str:
        return self.detail or self.cause.value
