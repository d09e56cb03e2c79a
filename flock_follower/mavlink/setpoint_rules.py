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

A command passes only if it is fresh and finite, the velocity that it is checked against is fresh,
and the autopilot is received. A command that rests on the marker alone passes only while flight
without odometry is permitted (``relative_flight``), and with bounds of its own, because its speed
is not known. Otherwise the setpoint brakes. A stale command is never repeated: an
autopilot keeps accelerating for seconds when its setpoints stop, none limits the speed that
acceleration setpoints lead to, and ArduCopter obeys NaN. Each setpoint keeps these bounds, the
most important first: ``a_max`` and ``v_max``; the heights of the envelope; the separation that the
planner requests; the radius of the envelope; the rest of the command. Vectors are ENU; ``decide``
takes everything that it depends on as an argument.

``encode_setpoint`` makes SET_POSITION_TARGET_LOCAL_NED of a setpoint: acceleration and yaw in
MAV_FRAME_LOCAL_NED, which PX4 and ArduCopter both obey.

``DisturbanceObserver`` estimates wind and hover thrust error. An autopilot flies an acceleration
setpoint by a tilt and a thrust that depend on the setpoint alone. PX4 does not compare the result
with the setpoint: in wind the vehicle drifts, and with a wrong hover thrust it sinks or climbs.
ArduPilot closes the horizontal loop itself if GUID_OPTIONS is 0; there the estimate stays small.
The observer is a Luenberger observer with the states velocity and disturbance, both poles at
-BANDWIDTH: v' = response + d + 2 w (v_measured - v), d' = w^2 (v_measured - v).
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.geometry import Array, enu_to_ned, wrap_angle, yaw_enu_to_ned
from flock_follower.mavlink import envelope
from flock_follower.mavlink.envelope import GateLimits, Location
from flock_follower.mavlink.relative_flight import LONGEST_STEP, Relative
from flock_follower.mavlink.velocity_check import (
    finite_vector,
    fresh,
    KnownMotion,
    LATE_FACTOR,
    USUAL_AGE,
    Velocity,
)
from flock_follower.messages import Command, OLDEST_MARKER, RELATIVE_MAX, SANE
from flock_follower.planner.limits import (
    brake,
    limit_command,
    limit_level,
    limit_norm,
    LimitedCommand,
    SENT_INSIDE,
)
from flock_follower.planner.projection import product
from flock_follower.ranges import first_reason

#: Acceleration only, 0xC3F: for as long as no yaw is known.
ACCELERATION: Final[int] = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE)
#: Acceleration and yaw, 0x83F.
ACCELERATION_YAW: Final[int] = ACCELERATION & ~mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE


def encode_setpoint(acceleration: ArrayLike, yaw: float | None = None, time_boot_ms: int = 0,
                    system: int = 1, component: int = 1) -> Any:
    """
    Return SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_LOCAL_NED of an ENU acceleration and yaw.

    :param acceleration: (3,), m/s^2, ENU.
    :param yaw: rad, anticlockwise from east; None leaves it to the autopilot.
    :param time_boot_ms: time stamp, ms; ``system`` and ``component`` address the receiver.
    :raises ValueError: for a value that is not finite.
    """
    north, east, down = enu_to_ned(acceleration).tolist()
    heading = 0.0 if yaw is None else yaw_enu_to_ned(yaw)
    if not all(map(math.isfinite, (north, east, down, heading))):
        raise ValueError(f'setpoint: acceleration = {np.asarray(acceleration).tolist()}, '
                         f'yaw = {yaw}: must be finite')
    return mavlink.MAVLink_set_position_target_local_ned_message(
        time_boot_ms, system, component, mavlink.MAV_FRAME_LOCAL_NED,
        ACCELERATION if yaw is None else ACCELERATION_YAW, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        north, east, down, heading, 0.0)


#: 1/s: slower than the loops that it acts in (braking: 3 1/s).
BANDWIDTH: Final[float] = 1.0
#: From the setpoint to 63 % of the tilt, s; measured on PX4 0.23, on ArduCopter 0.27.
RESPONSE_TIME: Final[float] = 0.25
#: Estimates are at most this long, horizontally and vertically, m/s^2.
WIND_MAX: Final[float] = 1.0
THRUST_ERROR_MAX: Final[float] = 3.0
#: The part of the vertical one that setpoints offset, m/s^2; planners offset as much.
OFFSET_MAX: Final[float] = 1.2
#: A horizontal velocity that differs from the expected one by this, m/s, for this long, s,
#: contradicts the setpoints: they are not flown, so the estimate of the wind is frozen.
CONTRADICTION: Final[float] = 0.5
CONTRADICTION_TIME: Final[float] = 1.0
#: A thrust that is wrong beyond OFFSET_MAX for these times, s, is a warning, and a handover.
WARNING_TIME: Final[float] = 1.0
THRUST_HANDOVER_TIME: Final[float] = 3.0


class DisturbanceObserver:
    """Estimates a disturbance from the setpoints sent and the velocity measured."""

    def __init__(self) -> None:
        self._time = -math.inf
        self._forget()

    def _forget(self) -> None:
        self.acceleration: Array = np.zeros(3)
        """The estimate (3,), m/s^2, ENU."""
        self.excess_since = math.inf
        """Since when the error of the thrust exceeds OFFSET_MAX, s; infinite: it does not."""
        self._velocity: Array | None = None
        self._response: Array = np.zeros(3)
        self._contradicted_since = math.inf

    @property
    def offset(self) -> float:
        """Return the upward acceleration, m/s^2, that offsets the error of the thrust."""
        return min(max(-float(self.acceleration[2]), -OFFSET_MAX), OFFSET_MAX)

    def step(self, sent: Array | None, velocity: Array | None, now: float) -> None:
        """
        Update the estimate to ``now``, s.

        :param sent: acceleration (3,), m/s^2, flown since the last step; None: none of ours, which
            resets the estimate.
        :param velocity: measured (3,), m/s; None without one: the estimate stays.
        """
        elapsed, self._time = now - self._time, now
        if sent is None:
            self._forget()
            return
        usable = 0.0 < elapsed <= LONGEST_STEP
        if usable:
            self._response = self._response + (sent - self._response) * -math.expm1(
                -elapsed / RESPONSE_TIME)
        if velocity is None or self._velocity is None or not usable:
            self._velocity = velocity
            return
        # The difference of two finite velocities may overflow.
        error = (np.clip(velocity, -SANE, SANE)
                 - np.clip(self._velocity, -SANE, SANE))
        self._velocity = self._velocity + elapsed * (
            self._response + self.acceleration + 2.0 * BANDWIDTH * error)
        estimate = self.acceleration + elapsed * BANDWIDTH ** 2 * error
        contradicted = math.hypot(*error[:2].tolist()) > CONTRADICTION
        self._contradicted_since = min(self._contradicted_since, now) if contradicted else math.inf
        frozen = now - self._contradicted_since >= CONTRADICTION_TIME
        wind = self.acceleration[:2] if frozen else limit_norm(estimate[:2], WIND_MAX)
        up = min(max(float(estimate[2]), -THRUST_ERROR_MAX), THRUST_ERROR_MAX)
        self.acceleration = np.array([*wind, up])
        self.excess_since = min(self.excess_since, now) if abs(up) > OFFSET_MAX else math.inf


#: Braking holds the height by a critically damped loop of this frequency, rad/s.
HEIGHT_FREQUENCY: Final[float] = 1.5
ENVELOPE: Final[str] = 'envelope'
#: Without odometry only a slow barometer shows the climb: heights are kept from so far inside, m.
HEIGHT_MARGIN: Final[float] = 0.5
COMMAND: Final[str] = 'command'
BRAKE: Final[str] = 'brake'
LEVEL: Final[str] = 'level'
NONE: Final[str] = 'none'


class AcceptedCommand(NamedTuple):
    """A command that was accepted; times are on the monotonic clock."""

    command: Command
    time: float
    """When it applies, s."""
    source_time: float
    """When the image it rests on was taken, s."""


class Setpoint(NamedTuple):
    """The setpoint to send, and the reason."""

    kind: str
    """'command', 'brake', 'level' (zero acceleration) or 'none' (send nothing)."""
    reason: str
    """Why it is no command; '' if it is."""
    acceleration: Array
    """(3,), m/s^2."""
    yaw: float | None
    """rad; None without one."""
    limited: str
    """The limits that changed it: '', or 'a_max', 'v_max', 'envelope' joined by commas."""


class Held(NamedTuple):
    """Yaw and height to keep without a command; None if unknown."""

    yaw: float | None = None
    """rad."""
    height: float | None = None
    """m."""


def decide(limits: GateLimits, *, full: GateLimits, known: KnownMotion, command: Command | None,
           command_age: float, link_age: float, armed: bool, airborne: bool, withheld: str,
           place: Location, unplaced: str, held: Held, relative: Relative, wind: ArrayLike,
           offset: float) -> Setpoint:
    """
    Return the setpoint that may be sent now, and the reason if it is not the command.

    Whatever the arguments hold (NaN, infinities, wrong shapes, ages in the future), the
    acceleration is finite, at most ``a_max`` long, never leads to a speed above ``v_max``, and
    does not point upwards on the ground.

    :param full: the limits at start, for braking and separation; ``limits`` may be lower.
    :param known: the vehicle's motion, as far as it is known.
    :param command: the newest command; its time is ``command_age`` seconds ago.
    :param link_age: time since the autopilot is missing, s.
    :param armed: whether it is armed; before, setpoints are level.
    :param airborne: whether it reports that it flies: on the ground PX4 interprets any upward
        acceleration as a request to take off.
    :param withheld: a reason to send nothing at all, such as a pilot who has taken over.
    :param place: its location in the envelope.
    :param unplaced: why a height that was known is unknown now, or ''.
    :param held: yaw and height to keep without a command.
    :param relative: whether a command may rest on the marker alone.
    :param wind: the acceleration (3,), m/s^2, that setpoints offset horizontally.
    :param offset: the upward acceleration, m/s^2, with which braking offsets an error of thrust.
    """
    yaw = held.yaw if held.yaw is not None and math.isfinite(held.yaw) else None
    if withheld:
        return Setpoint(NONE, withheld, np.zeros(3), yaw, '')
    if not armed:
        return Setpoint(LEVEL, 'disarmed', np.zeros(3), yaw, '')
    against = finite_vector(wind)
    against = np.zeros(3) if against is None else -limit_norm(against, full.a_max)
    reason = _refusal(limits, known, command, command_age, link_age, unplaced, relative, place,
                      airborne)
    if not reason and command is not None and command.relative:
        return _relative(full, command, against, place, offset)
    velocity = known.velocity
    if not reason and command is not None and velocity is not None:
        bias = np.array([0.0, 0.0, _bounded(command.thrust_bias)])
        axis = _direction(command.separation_axis)
        safe = _limited(limits if axis is None else full,
                        np.asarray(command.acceleration) - bias, against + bias, velocity, place,
                        axis, offset)
        return Setpoint(COMMAND, '', _grounded(safe, airborne), wrap_angle(command.yaw),
                        safe.reason)
    estimated = known.braking
    if estimated is None:
        kind = NONE if known.blind and not relative.begins else LEVEL
        return Setpoint(kind, reason, np.zeros(3), yaw, '')
    nominal = brake(estimated.vector, full.a_max, limits.brake_time + estimated.margin)
    if place.height is not None and held.height is not None and airborne:
        # A late rate makes the height swing, unless 1 / (2 w) is at least e times its age.
        frequency = min(HEIGHT_FREQUENCY, 0.5 / (estimated.margin + LATE_FACTOR * USUAL_AGE))
        climb = frequency * (frequency * (held.height - place.height) - 2.0 * place.climb_rate)
        if math.isfinite(climb):
            nominal[2] = climb
            against = against + np.array([0.0, 0.0, _bounded(offset)])
    safe = _limited(full, nominal, against, estimated, place, None, offset)
    return Setpoint(BRAKE, reason, _grounded(safe, airborne), yaw, safe.reason)


def _refusal(limits: GateLimits, known: KnownMotion, command: Command | None, command_age: float,
             link_age: float, unplaced: str, relative: Relative, place: Location,
             airborne: bool) -> str:
    """Return why a command may not pass, or ''."""
    if not link_age <= limits.link_timeout:  # written so that NaN fails
        return 'link lost'
    if command is not None and command.relative:
        reason = _marker_refusal(limits, relative, place, airborne)
    else:
        reason = _odometry_refusal(known)
    if reason or unplaced:
        return reason or unplaced
    if command is None:
        return 'no command'
    if finite_vector(command.acceleration) is None or not math.isfinite(command.yaw):
        return 'command not finite'
    return '' if fresh(command_age, limits.planner_timeout) else 'command stale'


def _odometry_refusal(known: KnownMotion) -> str:
    """Return why a command may not rest on the odometry, or ''."""
    if known.velocity is not None:
        return known.contradiction
    if known.never:
        return f'no velocity from {known.source}'
    return f'velocity from {known.source} stale'


def _marker_refusal(limits: GateLimits, relative: Relative, place: Location,
                    airborne: bool) -> str:
    """Return why a command may not rest on the marker alone, or ''."""
    return first_reason(
        (not (limits.relative_flight and 0.0 <= relative.lasted <= limits.relative_timeout),
         'relative command not permitted'),
        (not fresh(relative.marker_age, OLDEST_MARKER), 'marker lost'),
        (place.height is None or not math.isfinite(place.height + place.climb_rate), 'no height'),
        (not airborne, 'on the ground'))


def _relative(full: GateLimits, command: Command, against: Array, place: Location,
              offset: float) -> Setpoint:
    """
    Return the setpoint of a command that rests on the marker alone.

    Heights go first, then the limit of the acceleration; the speed is not known. The offset of an
    error of the thrust is not limited by RELATIVE_MAX: it does not move the vehicle.
    """
    wanted = np.clip(np.asarray(command.acceleration, dtype=float), -SANE, SANE) + against
    a_max = full.a_max * SENT_INSIDE
    strongest = min(RELATIVE_MAX, full.a_max) * SENT_INSIDE
    own, bias = _bounded(offset), _bounded(command.thrust_bias)
    margin = min(HEIGHT_MARGIN, 0.25 * (full.height_max - full.height_min))
    height, climb, horizon = place.height, place.climb_rate, full.speed_horizon
    assert height is not None  # else it is refused
    # If the two offsets differ, the one that leads away from the bound is used.
    least, _ = envelope.vertical_range(
        full, Location(height - margin, climb), climb, max(own, bias), horizon, strongest)
    _, most = envelope.vertical_range(
        full, Location(height + margin, climb), climb, min(own, bias), horizon, strongest)
    within = min(max(float(wanted[2]), least), most)
    lowest, highest = min(bias, 0.0) - strongest, max(bias, 0.0) + strongest
    up = min(max(within, lowest, -a_max), highest, a_max)
    rest = min(strongest ** 2 - (up - bias) ** 2, a_max ** 2 - up ** 2)
    level = limit_norm(wanted[:2], math.sqrt(max(rest, 0.0)))
    limits = ['a_max'] if up != within or level.tolist() != wanted[:2].tolist() else []
    if within != wanted[2]:
        limits.append(ENVELOPE)
    return Setpoint(COMMAND, '', np.array([*level, up]), wrap_angle(command.yaw),
                    ', '.join(limits))


def _bounded(offset: float) -> float:
    """Return the part of an upward acceleration, m/s^2, that setpoints may offset."""
    return min(max(offset, -OFFSET_MAX), OFFSET_MAX) if math.isfinite(offset) else 0.0


def _direction(axis: ArrayLike | None) -> Array | None:
    """Return a vector (3,) if its length is 1, else None."""
    vector = None if axis is None else finite_vector(axis)
    unit = vector is not None and abs(math.hypot(*vector.tolist()) - 1.0) < 1e-6
    return vector if unit else None


def _limited(limits: GateLimits, nominal: Array, against: Array, velocity: Velocity,
             place: Location, axis: Array | None, offset: float) -> LimitedCommand:
    """
    Return the acceleration within limits and envelope that is nearest to ``nominal + against``.

    ``against`` offsets a disturbance. The limits hold for ``nominal``, which is how the vehicle
    accelerates if the disturbance is as estimated, and for the sum, if there is none.
    """
    horizon, v = limits.speed_horizon + velocity.margin, velocity.vector
    safe = limit_command(nominal, v, limits.a_max, limits.v_max, horizon, axis)
    if against.any():
        total = limit_command(safe.acceleration + against, v, limits.a_max, limits.v_max, horizon,
                              axis)
        safe = total._replace(reason=safe.reason or total.reason)
    a = safe.acceleration
    least, most = envelope.vertical_range(
        limits, place, float(v[2]), _bounded(offset), horizon, limits.a_max)
    inward = envelope.inward(limits, place, v, horizon)
    flat = complex(float(a[0]), float(a[1]))
    bounds = [] if inward is None else [inward]
    if least <= a[2] <= most and (inward is None or product(inward[0], flat) >= inward[1]):
        return safe
    sides = [] if axis is None else [
        (complex(float(axis[0]), float(axis[1])), float(axis[:2] @ a[:2]))]
    point = limit_level(a, min(max(float(a[2]), least), most), sides + bounds, v,
                        limits.a_max, limits.v_max, horizon)
    return LimitedCommand(point, ', '.join(filter(None, [safe.reason, ENVELOPE])))


def _grounded(safe: LimitedCommand, airborne: bool) -> Array:
    """Return the acceleration, on the ground without its upward part."""
    if airborne:
        return safe.acceleration
    return np.array([*safe.acceleration[:2], min(float(safe.acceleration[2]), 0.0)])
