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
from flock_follower.messages import Command
from flock_follower.planner.limits import brake, limit_command, limit_norm, LimitedCommand

#: A stamp may lie this far in the future, s: clocks and ``/clock`` come in steps.
FUTURE_TOLERANCE: Final[float] = 0.1
#: Yaw rates are clipped to this, rad/s; autopilots turn more slowly anyway.
YAW_RATE_MAX: Final[float] = math.pi
#: A setpoint sent longer ago than this, s, no longer bounds the jerk of the next.
JERK_MEMORY: Final[float] = 0.5
#: The stream stops this long, s, after a velocity that is told could no longer be believed. Where
#: none is told at all, the whole computer may have stood still: that is ``blind_timeout``.
LOSS_TIMEOUT: Final[float] = 0.6
#: Before the stream falls silent setpoints are level for this long, s.
LEVEL_TIME: Final[float] = 0.25
#: ``brake_time`` and ``speed_horizon`` allow for velocities of up to this age, s.
USUAL_AGE: Final[float] = 0.05
#: Age beyond that lengthens both by this factor times it. Braking on a velocity that is d late is
#: the loop v' = -v(t - d) / T: it swings for ever at T = 2 d / pi, and not at all from T = e d on.
LATE_FACTOR: Final[float] = math.e
ODOM: Final[str] = 'odom'
AUTOPILOT: Final[str] = 'autopilot'

COMMAND: Final[str] = 'command'
BRAKE: Final[str] = 'brake'
LEVEL: Final[str] = 'level'
NONE: Final[str] = 'none'


class Motion(NamedTuple):
    """What one source says of the vehicle's motion; an age is infinite where it never said."""

    velocity: ArrayLike = (0.0, 0.0, 0.0)
    """(3,), m/s."""
    velocity_age: float = math.inf
    """s."""
    yaw: float = 0.0
    """rad."""
    yaw_age: float = math.inf
    """s."""


UNKNOWN: Final[Motion] = Motion()
VELOCITIES_DISAGREE: Final[str] = 'velocities of odom and of the autopilot disagree'


class Velocity(NamedTuple):
    """A velocity that is fresh and finite."""

    vector: Array
    """(3,), m/s."""
    margin: float
    """By how much its age prolongs time constants, s."""


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
    yaw_rate: float
    """rad/s, anticlockwise."""
    limited: str
    """What limited the acceleration: '', or 'j_max', 'a_max', 'v_max' joined by commas."""


def decide(limits: GateLimits, *, command: Command | None, command_age: float, odom: Motion,
           autopilot: Motion, source: str, link_age: float, offboard: bool, armed: bool,
           withheld: str = '', rested_for: float = -math.inf,
           disagreeing_for: float = -math.inf, distrusted_for: float = -math.inf,
           held_yaw: float | None = None,
           previous: ArrayLike | None = None, previous_age: float = math.inf) -> Setpoint:
    """
    Return the setpoint that may be sent now, and the reason where it is not the command.

    Whatever the arguments hold (NaN, infinities, wrong shapes, ages in the future), the
    acceleration is finite, at most ``a_max`` long, and never leads to a speed above ``v_max``.

    :param command: the newest command; it should have applied ``command_age`` seconds ago.
    :param odom: the vehicle's motion by the odometry, ``autopilot`` by the autopilot's estimate.
    :param source: 'odom' or 'autopilot': whose velocity judges a command and has to be fresh.
    :param link_age: how long the autopilot has been missing, s.
    :param offboard: whether its mode is the one that obeys setpoints.
    :param armed: whether it is armed; before, setpoints are level.
    :param withheld: a reason to send nothing at all, such as a pilot who has taken over.
    :param rested_for: how long ago braking brought the vehicle to rest, s; negative: not yet.
    :param disagreeing_for: how long ago the velocities began to disagree, s; negative: they agree.
    :param distrusted_for: for how long the autopilot has told a velocity that nothing carries, s.
    :param held_yaw: the yaw, rad, to keep where there is no command.
    :param previous: the acceleration (3,), m/s^2, sent ``previous_age`` seconds ago.
    """
    yaw = held_yaw if held_yaw is not None and math.isfinite(held_yaw) else None
    if withheld:
        return Setpoint(NONE, withheld, np.zeros(3), yaw, 0.0, '')
    if not armed:
        return Setpoint(LEVEL, 'disarmed', np.zeros(3), yaw, 0.0, '')
    admitted, reason = _admit(limits, command, command_age, odom, autopilot, source, link_age,
                              disagreeing_for)
    if admitted is not None:
        command, velocity = admitted
        wanted = command.acceleration if command.away is not None else _limit_jerk(
            limits, command.acceleration, previous, previous_age)
        safe = _limit(limits, wanted, velocity, command.away)
        limited = [] if wanted is command.acceleration else ['j_max']
        rate = min(max(command.yaw_rate, -YAW_RATE_MAX), YAW_RATE_MAX)
        return Setpoint(COMMAND, '', safe.acceleration, wrap_angle(command.yaw), rate,
                        ', '.join(limited + [safe.reason] * safe.limited))
    if rested_for >= 0.0 and offboard and limits.silent_at_rest:
        # The autopilot obeys the last setpoint for up to seconds: make that one level.
        kind = LEVEL if rested_for < LEVEL_TIME else NONE
        return Setpoint(kind, f'at rest, {reason}', np.zeros(3), yaw, 0.0, '')
    known = braking_velocity(limits, odom, autopilot, source, disagreeing_for)
    if known is None:
        silent = blind(limits, odom, autopilot, source, disagreeing_for, distrusted_for)
        kind = NONE if silent else LEVEL
        return Setpoint(kind, reason, np.zeros(3), yaw, 0.0, '')
    wanted = brake(known.vector, limits.a_max, limits.brake_time + known.margin)
    safe = _limit(limits, wanted, known)
    return Setpoint(BRAKE, reason, safe.acceleration, yaw, 0.0, safe.reason)


def braking_velocity(limits: GateLimits, odom: Motion, autopilot: Motion, source: str,
                     disagreeing_for: float = -math.inf) -> Velocity | None:
    """Return the velocity to brake with; None where none is fresh, or two disagree."""
    first, second = (odom, autopilot) if source == ODOM else (autopilot, odom)
    if yaws_disagree(limits, odom, autopilot):
        # The autopilot's own frame is the one in which it obeys.
        first, second = autopilot, odom
    elif disagreeing_for >= 0.0:
        return None  # one of them is wrong: braking on that one would speed the vehicle up
    velocity = _fresh_velocity(first, limits)
    return _fresh_velocity(second, limits) if velocity is None else velocity


def yaw_difference(limits: GateLimits, odom: Motion, autopilot: Motion) -> float | None:
    """Return the yaw of odom minus that of the autopilot, rad; None where one is not fresh."""
    if not (_fresh_yaw(odom, limits) and _fresh_yaw(autopilot, limits)):
        return None
    return wrap_angle(odom.yaw - autopilot.yaw)


def yaws_disagree(limits: GateLimits, odom: Motion, autopilot: Motion) -> bool:
    """Return whether the frames are turned against one another, so that braking accelerates."""
    turned = yaw_difference(limits, odom, autopilot)
    return turned is not None and abs(turned) > limits.yaw_disagreement


def contradiction(limits: GateLimits, odom: Motion, autopilot: Motion,
                  disagreeing_for: float) -> str:
    """Return what odom and the autopilot disagree about, or ''."""
    if yaws_disagree(limits, odom, autopilot):
        return 'yaws of odom and of the autopilot disagree'
    return VELOCITIES_DISAGREE if disagreeing_for >= 0.0 else ''


def velocity_difference(limits: GateLimits, odom: Motion, autopilot: Motion,
                        source: str) -> Array | None:
    """Return by what (3,), m/s, odom, being the source, is faster; None unless both are fresh."""
    mine, own = _fresh_velocity(odom, limits), _fresh_velocity(autopilot, limits)
    if source != ODOM or mine is None or own is None:
        return None
    with np.errstate(over='ignore'):
        return mine.vector - own.vector


def blind(limits: GateLimits, odom: Motion, autopilot: Motion, source: str,
          disagreeing_for: float = -math.inf, distrusted_for: float = -math.inf) -> bool:
    """Return whether there has been no velocity to believe for too long, after there was one."""
    if braking_velocity(limits, odom, autopilot, source, disagreeing_for) is not None:
        return False
    if disagreeing_for > LOSS_TIMEOUT or distrusted_for > LOSS_TIMEOUT:
        return True
    ages = [age for age in (odom.velocity_age, autopilot.velocity_age) if math.isfinite(age)]
    # None was ever known where the vehicle is still on the ground.
    return bool(ages) and min(ages) > limits.odom_timeout + limits.blind_timeout


def fresh(age: float, timeout: float) -> bool:
    """Return whether an age, s, is neither too old, nor in the future, nor NaN."""
    return -FUTURE_TOLERANCE <= age <= timeout


def finite_vector(value: ArrayLike) -> Array | None:
    """Return a copy as an array (3,), None where it is not three finite numbers."""
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return vector if vector.shape == (3,) and np.all(np.isfinite(vector)) else None


def _admit(limits: GateLimits, command: Command | None, command_age: float, odom: Motion,
           autopilot: Motion, source: str, link_age: float, disagreeing_for: float
           ) -> tuple[tuple[Command, Velocity] | None, str]:
    """Return the command and the velocity to judge it with, or None and why it may not pass."""
    if not link_age <= limits.link_timeout:  # written so that NaN fails
        return None, 'link lost'
    judge = odom if source == ODOM else autopilot
    velocity = _fresh_velocity(judge, limits)
    if velocity is None:
        never = math.isinf(judge.velocity_age)
        return None, f'no velocity from {source}' if never else f'velocity from {source} stale'
    if disagreement := contradiction(limits, odom, autopilot, disagreeing_for):
        return None, disagreement
    if command is None:
        return None, 'no command'
    if finite_vector(command.acceleration) is None or not (
            math.isfinite(command.yaw) and math.isfinite(command.yaw_rate)):
        return None, 'command not finite'
    if not fresh(command_age, limits.planner_timeout):
        return None, 'command stale'
    return (command, velocity), ''


def _limit(limits: GateLimits, wanted: ArrayLike, velocity: Velocity,
           away: ArrayLike | None = None) -> LimitedCommand:
    first = None if away is None else finite_vector(away)
    return limit_command(wanted, velocity.vector, limits.a_max, limits.v_max,
                         limits.speed_horizon + velocity.margin, first)


def _limit_jerk(limits: GateLimits, wanted: ArrayLike, previous: ArrayLike | None,
                previous_age: float) -> ArrayLike:
    """Return a step from the previous setpoint towards the wanted one, itself if near enough."""
    before = None if previous is None else finite_vector(previous)
    if limits.j_max == 0.0 or before is None or not 0.0 <= previous_age <= JERK_MEMORY:
        return wanted
    change = limit_norm(wanted, limits.a_max) - before
    step = limit_norm(change, limits.j_max * previous_age)
    return wanted if np.array_equal(step, change) else before + step


def _fresh_velocity(motion: Motion, limits: GateLimits) -> Velocity | None:
    if not fresh(motion.velocity_age, limits.odom_timeout):
        return None
    vector = finite_vector(motion.velocity)
    margin = LATE_FACTOR * max(motion.velocity_age - USUAL_AGE, 0.0)
    return None if vector is None else Velocity(vector, margin)


def _fresh_yaw(motion: Motion, limits: GateLimits) -> bool:
    return fresh(motion.yaw_age, limits.odom_timeout) and math.isfinite(motion.yaw)
