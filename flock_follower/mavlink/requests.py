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
Whether a take-off may be asked for, and what then to ask for.

What people ask of the autopilot: arm, offboard, take off, land; one request at a time.

A request is refused here where it would be in vain or dangerous; else the autopilot is asked, and
the permission to send setpoints follows what was asked for and what became of it.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink import commands, envelope, estimator_health
from flock_follower.mavlink import parameter_check as failsafe
from flock_follower.mavlink.commands import Goal, Request, Vehicle
from flock_follower.mavlink.dialects import Dialect, VehicleStatus
from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.flight_end import FlightEnd
from flock_follower.mavlink.gate import Gate
from flock_follower.mavlink.housekeeping import Housekeeping
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.parameter_check import ParameterCheck
from flock_follower.mavlink.permission import (
    EndRequested,
    OffboardFailed,
    OffboardRequested,
    Phase,
)
from flock_follower.mavlink.status_texts import StatusTexts
from flock_follower.mavlink.telemetry import Telemetry

#: PX4 accepts a take-off this much below its minimum height, m.
TOLERANCE: Final[float] = 0.1


def goal(telemetry: Telemetry, height: float, now: float) -> Goal:
    """Return the goal of climbing by ``height``, m, from where the vehicle is at ``now``, s."""
    return commands.takeoff(height, telemetry.altitude(now) or 0.0,
                            telemetry.sea_level_altitude(now),
                            telemetry.height_above_home(now) or 0.0)


def obstacle(status: VehicleStatus | None, telemetry: Telemetry,
             parameters: ParameterCheck | None, height: float, now: float) -> str:
    """
    Return why the vehicle may not climb by ``height``, m, at ``now``, s, or ''.

    :param status: what its HEARTBEAT says, None where none is fresh.
    :param parameters: of the autopilot, as far as they are known.
    """
    if status is None or telemetry.dialect is None:
        return 'no HEARTBEAT from the autopilot'
    if not status.armed:
        return 'disarmed: arm first'
    # A second climb would begin at the height that the first has reached by now.
    if telemetry.flying(now) or telemetry.landed == mavlink.MAV_LANDED_STATE_TAKEOFF:
        return 'already in the air'
    if telemetry.altitude(now) is None:
        return 'no LOCAL_POSITION_NED: nothing would tell when the height is reached'
    return _too_low(telemetry.dialect, parameters, height)


def out_of_bounds(limits: GateLimits, height: float, present: float | None) -> str:
    """
    Return why a climb by ``height``, m, would end outside the envelope, or ''.

    :param present: the present height above the place of arming, m; 0 where it is not known.
    """
    reached = height + (present or 0.0)
    for name, wrong in (('height_min', reached < limits.height_min),
                        ('height_max', reached > limits.height_max)):
        if wrong:
            return (f'it would end {reached:.1f} m above the place of arming: beyond {name} = '
                    f'{getattr(limits, name):g} m')
    return ''


def explains_mode(request: Request | None, telemetry: Telemetry, now: float) -> bool:
    """
    Return whether an armed vehicle is in its offboard mode, and misses no setpoint, by a take-off.

    ArduPilot takes off in GUIDED, and stays in it above. Before and while it climbs out setpoints
    would do nothing, or end it; after our own take-off nobody has asked for them yet.

    :param request: the newest of ours, if any.
    """
    if telemetry.dialect is None or not telemetry.dialect.setpoints_end_takeoff:
        return False
    ours = request is not None and request.goal.command == mavlink.MAV_CMD_NAV_TAKEOFF and (
        request.outcome is None or request.outcome.success)
    return ours or telemetry.flying(now) is False


def _too_low(dialect: Dialect, parameters: ParameterCheck | None, height: float) -> str:
    """Return that the autopilot would climb higher than it is asked to, or ''."""
    name = dialect.minimum_takeoff
    if not name:
        return ''
    least = None if parameters is None else parameters.values.get(name)
    if least is None:
        if parameters is not None:
            parameters.again(name)
        return f'{name} is not known yet: {dialect.title} would climb that high at least'
    if height < least - TOLERANCE:
        return (f'{dialect.title} would climb to {name} = {least:g} m, '
                f'above takeoff_height = {height:g} m')
    return ''


NOT_RECEIVED: Final[str] = 'no HEARTBEAT from the autopilot'


class Obstacle(NamedTuple):
    """Why offboard may not be requested."""

    reason: str
    waits: bool = False
    """Whether the next seconds may clear it: something has not been received yet."""


class Requests:
    """
    Begins requests and steps the one whose outcome is open.

    :param end: of the flight; a request by a person begins it anew.
    :param require_failsafe: whether offboard needs what ``failsafe`` asks of the autopilot.
    """

    def __init__(self, link: Link, gate: Gate, housekeeping: Housekeeping,
                 texts: StatusTexts, end: FlightEnd, require_failsafe: bool) -> None:
        self.newest: Request | None = None
        self.stopping = False
        """Whether only what ends a flight may still be asked for."""
        self._link = link
        self._gate = gate
        self._housekeeping = housekeeping
        self._texts = texts
        self._end = end
        self._require_failsafe = require_failsafe

    # Requests by people; each starts asking the autopilot, the outcome appears in the request.

    def arm(self, value: bool, now: float) -> Request:
        """Arm or disarm."""
        self._end.begin()
        return self.begin(commands.arm(value, self._gate.permission.streams), now)

    def offboard(self, value: bool, now: float) -> Request:
        """Let the vehicle fly our setpoints, or hold its position."""
        self._end.begin()
        if not value:
            return self.begin(commands.HOLD, now)
        obstacle = self.offboard_obstacle(now)
        begins = obstacle is None or obstacle.waits or (
            self._gate.permission.phase is Phase.ACTIVE)  # it flies already
        return self.begin(commands.OFFBOARD, now,
                          '' if begins or obstacle is None else obstacle.reason)

    def land(self, now: float) -> Request:
        """Land here."""
        self._end.begin()
        return self.begin(commands.LAND, now)

    def takeoff(self, height: float, now: float) -> Request:
        """Climb by ``height``, m."""
        self._end.begin()
        telemetry, gate = self._link.telemetry, self._gate
        present = gate.heights.height(now)
        return self.begin(goal(telemetry, height, now), now, obstacle(
            self._status(now), telemetry, self._housekeeping.parameters, height, now) or (
                out_of_bounds(gate.limits, height, present)))

    @property
    def pending(self) -> Request | None:
        """Return the request whose outcome is open, if there is one."""
        request = self.newest
        return request if request is not None and request.outcome is None else None

    @property
    def landing(self) -> bool:
        """Return whether the autopilot is being asked to land."""
        return self.pending is not None and self.pending.goal is commands.LAND

    @property
    def taking_off(self) -> bool:
        """Return whether it has been asked for a take-off that is not over."""
        return (self.pending is not None
                and self.pending.goal.command == mavlink.MAV_CMD_NAV_TAKEOFF)

    def acknowledge(self, ack: Any, now: float) -> None:
        """Take a COMMAND_ACK."""
        # To us, not to a ground station; MAVLink 1 does not say.
        ours = (ack.target_system in (0, self._link.source_system)
                and ack.target_component in (0, self._link.source_component))
        if ours and self.newest is not None and self.newest.acknowledge(
                ack.command, ack.result, now):
            self._housekeeping.request_reasons()

    def step(self, request: Request, streaming_for: float, now: float) -> None:
        """
        Send what is due for a request, and let the permission follow how it ends.

        :param streaming_for: how long setpoints have been going out without a gap, s.
        """
        if not self._ended_here(request, now):
            self._ask(request, streaming_for, now)
            if request.outcome is not None and not request.outcome.success:
                request.outcome = request.outcome._replace(message=estimator_health.explained(
                    request.outcome.message, self._link.telemetry.estimator, now))
        if request.goal is commands.OFFBOARD and request.outcome is not None and (
                not request.outcome.success):
            self._gate.permit(OffboardFailed(request.outcome.message))

    def _status(self, now: float) -> VehicleStatus | None:
        telemetry = self._link.telemetry
        alive = telemetry.alive(now, self._gate.limits.link_timeout)
        return telemetry.status if alive else None

    def offboard_obstacle(self, now: float, in_air: bool = True) -> Obstacle | None:
        """
        Return why the vehicle may not fly our setpoints now, as far as it is received.

        :param in_air: whether it has to be in the air, and in the envelope, by now.
        """
        dialect, gate = self._link.telemetry.dialect, self._gate
        if reason := self._gate.permission.taken_over(now):
            return Obstacle(reason)
        if reason := gate.misaligned(now) or gate.contradiction(now):
            return Obstacle(reason)
        if self._require_failsafe and dialect is not None and (
                reason := failsafe.obstacle(dialect, self._housekeeping.parameters,
                                             self._housekeeping.without_gps)):
            return Obstacle(reason)
        if self._status(now) is None or dialect is None:
            return None
        if gate.speed(now) is None:
            return Obstacle('no velocity known: neither odom nor LOCAL_POSITION_NED',
                            self._just_received(now))
        height = gate.heights.height(now)
        if in_air and (obstacle := self._grounded(now)):
            return obstacle
        if in_air and (reason := envelope.outside(gate.limits, height)):
            return Obstacle(reason, height is None and self._just_received(now))
        if reason := self._end.battery_low(now):
            return Obstacle(reason)
        if self._require_failsafe and (
                reason := failsafe.unread(dialect, self._housekeeping.parameters,
                                           self._housekeeping.without_gps)):
            return Obstacle(reason, waits=True)
        return None

    def _just_received(self, now: float) -> bool:
        """Return whether the autopilot may not have had the time to send everything."""
        return now - self._housekeeping.alive_since < commands.STREAM_TIMEOUT

    def _grounded(self, now: float) -> Obstacle | None:
        """Return that the autopilot does not report that it flies, and what to do."""
        flying = self._link.telemetry.flying(now)
        if flying is None:
            return Obstacle('the autopilot does not report whether it flies (EXTENDED_SYS_STATE), '
                            'which counts as on the ground', self._just_received(now))
        return None if flying else Obstacle(
            'on the ground: arm, call takeoff, and request offboard in the air')

    def begin(self, goal: Goal, now: float, obstacle: str = '', why: str = '') -> Request:
        """
        Begin a request.

        :param obstacle: why it is refused at once, or ''.
        :param why: why the bridge itself requests it; '' for a request by a person.
        """
        if self.stopping and not goal.ends_flight:
            obstacle = 'the bridge is stopping'
        dialect, permit = self._link.telemetry.dialect, self._gate.permit
        pending, superseded = self.pending, None
        if goal.ends_flight and dialect is None:
            obstacle = NOT_RECEIVED  # nor is it known how to ask
            if pending is not None:
                pending.refuse(f'superseded by {goal.name}')
            permit(EndRequested(why or f'{goal.name} requested'))
        if obstacle:
            return Request(goal, now).refuse(obstacle)
        if pending is not None:
            if not goal.ends_flight:
                return Request(goal, now).refuse(f'still waiting for {pending.goal.name}')
            pending.refuse(f'superseded by {goal.name}')
            superseded = pending.goal
        self.newest = request = Request(goal, now, superseded, own=bool(why))
        if goal is commands.OFFBOARD:
            permit(OffboardRequested(now))
        elif goal.ends_flight:
            # From here on only braking goes out, even where the autopilot refuses.
            permit(EndRequested(why or f'{goal.name} requested'))
        return request

    def _ended_here(self, request: Request, now: float) -> bool:
        """End a request for offboard that has become pointless, or is in vain."""
        permission = self._gate.permission
        if request.goal is not commands.OFFBOARD:
            return False
        if permission.phase not in (Phase.READY, Phase.ACTIVE):
            request.refuse(permission.reason)  # a reboot or the pilot was quicker
            return True
        # Requested before the autopilot was received: only now there is something to compare.
        obstacle = None if request.sent else self.offboard_obstacle(now)
        if obstacle is None:
            return False
        if not obstacle.waits or now - request.begun >= commands.STREAM_TIMEOUT:
            request.refuse(obstacle.reason)
            if permission.since >= request.begun:  # else it was flying before
                self._gate.permit(OffboardFailed(obstacle.reason, asked=False))
        return True

    def _ask(self, request: Request, streaming_for: float, now: float) -> None:
        telemetry, status, vehicle = self._link.telemetry, self._status(now), None
        dialect = telemetry.dialect
        if status is not None and dialect is not None:
            vehicle = Vehicle(dialect, status, telemetry.altitude(now),
                              telemetry.shown_time(request.current.command),
                              telemetry.flying(now) is not False)
        elif request.own:
            return  # The pilot may have switched modes: to repeat it would take the vehicle back.
        confirmation = request.step(vehicle, streaming_for=streaming_for, texts=self._texts,
                                    now=now)
        goal = request.current
        if confirmation is not None and dialect is not None and (
                vehicle is not None or goal.ends_flight):
            self._link.send_command(goal.command, goal.params(dialect), confirmation)
