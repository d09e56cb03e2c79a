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
The setpoint gate decides whether a setpoint may be sent (``permission``), and which one.

The gate stores the newest inputs with their times, makes a ``Situation`` of them, and passes it to
``setpoint_rules.decide``. Bridge, ``evaluate`` and ``flights`` use the same object. Nothing here
reads a clock.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.gate import disturbance, envelope, setpoint_rules
from flock_follower.gate.disturbance import DisturbanceObserver, HeightWatch
from flock_follower.gate.envelope import GateLimits, Location
from flock_follower.gate.height import HeightEstimator, STEP_TIME
from flock_follower.gate.motion_sources import MotionSources, onset
from flock_follower.gate.obstacle import Refusal
from flock_follower.gate.permission import Permission, Phase
from flock_follower.gate.relative_flight import RelativeFlight
from flock_follower.gate.setpoint_rules import Setpoint
from flock_follower.gate.situation import AcceptedCommand, Held, Situation, VehicleReport
from flock_follower.gate.vehicle_status import AutopilotTraits, VehicleStatus
from flock_follower.gate.velocity_check import (
    finite_vector,
    KnownMotion,
    MotionReport,
    ODOM,
    refusal,
)
from flock_follower.geometry import Array
from flock_follower.messages import OdometryState
from flock_follower.messages.commands import Command, ODOMETRY_GAP
from flock_follower.ranges import first_reason, THRUST_OFFSET_MAX

#: A command may rest on an image of at most this age, s; planners coast before.
OLDEST_SOURCE: Final[float] = 2.5
#: Braking keeps the height that the vehicle reaches after this time, s.
HEIGHT_LEAD: Final[float] = 0.3
#: A height that is lost while the autopilot is received hands the vehicle over after this, s.
HEIGHT_HANDOVER_TIME: Final[float] = 2.0
#: A landed report below this height, m, ends the permission.
LANDED_HEIGHT: Final[float] = 0.3
#: It must last this long, s: in flight a false one must not remove thrust.
LANDED_TIME: Final[float] = 1.0


@dataclass
class Commands:
    """The commands that were accepted."""

    newest: AcceptedCommand | None = None
    """The newest accepted command."""
    is_new: bool = False
    """Whether the newest command was accepted since the last decision."""
    received: float = -math.inf
    """Time at which a command was last accepted, s."""


@dataclass
class ReportedFlight:
    """The autopilot's report of the flight; a time is infinite while its condition is false."""

    status: VehicleStatus | None = None
    airborne: bool | None = None
    """Whether the autopilot reports that the vehicle flies; None without a report."""
    was_active: bool = False
    """Whether the permission has been ACTIVE since the last request of offboard."""
    active_since: float = math.inf
    """Time since which the permission has been ACTIVE, s."""
    landed_since: float = math.inf
    """Time since which the autopilot has reported "landed" at a low height, s."""
    heightless_since: float = math.inf
    """Time since which the height has been missing, s."""

    @property
    def is_armed(self) -> bool:
        """Return whether the vehicle is armed, as far as it is known."""
        return self.status is not None and self.status.armed


@dataclass
class Flown:
    """The last setpoint, and the yaw and height that braking holds; None if unknown."""

    acceleration: Array | None = None
    """Acceleration (3,), m/s^2, of the last setpoint; None if it is not flown."""
    commanded: bool = False
    """Whether the last setpoint was a command."""
    yaw: float | None = None
    """Yaw, rad, of the last command; before the first, of the vehicle."""
    held: Held | None = None
    """Yaw and height at the beginning of braking."""
    start: Array | None = None
    """Position (3,), m, from which the radius counts."""


class Gate:
    """
    Permission and setpoints of one follower.

    Vectors are ENU. ``now`` is a monotonic clock, s. ``age`` is the age of a message when it was
    received, s, so the gate needs no second clock.

    :param limits: at the start; if ``limits`` are lowered later, braking and separation keep the
        limits of the start.
    :param velocity_source: source of the velocity with which commands are checked: 'odom',
        'autopilot', or 'auto', which is odom once odom was received. The velocity must be fresh.
    """

    def __init__(self, limits: GateLimits | None = None, velocity_source: str = 'auto') -> None:
        self.limits = self.start_limits = limits or GateLimits()
        self.autopilot = AutopilotTraits()
        self.permission = Permission()
        self.heights = HeightEstimator()
        self.motion = MotionSources(velocity_source)
        self.relative = RelativeFlight(
            self.limits.relative_timeout if self.limits.relative_flight else 0.0)
        self.commands = Commands()
        self.situation: Situation | None = None
        """The situation of the last decision."""
        self._flight = ReportedFlight()
        self._flown = Flown()
        self._disturbance = DisturbanceObserver()
        self._height_watch = HeightWatch()

    def permit(self, after: Permission) -> None:
        """Replace the permission by its next state, such as ``permission.request(now)``."""
        before, self.permission, phase = self.permission, after, after.phase
        self._flight.was_active = phase is Phase.ACTIVE or (
            self._flight.was_active and phase is Phase.GIVING_BACK)
        if (before.phase is Phase.ACTIVE) != (phase is Phase.ACTIVE):
            self.commands.newest = None  # it brakes until the next one

    def take_status(self, status: VehicleStatus, received: float,
                    airborne: bool | None = True) -> None:
        """
        Take the status in a HEARTBEAT or CURRENT_MODE, received at a time, s.

        :param airborne: whether the autopilot reports that it flies; None if it does not report.
        """
        self._flight.status, self._flight.airborne = status, airborne
        self.permit(self.permission.follow_status(status, received, airborne))

    @property
    def flies(self) -> bool:
        """Return whether the vehicle, as far as known, flies our setpoints."""
        # A lost link leaves it flying them: the last report counts.
        return self._flight.is_armed and self.permission.flies

    @property
    def active_since(self) -> float:
        """Return the time at which the permission became ACTIVE, s; infinite while it is not."""
        return self._flight.active_since

    @property
    def withheld(self) -> str:
        """Return why no setpoint may be sent, or ''."""
        return '' if self.permission.streams else self.permission.reason

    def take_command(self, command: Command, age: float, now: float,
                     source_age: float | None = None) -> str:
        """
        Take a command for the time ``now - age``; return '' or why it is refused.

        ``source_age`` is the age of the image on which the command is based, for latency
        statistics.
        """
        a, phase = finite_vector(command.acceleration), self.permission.phase
        source = age if source_age is None else source_age
        late = refusal(age, self.limits.planner_timeout)
        refused = first_reason(
            (phase is not Phase.ACTIVE, f'while {phase.name}'),
            (a is None or not math.isfinite(command.yaw), 'not finite'),
            (late, late),
            (not source <= OLDEST_SOURCE, 'resting on an old image'),
            (command.relative and math.isnan(self.relative.lasts(now)),
             'relative: not permitted'))
        if refused or a is None:
            return refused
        self.commands = Commands(AcceptedCommand(
            command._replace(acceleration=a), now - max(age, 0.0), now - source), True, now)
        return ''

    def take_motion(self, source: str, report: MotionReport, age: float, now: float) -> str:
        """Take a report of 'odom' or 'autopilot'; return '' or why it is refused."""
        return self.motion.take(source, report, age, self.limits.odom_timeout, now)

    def take_position(self, source: str, position: ArrayLike, time: float) -> None:
        """Take a position (3,), m, of 'odom' or 'autopilot' at a time, s."""
        self.motion.take_position(source, position, time, self.limits.odom_timeout)

    def take_height(self, altitude: float, now: float, sensor: str = '') -> str:
        """Take an altitude, m, of a barometer or another sensor; return '' or the refusal."""
        refused = self.heights.take(
            altitude, self._climb_rate(now), now, sensor, self._disturbance.expected_climb)
        height = self.heights.altitude(now)
        self._use_correction()
        if self.heights.stepped == now and now - self.heights.leapt <= STEP_TIME:
            # Not the odometry: its velocity errs more slowly.
            self.motion.forget_heights()
        if not refused and height is not None:
            self.motion.take_height(height, now)
        return refused

    def _climb_rate(self, now: float) -> float | None:
        """Return the uncorrected vertical velocity, m/s; None if unknown."""
        # Also of an invalid source: a constant error is estimated and removed.
        velocity = None if self.relative.reckoning else self.motion.best_velocity(
            self.limits, now)
        return None if velocity is None else float(velocity.vector[2])

    def _use_correction(self) -> None:
        # The autopilot obeys with the velocity that was forwarded, which has no such error.
        self.motion.climb_rate_error = self.corrected_climb_rate(0.0) * self.autopilot.fused

    def corrected_climb_rate(self, climb_rate: float) -> float:
        """Return a vertical velocity of odom, m/s, minus its error by the barometer."""
        return self.heights.correct(climb_rate) if self.motion.source == ODOM else climb_rate

    def take_attitude(self, quaternion: Array, rates: Array, time: float,
                      now: float) -> OdometryState | None:
        """Take the autopilot's attitude at a time, s; return the motion without odometry."""
        sent = self._flown.acceleration
        up = np.zeros(3) if sent is None else sent * [0.0, 0.0, 1.0]
        return self.relative.motion(
            quaternion, rates, up + self._disturbance.acceleration, self.heights.height(now),
            time, now)

    def yaw_difference(self, now: float) -> float | None:
        """Return the yaw of odom minus that of the autopilot, rad; None if a yaw is not fresh."""
        return self.motion.known_motion(self.limits, now).turned

    def contradiction(self, now: float) -> str:
        """Return the contradiction between odom and the autopilot as text, or ''."""
        return self.motion.contradiction(self.limits, now)

    @property
    def wind(self) -> float:
        """Return the acceleration by the wind that setpoints offset, m/s^2."""
        offset = self._disturbance.offset(self.autopilot.needs_wind_offset)
        return float(np.linalg.norm(offset[:2]))

    @property
    def thrust_offset(self) -> float:
        """Return the upward acceleration, m/s^2, that offsets the error of the hover thrust."""
        return float(self._disturbance.offset(False)[2])

    def thrust_error(self, now: float, longer: float = disturbance.WARNING_TIME) -> str:
        """Return the reason if the thrust error is too large for more than a time, s, or ''."""
        return '' if now - self._disturbance.excess_since <= longer else (
            f'the hover thrust is wrong by {self._disturbance.acceleration[2]:.1f} m/s^2, '
            f'more than setpoints offset ({THRUST_OFFSET_MAX:g}): check the load, the '
            f'battery, and {self.autopilot.hover_thrust}')

    @property
    def odometry_position(self) -> Array | None:
        """Return the newest position of odometry (3,), m; None if there is none."""
        return self.motion.odometry.position

    def speed(self, now: float) -> float | None:
        """Return the freshest known speed, m/s, or None."""
        velocity = self.motion.known_motion(self.limits, now).braking
        return None if velocity is None else float(np.linalg.norm(velocity.vector))

    def place(self, now: float) -> Location:
        """Return the vehicle's location in its envelope."""
        position, start = self.motion.position, self._flown.start
        height = self.heights.height(now)
        if (motion := self.relative.reckoning) is not None:
            return Location(height, float(motion.velocity[2]))
        return Location(height, self.heights.climb_rate if height is not None else 0.0,
                        None if position is None or start is None else (position - start)[:2])

    def handover(self, now: float) -> str:
        """Return why the vehicle must be handed to the autopilot's hold mode, or ''."""
        heightless = now - self._flight.heightless_since > HEIGHT_HANDOVER_TIME
        displaced = self.motion.displaced_too_long(now) and math.isnan(self.relative.lasts(now))
        return first_reason(
            (displaced, str(self.motion.displaced)),
            (heightless, 'no height from the autopilot'),
        ) or envelope.find_exceeded_bound(self.limits, self.place(now)) or (
            self._height_watch.reason) or self.thrust_error(now, disturbance.THRUST_HANDOVER_TIME)

    def decide(self, now: float, link_age: float = 0.0, withheld: str = '', distrusted: str = '',
               mode_age: float = 0.0) -> tuple[Setpoint, AcceptedCommand | None]:
        """
        Return the setpoint to send at ``now``, s, and its command, if any.

        While the vehicle flies our setpoints, braking holds the yaw and height at its beginning,
        and the radius counts from the position at ACTIVE. Before that, these values follow the
        vehicle.

        :param link_age: for how long messages of the autopilot have been missing, s.
        :param withheld: a reason of the caller to send nothing, or ''.
        :param distrusted: why the velocity of the autopilot is invalid, or ''.
        :param mode_age: time since the last message with the mode, s.
        """
        self.commands.is_new = False
        self.permit(self.permission.follow_silence(mode_age))
        flight = self._flight
        self._notice_landing(now)
        # In flight only a lasting landed report counts: a false one must not remove thrust.
        report = VehicleReport(flight.is_armed, flight.airborne is True or flight.was_active,
                               link_age, mode_age)
        active = self.permission.phase is Phase.ACTIVE
        flight.active_since = onset(flight.active_since, active, now)
        withheld = withheld or self.withheld
        engaged = flight.is_armed and flight.status is not None and (
            flight.status.offboard) and not withheld
        # While nothing is received the height is missing, too, without a fault of its sensor.
        heightless = link_age <= self.limits.link_timeout and self.heights.is_missing(now)
        flight.heightless_since = onset(flight.heightless_since, heightless, now)
        situation = self._observe(report, withheld, engaged, bool(distrusted), now)
        setpoint = setpoint_rules.decide(situation)
        self._record(situation, setpoint, engaged)
        return setpoint, situation.command if setpoint.kind == setpoint_rules.COMMAND else None

    def _observe(self, report: VehicleReport, withheld: str, engaged: bool, distrusted: bool,
                 now: float) -> Situation:
        """Update the estimates to ``now``, s, and return the situation."""
        if self.heights.is_silent(now):
            self.heights.take_rate(self._climb_rate(now), now, self._disturbance.expected_climb)
            self._use_correction()
        known = self.motion.compare(
            self.limits, engaged, distrusted, self.autopilot.fused, now)
        place, command, displaced = self.place(now), self.commands.newest, self.motion.displaced
        self._hold(place, engaged, now)
        velocity = None if known.contradiction else known.velocity
        usable = velocity is not None and displaced is None and self.motion.source == ODOM
        active = self.permission.phase is Phase.ACTIVE
        self.relative.update(active and engaged, self._flown.commanded, usable, place.height, now)
        self._disturbance.step(self._flown.acceleration, None if velocity is None or (
            self.relative.reckoning is not None) else velocity.vector, now)
        lost = self.heights.obstacle(now)
        relative = command is not None and command.command.relative
        self.situation = situation = Situation(
            now, self.limits, self.start_limits, known, report, command, withheld,
            Refusal(lost) if lost else None if relative else displaced, place,
            self._flown.held or Held(), self.relative.permission(now),
            self._disturbance.offset(self.autopilot.needs_wind_offset),
            self._retreat(known, now))
        return situation

    def _record(self, situation: Situation, setpoint: Setpoint, engaged: bool) -> None:
        """Store the decision; end the permission if no velocity is known any more."""
        flown, report, now = self._flown, situation.report, situation.now
        sends = setpoint.kind != setpoint_rules.NONE
        active = self.permission.phase is Phase.ACTIVE
        flown.acceleration = setpoint.acceleration if (
            engaged and report.airborne and sends) else None
        flown.commanded = setpoint.kind == setpoint_rules.COMMAND
        self._height_watch.step(situation.place.height, self._commanded_height(
            setpoint, situation, now) if active and engaged else None)
        if not sends and not situation.withheld and situation.known.blind:
            self.permit(self.permission.fall_silent(setpoint.reason, report.mode_age))
        if flown.commanded:
            flown.held, flown.yaw = None, setpoint.yaw

    def _notice_landing(self, now: float) -> None:
        down = False
        if self._flight.airborne is False:
            height = self.heights.height(now)
            down = height is None or height < LANDED_HEIGHT
        self._flight.landed_since = onset(self._flight.landed_since, down, now)
        if now - self._flight.landed_since >= LANDED_TIME:
            self.permit(self.permission.land())

    def _commanded_height(self, setpoint: Setpoint, situation: Situation,
                          now: float) -> float | None:
        """Return the height, m, that a setpoint leads to, as far as it is known."""
        place, odom = situation.place, self.motion.odometry
        if setpoint.kind == setpoint_rules.BRAKE and self._flown.held is not None:
            return self._flown.held.height
        # A vehicle that is judged by its autopilot may fly commands on another's odometry.
        if setpoint.kind != setpoint_rules.COMMAND or situation.command is None or (
                self.motion.source != ODOM or place.height is None or odom.position is None):
            return None
        altitude = float(odom.position[2] + odom.velocity[2] * (now - odom.velocity_time))
        return self._within_heights(
            place.height + situation.command.command.altitude - altitude)

    def _within_heights(self, height: float) -> float:
        """Return a height, m, clipped to the envelope."""
        return min(max(height, self.limits.height_min), self.limits.height_max)

    def _retreat(self, known: KnownMotion, now: float) -> Array | None:
        """Return the retreat velocity (3,), m/s, if odometry is lost and a neighbor approached."""
        command, lost_since = self.commands.newest, self.motion.odometry.velocity_time
        lost = known.source == ODOM and known.velocity is None and not known.contradiction
        # The planner outlived the odometry, so the odometry ended the commands.
        if not lost or command is None or not lost_since < command.time <= now <= (
                lost_since + ODOMETRY_GAP):
            return None
        return command.command.retreat

    def _hold(self, place: Location, engaged: bool, now: float) -> None:
        """Store the yaw and height that braking holds, and the origin of the radius."""
        flown = self._flown
        if not engaged or flown.start is None:
            flown.start = self.motion.position
        height = None if place.height is None else self._within_heights(
            place.height + HEIGHT_LEAD * place.climb_rate)
        if flown.held is not None and engaged:
            if flown.held.height is None:
                flown.held = flown.held._replace(height=height)
            return
        yaw = self.motion.fresh_yaw(self.limits.odom_timeout, now)
        flown.yaw = flown.yaw if yaw is None else yaw
        flown.held = Held(flown.yaw, height)
