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
The gate: one pure function that decides which setpoint, if any, may leave for the autopilot now.

A command passes only while it is fresh and finite, the velocity it is judged with is fresh, and
the autopilot is heard; it is then limited to ``a_max`` and ``v_max``. Otherwise the gate brakes,
and never repeats what has gone stale. It has to: an autopilot goes on accelerating for seconds
when its setpoints stop, none applies a speed limit to acceleration setpoints, and one of them
obeys NaN. Vectors are ENU; everything the decision rests on is an argument.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, wrap_angle
from flock_follower.mavlink.gate_limits import GateLimits
from flock_follower.mavlink.known_motion import finite_vector, fresh, KnownMotion, Velocity
from flock_follower.messages import Command
from flock_follower.planner.limits import (
    brake,
    limit_command,
    limit_norm,
    LimitedCommand,
    SENT_INSIDE,
)

#: Before the stream falls silent setpoints are level for this long, s.
LEVEL_TIME: Final[float] = 0.25

#: A command's ``lift``, m/s^2, is believed up to this: v_max is then kept within 0.4 m/s upwards.
LARGEST_LIFT: Final[float] = 1.2

COMMAND: Final[str] = 'command'
BRAKE: Final[str] = 'brake'
LEVEL: Final[str] = 'level'
NONE: Final[str] = 'none'


class Setpoint(NamedTuple):
    """What to send, and why."""

    kind: str
    """'command', 'brake', 'level' (zero acceleration) or 'none' (send nothing)."""
    reason: str
    """Why it is no command; '' if it is."""
    acceleration: Array
    """(3,), m/s^2."""
    yaw: float | None
    """rad; None where none is known."""
    limited: str
    """What limited the acceleration: '', or 'a_max', 'v_max' joined by commas."""


def decide(limits: GateLimits, *, known: KnownMotion, command: Command | None,
           command_age: float, link_age: float, offboard: bool, armed: bool,
           withheld: str = '', rested_for: float = -math.inf, held_yaw: float | None = None
           ) -> Setpoint:
    """
    Return the setpoint that may be sent now, and the reason where it is not the command.

    Whatever the arguments hold (NaN, infinities, wrong shapes, ages in the future), the
    acceleration is finite, at most ``a_max`` long, and never leads to a speed above ``v_max``.

    :param known: the vehicle's motion, as far as it is known, and what of it may be believed.
    :param command: the newest command; it should have applied ``command_age`` seconds ago.
    :param link_age: how long the autopilot has been missing, s.
    :param offboard: whether its mode is the one that obeys setpoints.
    :param armed: whether it is armed; before, setpoints are level.
    :param withheld: a reason to send nothing at all, such as a pilot who has taken over.
    :param rested_for: how long ago braking brought the vehicle to rest, s; negative: not yet.
    :param held_yaw: the yaw, rad, to keep where there is no command.
    """
    yaw = held_yaw if held_yaw is not None and math.isfinite(held_yaw) else None
    if withheld:
        return Setpoint(NONE, withheld, np.zeros(3), yaw, '')
    if not armed:
        return Setpoint(LEVEL, 'disarmed', np.zeros(3), yaw, '')
    admitted, reason = _admit(limits, known, command, command_age, link_age)
    if admitted is not None:
        command, velocity = admitted
        safe = _limit(limits, command.acceleration, velocity, command.away, command.lift)
        return Setpoint(COMMAND, '', safe.acceleration, wrap_angle(command.yaw), safe.reason)
    if rested_for >= 0.0 and offboard and limits.silent_at_rest:
        # The autopilot obeys the last setpoint for up to seconds: make that one level.
        kind = LEVEL if rested_for < LEVEL_TIME else NONE
        return Setpoint(kind, f'at rest, {reason}', np.zeros(3), yaw, '')
    believed = known.braking_velocity(limits)
    if believed is None:
        kind = NONE if known.blind(limits) else LEVEL
        return Setpoint(kind, reason, np.zeros(3), yaw, '')
    wanted = brake(believed.vector, limits.a_max, limits.brake_time + believed.margin)
    safe = _limit(limits, wanted, believed)
    return Setpoint(BRAKE, reason, safe.acceleration, yaw, safe.reason)


def _admit(limits: GateLimits, known: KnownMotion, command: Command | None, command_age: float,
           link_age: float) -> tuple[tuple[Command, Velocity] | None, str]:
    """Return the command and the velocity to judge it with, or None and why it may not pass."""
    if not link_age <= limits.link_timeout:  # written so that NaN fails
        return None, 'link lost'
    judge, _ = known.source_first
    velocity = judge.fresh_velocity(limits)
    if velocity is None:
        never = math.isinf(judge.velocity_age)
        told = f'velocity from {known.source}'
        return None, f'no {told}' if never else f'{told} stale'
    if disagreement := known.contradiction(limits):
        return None, disagreement
    if command is None:
        return None, 'no command'
    if finite_vector(command.acceleration) is None or not math.isfinite(command.yaw):
        return None, 'command not finite'
    if not fresh(command_age, limits.planner_timeout):
        return None, 'command stale'
    return (command, velocity), ''


def _limit(limits: GateLimits, wanted: ArrayLike, velocity: Velocity,
           away: ArrayLike | None = None, lift: float = 0.0) -> LimitedCommand:
    """Return an acceleration within the limits; that of ``lift``, m/s^2, leads to no speed."""
    first = None if away is None else finite_vector(away)
    horizon = limits.speed_horizon + velocity.margin
    held = min(max(lift, -LARGEST_LIFT), LARGEST_LIFT) if math.isfinite(lift) else 0.0
    if held == 0.0:
        return limit_command(wanted, velocity.vector, limits.a_max, limits.v_max, horizon, first)
    up = np.array([0.0, 0.0, held])
    moving = limit_command(np.asarray(wanted) - up, velocity.vector, limits.a_max, limits.v_max,
                           horizon, first)
    if not moving.limited:
        moving = moving._replace(acceleration=np.array(wanted, dtype=float))
        up = np.zeros(3)
    return moving._replace(acceleration=limit_norm(
        moving.acceleration + up, limits.a_max, SENT_INSIDE))
