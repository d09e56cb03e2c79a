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
The situation of one decision: all inputs of ``setpoint_rules.decide`` as one value.

The gate collects its inputs in a ``Situation``; ``decide`` returns the setpoint for it.
``to_json`` writes a situation as one line; ``test/recorded_situation.py`` reads the line, so that
a decision can be repeated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
import enum
import json
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.gate.envelope import GateLimits, Location
from flock_follower.gate.obstacle import Refusal
from flock_follower.gate.relative_flight import Relative
from flock_follower.gate.velocity_check import KnownMotion
from flock_follower.messages.commands import Command


class AcceptedCommand(NamedTuple):
    """A command that was accepted; times are on the monotonic clock."""

    command: Command
    time: float
    """Time for which the command was made, s."""
    source_time: float
    """Time of the image on which the command is based, s."""


class Held(NamedTuple):
    """Yaw and height to keep without a command; None if unknown."""

    yaw: float | None = None
    """Yaw, rad."""
    height: float | None = None
    """Height, m."""


class VehicleReport(NamedTuple):
    """The autopilot's report of the vehicle, and the age of this report."""

    armed: bool
    """Whether the vehicle is armed; if not, setpoints are level."""
    airborne: bool
    """Whether the vehicle flies: on the ground PX4 takes off for any upward acceleration."""
    link_age: float
    """For how long messages of the autopilot have been missing, s."""
    mode_age: float
    """Time since the last message with the mode, s: the pilot may have switched since."""


@dataclass(frozen=True, eq=False)
class Situation:
    """All inputs of a decision at ``now``, s on the monotonic clock; vectors are ENU."""

    now: float
    limits: GateLimits
    """Limits of commands; they may be lower than at the start."""
    start_limits: GateLimits
    """Limits at the start, for braking and separation."""
    known: KnownMotion
    """The known motion of the vehicle."""
    report: VehicleReport
    command: AcceptedCommand | None
    """The newest command."""
    withheld: str
    """Why no setpoint may be sent, such as a takeover by the pilot; '' if it may."""
    unplaced: Refusal | None
    """Why a height or position that was known before cannot be used now."""
    place: Location
    """The vehicle's location in its envelope."""
    held: Held
    relative: Relative
    """Whether a command may be based on the marker only."""
    offset: ArrayLike
    """The acceleration (3,), m/s^2, that offsets the disturbance."""
    retreat: ArrayLike | None = None
    """Velocity (3,), m/s, to brake to without odometry; None: to a hover."""

    @property
    def command_age(self) -> float:
        """Return the time since the command became valid, s; infinite without a command."""
        return math.inf if self.command is None else self.now - self.command.time

    @property
    def source_age(self) -> float:
        """Return the age of the image on which the command is based, s; infinite without one."""
        return math.inf if self.command is None else self.now - self.command.source_time

    def to_json(self) -> str:
        """Return the situation as one line of JSON, with NaN and Infinity as in Python."""
        return json.dumps(_plain_value(self))


def _plain_value(value: Any) -> Any:
    if isinstance(value, enum.Enum):
        return value.name
    if is_dataclass(value) or hasattr(value, '_fields'):
        return {name: _plain_value(getattr(value, name)) for name in _names(type(value))}
    return value.tolist() if isinstance(value, np.ndarray) else value


def _names(kind: Any) -> Iterator[str]:
    return (field.name for field in fields(kind)) if is_dataclass(kind) else iter(kind._fields)
