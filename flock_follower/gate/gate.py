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

The gate stores the newest inputs with their times, and passes them to ``setpoint_rules.decide``.
Bridge, ``evaluate`` and ``flights`` use the same object. Nothing here reads a clock.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.command_messages import Command, ODOMETRY_GAP
from flock_follower.gate import disturbance, envelope, setpoint_rules, velocity_check
from flock_follower.gate.disturbance import DisturbanceObserver, HeightWatch
from flock_follower.gate.envelope import GateLimits, HeightEstimator, Location
from flock_follower.gate.permission import Permission, Phase
from flock_follower.gate.relative_flight import RelativeFlight
from flock_follower.gate.setpoint_rules import AcceptedCommand, Held, Setpoint
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.gate.velocity_check import (
    AUTOPILOT,
    displaced,
    finite_vector,
    known_motion,
    KnownMotion,
    Motion,
    ODOM,
    Path,
    plausible_velocity,
    refusal,
    Source,
    VELOCITIES_DISAGREE,
    VelocityComparison,
    YAWS_DISAGREE,
)
from flock_follower.geometry import Array
from flock_follower.messages import OdometryState, SANE
from flock_follower.ranges import first_reason, THRUST_OFFSET_MAX

#: A command may rest on an image of at most this age, s; planners coast before.
OLDEST_SOURCE: Final[float] = 2.5
VELOCITY_SOURCES: Final[tuple[str, ...]] = (ODOM, AUTOPILOT, 'auto')
#: Braking keeps the height that the vehicle reaches after this time, s.
HEIGHT_LEAD: Final[float] = 0.3
#: A height that is lost while the autopilot is received hands the vehicle over after this, s.
HEIGHT_HANDOVER_TIME: Final[float] = 2.0
#: A landed report below this height, m, that lasts this long, s, ends the permission. In flight a
#: false one must not remove thrust.
LANDED_HEIGHT: Final[float] = 0.3
LANDED_TIME: Final[float] = 1.0


class Gate:
    """
    Permission and setpoints of one follower.

    Vectors are ENU. ``now`` is a monotonic clock, s; ``age`` is the age of a message when it was
    received, s, so that the gate needs no second clock.

    :param limits: at start; ``limits`` may be lowered later, braking and separation keep these.
    :param velocity_source: source of the velocity that commands are checked against; it must be
        fresh: 'odom', 'autopilot', or 'auto', which is odom once odom was received.
    """

    def __init__(self, limits: GateLimits | None = None, velocity_source: str = 'auto') -> None:
        self.limits = self.full_limits = limits or GateLimits()
        self.velocity_source = velocity_source
        self.compensates_wind = False
        """Whether setpoints offset the wind."""
        self.hover_thrust = 'the hover thrust'
        """The autopilot's parameter of the hover thrust."""
        self.fused = False
        """Whether the autopilot's estimate rests on our odometry, so that it is no evidence."""
        self.heights = HeightEstimator()
        self.relative = RelativeFlight(
            self.limits.relative_timeout if self.limits.relative_flight else 0.0)
        self.new_command = False
        """Whether a command was accepted since the last decision."""
        self.command_time = -math.inf
        """Time of the last accepted command, s."""
        self.permission = Permission()
        self.active_since = math.inf
        """Time from which it has been ACTIVE, s; infinite while it is not."""
        self._was_active = False  # since offboard was last requested
        self._status: VehicleStatus | None = None
        self._airborne: bool | None = None
        self._landed_since = math.inf
        self._command: AcceptedCommand | None = None
        self._sources = {ODOM: Source(), AUTOPILOT: Source()}
        self._height_path = Path()
        self._start: Array | None = None
        self._comparison = VelocityComparison()
        self._distrusted_since = math.inf
        self._displaced_since = math.inf
        self._displaced = ''
        self._heightless_since = math.inf
        self._disturbance = DisturbanceObserver()
        self._height_watch = HeightWatch()
        self._flown: Array | None = None
        self._held: Held | None = None
        self._commanded = False  # whether the last setpoint was a command
        self._last_yaw: float | None = None

    def permit(self, after: Permission) -> None:
        """Take the permission after an event, such as ``permission.requested(now)``."""
        before, self.permission, phase = self.permission, after, after.phase
        self._was_active = phase is Phase.ACTIVE or (
            self._was_active and phase is Phase.GIVING_BACK)
        if (before.phase is Phase.ACTIVE) != (phase is Phase.ACTIVE):
            self._command = None  # it brakes until the next one

    def take_status(self, status: VehicleStatus, received: float,
                    airborne: bool | None = True) -> None:
        """
        Take the status in a HEARTBEAT or CURRENT_MODE, received at a time, s.

        :param airborne: whether the autopilot reports that it flies; None if it does not report.
        """
        self._status, self._airborne = status, airborne
        self.permit(self.permission.seen(status, received, airborne))

    @property
    def flies(self) -> bool:
        """Return whether the vehicle, as far as known, flies our setpoints."""
        # A lost link leaves it flying them: the last report counts.
        return self._status is not None and self._status.armed and self.permission.flies

    @property
    def withheld(self) -> str:
        """Return why no setpoint may be sent, or ''."""
        return '' if self.permission.streams else self.permission.reason

    def take_command(self, command: Command, age: float, now: float,
                     source_age: float | None = None) -> str:
        """
        Take a command for the time ``now - age``; return '' or why it is refused.

        ``source_age`` is the age of the image the command rests on, for latency statistics.
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
        self.new_command = True
        self.command_time = now
        self._command = AcceptedCommand(
            command._replace(acceleration=a), now - max(age, 0.0), now - source)
        return ''

    def update_velocity(self, source: str, velocity: ArrayLike, age: float, now: float, *,
                        yaw: float = math.nan, position: ArrayLike | None = None,
                        std: float = 0.0) -> str:
        """
        Take a velocity (3,), m/s, of 'odom' or 'autopilot'; return '' or why it is refused.

        :param yaw: of the same message, rad; NaN without one.
        :param position: of the same message (3,), m, and its standard deviation ``std``, m.
        """
        v, known = plausible_velocity(velocity), self._sources[source]
        if v is None:
            return 'not finite' if finite_vector(velocity) is None else 'too fast'
        if not (refused := refusal(age, self.limits.odom_timeout)):
            known.velocity, known.velocity_time = v, now - max(age, 0.0)
            known.take_yaw(yaw, known.velocity_time)
            self.update_position(source, position, known.velocity_time, std)
        return refused

    def update_position(self, source: str, position: ArrayLike | None, time: float,
                        std: float = 0.0) -> None:
        """Take a position (3,), m, of 'odom' or 'autopilot' at a time, s; ``std`` in m."""
        known, p = self._sources[source], finite_vector(position)
        if p is not None and np.all(np.abs(p) < SANE):
            fresh = time - known.velocity_time <= self.limits.odom_timeout
            known.position = p
            known.path.take(p, known.velocity if fresh else None, time)
            known.std = std if math.isfinite(std) else 0.0

    def update_height(self, altitude: float, now: float, sensor: str = '') -> str:
        """Take an altitude, m, of a barometer or another sensor; return '' or the refusal."""
        known = self._known(now)
        # Also of an invalid source: a constant error is estimated and removed.
        velocity = None if self.relative.reckoning else known.velocity or known.braking
        refused = self.heights.take(altitude, None if velocity is None else float(
            velocity.vector[2]), now, sensor)
        height = self.heights.altitude(now)
        if not refused and height is not None:
            self._height_path.take(np.array([0.0, 0.0, height]), None, now)
        return refused

    def corrected_climb_rate(self, climb_rate: float, now: float) -> float:
        """Return a vertical velocity of odom, m/s, less the error that the barometer shows."""
        return self.heights.corrected(climb_rate, now) if self._source() == ODOM else climb_rate

    def update_yaw(self, source: str, yaw: float, time: float) -> None:
        """Take the vehicle's yaw, rad, ENU, by 'odom' or 'autopilot' at a time, s."""
        self._sources[source].take_yaw(yaw, time)

    def update_attitude(self, quaternion: Array, rates: Array, time: float,
                        now: float) -> OdometryState | None:
        """Take the autopilot's attitude at a time, s; return the motion without odometry."""
        flown = np.zeros(3) if self._flown is None else self._flown * [0.0, 0.0, 1.0]
        return self.relative.motion(
            quaternion, rates, flown + self._disturbance.acceleration, self.heights.height(now),
            time, now)

    def yaw_difference(self, now: float) -> float | None:
        """Return the yaw of odom minus that of the autopilot, rad; None if one is not fresh."""
        return self._known(now).turned

    def contradiction(self, now: float) -> str:
        """Return the contradiction between odom and the autopilot as text, or ''."""
        known, turned = self._known(now), math.degrees(self.yaw_difference(now) or 0.0)
        more = {
            YAWS_DISAGREE: f' by {turned:.0f} deg: their frames are not aligned, commands would '
                           'go the wrong way',
            VELOCITIES_DISAGREE: f' by {self._comparison.difference:.2f} m/s, more than '
                                 f'{self.limits.velocity_tolerance:.2f} m/s '
                                 '(velocity_disagreement)'}
        # Displacements are compared in each cycle.
        return known.contradiction + more.get(known.contradiction, '') or self._displaced

    @property
    def wind(self) -> float:
        """Return the acceleration by the wind that setpoints offset, m/s^2."""
        return float(np.linalg.norm(self._disturbance.offset(self.compensates_wind)[:2]))

    @property
    def thrust_offset(self) -> float:
        """Return the upward acceleration, m/s^2, that offsets the error of the hover thrust."""
        return float(self._disturbance.offset(False)[2])

    def thrust_error(self, now: float, longer: float = disturbance.WARNING_TIME) -> str:
        """Return that the hover thrust has been too wrong for longer than a time, s, or ''."""
        return '' if now - self._disturbance.excess_since <= longer else (
            f'the hover thrust is wrong by {self._disturbance.acceleration[2]:.1f} m/s^2, '
            f'more than setpoints offset ({THRUST_OFFSET_MAX:g}): check the load, the '
            f'battery, and {self.hover_thrust}')

    @property
    def odometry_position(self) -> Array | None:
        """Return the newest position of odometry (3,), m; None if there is none."""
        return self._sources[ODOM].position

    def speed(self, now: float) -> float | None:
        """Return the freshest known speed, m/s, or None."""
        velocity = self._known(now).braking
        return None if velocity is None else float(np.linalg.norm(velocity.vector))

    def place(self, now: float) -> Location:
        """Return the vehicle's location in its envelope."""
        position = self._sources[self._source()].path.position
        height = self.heights.height(now)
        if (motion := self.relative.reckoning) is not None:
            return Location(height, float(motion.velocity[2]))
        return Location(height, self.heights.climb_rate if height is not None else 0.0,
                        None if position is None or self._start is None else (
                            position - self._start)[:2])

    def handover(self, now: float) -> str:
        """Return why the vehicle must be handed to the autopilot's hold mode, or ''."""
        displaced = now - self._displaced_since > velocity_check.DISPLACED_HANDOVER_TIME
        return first_reason(
            (displaced and math.isnan(self.relative.lasts(now)), self._displaced),
            (now - self._heightless_since > HEIGHT_HANDOVER_TIME, 'no height from the autopilot'),
        ) or envelope.exceeded(self.limits, self.place(now)) or (
            self._height_watch.reason) or self.thrust_error(now, disturbance.THRUST_HANDOVER_TIME)

    def decide(self, now: float, link_age: float = 0.0, withheld: str = '', distrusted: str = '',
               mode_age: float = 0.0) -> tuple[Setpoint, AcceptedCommand | None]:
        """
        Return the setpoint to send at ``now``, s, and its command, if any.

        Once the vehicle flies our setpoints, yaw and height to hold are frozen where braking
        begins, and the radius counts from there; before, they follow the vehicle.

        :param link_age: time since the autopilot is missing, s.
        :param withheld: a reason of the caller's own to send nothing.
        :param distrusted: why the velocity of the autopilot is invalid, or ''.
        :param mode_age: time since a message last had the mode, s.
        """
        self.new_command = False
        self.permit(self.permission.unseen(mode_age))
        self._notice_landing(now)
        self._distrusted_since = min(self._distrusted_since, now) if distrusted else math.inf
        active = self.permission.phase is Phase.ACTIVE
        self.active_since = min(self.active_since, now) if active else math.inf
        status, withheld = self._status, withheld or self.withheld
        armed = status is not None and status.armed
        engaged = status is not None and status.offboard and armed and not withheld
        # In flight only a lasting landed report counts: a false one must not remove thrust.
        airborne = self._airborne is True or self._was_active
        known = self._compare(self._known(now), engaged, now)
        # While nothing is received the height is missing, too, without a fault of its sensor.
        heightless = link_age <= self.limits.link_timeout and self.heights.missing(now)
        self._heightless_since = min(self._heightless_since, now) if heightless else math.inf
        place = self.place(now)
        self._hold(known, place, engaged, now)
        velocity = None if known.contradiction else known.velocity
        usable = velocity is not None and not self._displaced and self._source() == ODOM
        self.relative.update(active and engaged, self._commanded, usable, place.height, now)
        self._disturbance.step(self._flown, None if velocity is None or (
            self.relative.reckoning is not None) else velocity.vector, now)
        command = self._command
        setpoint = setpoint_rules.decide(
            self.limits, full=self.full_limits, known=known,
            command=None if command is None else command.command,
            command_age=math.inf if command is None else now - command.time,
            link_age=link_age, mode_age=mode_age, armed=armed, airborne=airborne,
            withheld=withheld, place=place,
            unplaced=self.heights.lost(now) or (
                '' if command is not None and command.command.relative else self._displaced),
            held=self._held or Held(), relative=self.relative.permission(
                -math.inf if command is None else command.source_time, now),
            offset=self._disturbance.offset(self.compensates_wind),
            retreat=self._retreat(known, now))
        sends = setpoint.kind != setpoint_rules.NONE
        self._flown = setpoint.acceleration if engaged and airborne and sends else None
        self._commanded = setpoint.kind == setpoint_rules.COMMAND
        self._height_watch.step(place.height, self._commanded_height(setpoint, place, now)
                                if active and engaged else None)
        if not sends and not withheld and known.blind:
            self.permit(self.permission.blinded(setpoint.reason))
        if setpoint.kind != setpoint_rules.COMMAND:
            return setpoint, None
        self._held, self._last_yaw = None, setpoint.yaw
        return setpoint, command

    def _notice_landing(self, now: float) -> None:
        height = self.place(now).height
        down = self._airborne is False and (height is None or height < LANDED_HEIGHT)
        self._landed_since = min(self._landed_since, now) if down else math.inf
        if now - self._landed_since >= LANDED_TIME:
            self.permit(self.permission.landed())

    def _source(self) -> str:
        if self.velocity_source != 'auto':
            return self.velocity_source
        # Once odometry was received, losing it must brake: the autopilot's own estimate often
        # rests on that odometry, and drifts metres without it.
        return ODOM if math.isfinite(self._sources[ODOM].velocity_time) else AUTOPILOT

    def _commanded_height(self, setpoint: Setpoint, place: Location, now: float) -> float | None:
        """Return the height, m, that a setpoint leads to, as far as it is known."""
        if setpoint.kind == setpoint_rules.BRAKE and self._held is not None:
            return self._held.height
        odom = self._sources[ODOM]
        # A vehicle that is judged by its autopilot may fly commands on another's odometry.
        if setpoint.kind != setpoint_rules.COMMAND or self._command is None or (
                self._source() != ODOM or place.height is None or odom.position is None):
            return None
        altitude = float(odom.position[2] + odom.velocity[2] * (now - odom.velocity_time))
        height = place.height + self._command.command.altitude - altitude
        return min(max(height, self.limits.height_min), self.limits.height_max)

    def _retreat(self, known: KnownMotion, now: float) -> Array | None:
        """Return the velocity (3,), m/s, to brake to, if odometry is lost and a neighbor came."""
        command, lost_since = self._command, self._sources[ODOM].velocity_time
        lost = known.source == ODOM and known.velocity is None and not known.contradiction
        # The planner outlived the odometry, so the odometry ended the commands.
        if not lost or command is None or not lost_since < command.time <= now <= (
                lost_since + ODOMETRY_GAP):
            return None
        return command.command.retreat

    def _known(self, now: float) -> KnownMotion:
        odom, autopilot = self._sources[ODOM], self._sources[AUTOPILOT]
        yaw, time = odom.yaw()
        # Compared at the same time: at 1 rad/s odometry 0.25 s late would differ by 0.25 rad.
        then, _ = autopilot.yaw(time)
        return known_motion(
            self.limits, Motion(odom.velocity, now - odom.velocity_time, yaw, now - time),
            Motion(autopilot.velocity, now - autopilot.velocity_time, then,
                   now - autopilot.yaw()[1]),
            source=self._source(), disagreeing_for=self._comparison.disagreeing_for(now),
            distrusted_for=now - self._distrusted_since)

    def _compare(self, known: KnownMotion, engaged: bool, now: float) -> KnownMotion:
        """Compare the sources' velocities and displacements; return what is known after that."""
        odom, before = self._sources[ODOM], self._comparison.disagreeing_for(now)
        self._comparison.take(
            known.difference, self.limits.velocity_tolerance, engaged, now)
        # An estimate that rests on our odometry, or on no sensor, is no evidence.
        proves = not self.fused and math.isinf(self._distrusted_since)
        self._displaced = '' if known.source != ODOM else displaced(
            odom, self._sources[AUTOPILOT] if proves else None,
            known.turned or 0.0, self._height_path, now)
        self._displaced_since = min(self._displaced_since, now) if engaged and (
            self._displaced) else math.inf
        return known if self._comparison.disagreeing_for(now) == before else self._known(now)

    def _hold(self, known: KnownMotion, place: Location, engaged: bool, now: float) -> None:
        """Store the yaw and height that braking holds, and the origin of the radius."""
        if not engaged or self._start is None:
            self._start = self._sources[self._source()].path.position
        height = None
        if place.height is not None:
            height = min(max(place.height + HEIGHT_LEAD * place.climb_rate,
                             self.limits.height_min), self.limits.height_max)
        if self._held is not None and engaged:
            held_height = height if self._held.height is None else self._held.height
            self._held = self._held._replace(height=held_height)
            return
        # The autopilot's own yaw first: the autopilot obeys in its own frame.
        yaws = [self._sources[source].yaw() for source in (AUTOPILOT, ODOM)]
        fresh = [yaw for yaw, time in yaws if now - time <= self.limits.odom_timeout]
        self._last_yaw = fresh[0] if fresh else self._last_yaw
        self._held = Held(self._last_yaw, height)
