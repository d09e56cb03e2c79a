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
The setpoint rules: one pure function decides which setpoint may be sent now, if any.

A command passes under three conditions: it is fresh and finite, the velocity with which it is
checked is fresh, and the autopilot is received. A command that is based on the marker only passes
while flight without odometry is permitted (``relative_flight``), and has other bounds, because the
speed is not known. Otherwise the setpoint brakes. An old command is never repeated, because an
autopilot continues to accelerate for seconds after the last setpoint, does not limit the speed
that results from acceleration setpoints, and (ArduCopter) obeys NaN.

Each command keeps these bounds, the most important first: ``a_max`` and ``v_max``; the heights of
the envelope; the separation that the planner requests; the radius of the envelope; the rest of the
command. The setpoint is this command plus the offset of the disturbance (``disturbance``). The
offset does not move the vehicle, so ``v_max`` and the envelope limit the command only; ``a_max``
limits the sum. Vectors are ENU. All inputs of ``decide`` are in one ``Situation``.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.gate import envelope
from flock_follower.gate.envelope import GateLimits, Location
from flock_follower.gate.level_limit import limit_level
from flock_follower.gate.obstacle import Obstacle, Refusal
from flock_follower.gate.permission import MODE_TIMEOUT
from flock_follower.gate.situation import Situation
from flock_follower.gate.velocity_check import (
    finite_vector,
    fresh,
    KnownMotion,
    LATE_FACTOR,
    USUAL_AGE,
    Velocity,
)
from flock_follower.geometry import Array, wrap_angle
from flock_follower.messages import SANE
from flock_follower.messages.commands import Command, OLDEST_MARKER, RELATIVE_ACCELERATION_MAX
from flock_follower.planner.limits import (
    brake,
    INSIDE_SHARE,
    limit_command,
    limit_norm,
    LimitedCommand,
    SENT_INSIDE,
)
from flock_follower.planner.projection import product
from flock_follower.ranges import THRUST_OFFSET_MAX

#: Braking holds the height by a critically damped loop of this frequency, rad/s.
HEIGHT_FREQUENCY: Final[float] = 1.5
ENVELOPE: Final[str] = 'envelope'
#: Without odometry only a slow barometer shows the climb: heights are kept from so far inside, m.
HEIGHT_MARGIN: Final[float] = 0.5
#: Above this multiple of ``v_max`` no disturbance is offset along the velocity.
OVERSPEED: Final[float] = 1.1
COMMAND: Final[str] = 'command'
BRAKE: Final[str] = 'brake'
LEVEL: Final[str] = 'level'
NONE: Final[str] = 'none'


class Setpoint(NamedTuple):
    """The setpoint to send, and the reason."""

    kind: str
    """'command', 'brake', 'level' (zero acceleration) or 'none' (send nothing)."""
    reason: str
    """Why the setpoint is not the command; '' if it is."""
    acceleration: Array
    """Acceleration (3,), m/s^2."""
    yaw: float | None
    """Yaw, rad; None if there is none."""
    limited: str
    """The limits that changed the command: 'a_max', 'v_max', 'envelope', joined by commas."""
    cause: Obstacle | None = None
    """Why the setpoint is not the command, as a value; None if it is."""


def decide(situation: Situation) -> Setpoint:
    """
    Return the setpoint that may be sent now, and the reason if it is not the command.

    For every situation (NaN, infinities, wrong shapes, ages in the future) the acceleration is
    finite, at most ``a_max``, and does not point upwards on the ground. Without the offset, the
    acceleration never leads to a speed above ``v_max``.
    """
    known, place, held = situation.known, situation.place, situation.held
    yaw = held.yaw if held.yaw is not None and math.isfinite(held.yaw) else None
    if situation.withheld:
        return _no_command(NONE, Refusal(Obstacle.WITHHELD, situation.withheld), yaw)
    if not situation.report.armed:
        return _no_command(LEVEL, Refusal(Obstacle.DISARMED), yaw)
    airborne, full = situation.report.airborne, situation.start_limits
    offset = _sane_offset(situation.offset)
    refusal = find_refusal(situation)
    if refusal is None and situation.command is not None:
        command = situation.command.command
        if command.relative:
            return _relative(situation.limits, command, offset, place)
        assert known.velocity is not None  # else it is refused
        axis = _direction(command.separation_axis)
        safe = _limit_and_offset(
            situation.limits if axis is None else full, np.asarray(command.acceleration), offset,
            known.velocity, place, axis)
        return Setpoint(COMMAND, '', _limit_on_ground(safe.acceleration, airborne),
                        wrap_angle(command.yaw), safe.reason)
    refusal = refusal or Refusal(Obstacle.NO_COMMAND)
    estimated = known.braking
    if estimated is None:
        if known.blind and not situation.relative.begins:
            return _no_command(NONE, refusal, yaw)
        # Without the offset of the thrust a level vehicle sinks or climbs.
        level = _with_offset(np.zeros(3), offset * [0.0, 0.0, float(airborne)], full.a_max, None)
        return _no_command(LEVEL, refusal, yaw, _limit_on_ground(level, airborne))
    retreat = np.zeros(3) if situation.retreat is None else situation.retreat
    nominal = brake(estimated.vector - limit_norm(retreat, full.v_max), full.a_max,
                    situation.limits.brake_time + estimated.margin)
    if place.height is not None and held.height is not None and airborne:
        # A late rate makes the height swing, unless 1 / (2 w) is at least e times its age.
        frequency = min(HEIGHT_FREQUENCY, 0.5 / (estimated.margin + LATE_FACTOR * USUAL_AGE))
        climb = frequency * (frequency * (held.height - place.height) - 2.0 * place.climb_rate)
        if math.isfinite(climb):
            nominal[2] = climb
    safe = _limit_and_offset(full, nominal, offset, estimated, place, None)
    return _no_command(
        BRAKE, refusal, yaw, _limit_on_ground(safe.acceleration, airborne), safe.reason)


def _no_command(kind: str, refusal: Refusal, yaw: float | None,
                acceleration: Array | None = None, limited: str = '') -> Setpoint:
    """Return a setpoint that replaces a refused command; level without an acceleration."""
    return Setpoint(kind, str(refusal), np.zeros(3) if acceleration is None else acceleration,
                    yaw, limited, refusal.cause)


def _sane_offset(offset: ArrayLike) -> Array:
    """Return an offset (3,), m/s^2, whose vertical part is limited; zeros if not finite."""
    vector = finite_vector(offset)
    if vector is None:
        return np.zeros(3)
    vector[2] = min(max(float(vector[2]), -THRUST_OFFSET_MAX), THRUST_OFFSET_MAX)
    return limit_norm(vector, SANE)


def find_refusal(situation: Situation) -> Refusal | None:
    """Return why the command of a situation may not pass, or None."""
    limits, command = situation.limits, situation.command
    if not situation.report.link_age <= limits.link_timeout:  # written so that NaN fails
        return Refusal(Obstacle.LINK_LOST)
    if not situation.report.mode_age <= MODE_TIMEOUT:
        return Refusal(Obstacle.MODE_UNKNOWN)
    if command is not None and command.command.relative:
        obstacle = _marker_obstacle(situation)
        refusal = None if obstacle is None else Refusal(obstacle)
    else:
        refusal = _odometry_refusal(situation.known)
    if refusal or situation.unplaced:
        return refusal or situation.unplaced
    if command is None:
        return Refusal(Obstacle.NO_COMMAND)
    if finite_vector(command.command.acceleration) is None or (
            not math.isfinite(command.command.yaw)):
        return Refusal(Obstacle.COMMAND_INVALID)
    stale = not fresh(situation.command_age, limits.planner_timeout)
    return Refusal(Obstacle.COMMAND_STALE) if stale else None


def _odometry_refusal(known: KnownMotion) -> Refusal | None:
    """Return why a command based on odometry is refused, or None."""
    if known.velocity is not None:
        return Refusal(known.contradiction) if known.contradiction else None
    if known.never:
        return Refusal(Obstacle.NO_VELOCITY, f'no velocity from {known.source}')
    return Refusal(Obstacle.VELOCITY_STALE, f'velocity from {known.source} stale')


def _marker_obstacle(situation: Situation) -> Obstacle | None:
    """Return why a command based on the marker alone is refused, or None."""
    limits, relative, place = situation.limits, situation.relative, situation.place
    if not (limits.relative_flight and 0.0 <= relative.lasted <= limits.relative_timeout):
        return Obstacle.NOT_RELATIVE
    if not fresh(situation.source_age, OLDEST_MARKER):
        return Obstacle.MARKER_LOST
    if place.known_height is None:
        return Obstacle.NO_HEIGHT
    return None if situation.report.airborne else Obstacle.ON_GROUND


def _relative(limits: GateLimits, command: Command, offset: Array, place: Location) -> Setpoint:
    """
    Return the setpoint of a command that is based on the marker alone.

    Heights have priority, then the limit of the acceleration; the speed is not known.
    """
    wanted = np.clip(np.asarray(command.acceleration, dtype=float), -SANE, SANE)
    strongest = RELATIVE_ACCELERATION_MAX * SENT_INSIDE
    margin = min(HEIGHT_MARGIN, 0.25 * (limits.height_max - limits.height_min))
    height, climb, horizon = place.height, place.climb_rate, limits.speed_horizon
    assert height is not None  # else it is refused
    least, _ = envelope.vertical_range(
        limits, Location(height - margin, climb), climb, horizon, strongest)
    _, most = envelope.vertical_range(
        limits, Location(height + margin, climb), climb, horizon, strongest)
    within = min(max(float(wanted[2]), least), most)
    up = min(max(within, -strongest), strongest)
    level = limit_norm(wanted[:2], math.sqrt(max(strongest ** 2 - up ** 2, 0.0)))
    acceleration = np.array([*level, up])
    total = _with_offset(acceleration, offset, limits.a_max, None)
    shortened = up != within or level.tolist() != wanted[:2].tolist()
    reasons = ['a_max'] if shortened or not _is_sum(total, acceleration, offset) else []
    if within != wanted[2]:
        reasons.append(ENVELOPE)
    return Setpoint(COMMAND, '', total, wrap_angle(command.yaw), ', '.join(reasons))


def _with_offset(acceleration: Array, offset: Array, a_max: float, axis: Array | None) -> Array:
    """
    Return the sum of a command and an offset (3,), m/s^2, shortened to ``a_max``.

    The vertical part has priority, then the part along ``axis``, a horizontal unit vector.
    """
    strongest = a_max * SENT_INSIDE
    total = acceleration + offset
    if math.hypot(*total.tolist()) <= strongest * INSIDE_SHARE:
        return total
    up = min(max(float(total[2]), -strongest), strongest)
    rest = math.sqrt(max(strongest ** 2 - up ** 2, 0.0))
    level = total[:2]
    if axis is None or not float(axis[:2] @ level) > 0.0:
        return np.array([*limit_norm(level, rest), up])
    along = min(float(axis[:2] @ level), rest)
    across = limit_norm(level - float(axis[:2] @ level) * axis[:2],
                        math.sqrt(max(rest ** 2 - along ** 2, 0.0)))
    return np.array([*limit_norm(along * axis[:2] + across, rest), up])


def _is_sum(total: Array, acceleration: Array, offset: Array) -> bool:
    """Return whether a vector is the full sum, not a shortened one."""
    return bool(total.tolist() == (acceleration + offset).tolist())


def _direction(axis: ArrayLike | None) -> Array | None:
    """Return a vector (3,) if its length is 1, else None."""
    vector = None if axis is None else finite_vector(axis)
    unit = vector is not None and abs(math.hypot(*vector.tolist()) - 1.0) < 1e-6
    return vector if unit else None


def _limit_and_offset(limits: GateLimits, nominal: Array, offset: Array, velocity: Velocity,
                      place: Location, axis: Array | None) -> LimitedCommand:
    """
    Return the acceleration within limits and envelope that is nearest to ``nominal``, and offset.

    The offset compensates a disturbance: the vehicle accelerates by the rest. If the speed exceeds
    OVERSPEED times ``v_max``, no offset acts along the velocity: the estimate may be wrong.
    """
    horizon, v = limits.speed_horizon + velocity.margin, velocity.vector
    safe = limit_command(nominal, v, limits.a_max, limits.v_max, horizon, axis)
    a, reasons = safe.acceleration, [safe.reason]
    least, most = envelope.vertical_range(limits, place, float(v[2]), horizon, limits.a_max)
    inward = envelope.inward(limits, place, v, horizon)
    flat = complex(float(a[0]), float(a[1]))
    if not (least <= a[2] <= most and (
            inward is None or product(inward[0], flat) >= inward[1])):
        sides = [] if axis is None else [
            (complex(float(axis[0]), float(axis[1])), float(axis[:2] @ a[:2]))]
        sides += [] if inward is None else [inward]
        a = limit_level(a, min(max(float(a[2]), least), most), sides, v,
                        limits.a_max, limits.v_max, horizon)
        reasons.append(ENVELOPE)
    speed = math.hypot(*v.tolist())
    if speed > OVERSPEED * limits.v_max:
        offset = offset - max(float(offset @ v), 0.0) / speed ** 2 * v
    total = _with_offset(a, offset, limits.a_max, axis)
    if not _is_sum(total, a, offset) and 'a_max' not in safe.reason:
        reasons.insert(0, 'a_max')
    return LimitedCommand(total, ', '.join(filter(None, reasons)))


def _limit_on_ground(acceleration: Array, airborne: bool) -> Array:
    """Return the acceleration, on the ground without its upward part."""
    if airborne:
        return acceleration
    return np.array([*acceleration[:2], min(float(acceleration[2]), 0.0)])
