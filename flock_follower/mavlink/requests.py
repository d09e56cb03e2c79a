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
Requests by people and by the bridge itself: arm, offboard, take off, land; one at a time.

A request that would be in vain or dangerous is refused here. Otherwise the autopilot is asked, and
the permission to send setpoints follows the request and its outcome.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink import commands, envelope, parameter_check
from flock_follower.mavlink.commands import (
    Goal,
    HOLD,
    LAND,
    NOT_RECEIVED,
    OFFBOARD,
    Request,
    STREAM_TIMEOUT,
    Vehicle,
)
from flock_follower.mavlink.dialects import VehicleStatus
from flock_follower.mavlink.estimator_health import explained
from flock_follower.mavlink.flight_end import FlightEnd
from flock_follower.mavlink.gate import Gate
from flock_follower.mavlink.housekeeping import Housekeeping
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.permission import Phase
from flock_follower.mavlink.status_texts import StatusTexts
from flock_follower.ranges import first_reason

#: What speaks against offboard, by whether the vehicle reports to be in the air.
IN_AIR: Final[dict[bool | None, str]] = {
    True: '', False: 'on the ground: arm, call takeoff, and request offboard in the air',
    None: 'the autopilot does not report whether it flies (EXTENDED_SYS_STATE), which counts as '
          'on the ground'}
#: PX4 accepts a take-off this much below its minimum height, m.
TOLERANCE: Final[float] = 0.1


class Requests:
    """
    Begins requests and steps the one whose outcome is open.

    :param end: end of the flight; reset by a request of an operator.
    :param require_failsafe: whether offboard needs the parameters of ``parameter_check.RULES``.
    """

    def __init__(self, link: Link, gate: Gate, housekeeping: Housekeeping,
                 texts: StatusTexts, end: FlightEnd, require_failsafe: bool) -> None:
        self.newest: Request | None = None
        self.stopping = False
        """Whether only requests that end a flight are accepted."""
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
            return self.begin(HOLD, now)
        reason, waits = self.offboard_obstacle(now)
        flies = self._gate.permission.phase is Phase.ACTIVE
        return self.begin(OFFBOARD, now, '' if waits or flies else reason)

    def land(self, now: float) -> Request:
        """Land here."""
        self._end.begin()
        return self.begin(LAND, now)

    def takeoff(self, height: float, now: float) -> Request:
        """Climb by ``height``, m."""
        self._end.begin()
        telemetry = self._link.telemetry
        goal = commands.takeoff(height, telemetry.altitude(now) or 0.0,
                                telemetry.sea_level_altitude(now),
                                telemetry.height_above_home(now) or 0.0)
        return self.begin(goal, now, self._takeoff_obstacle(height, now))

    @property
    def pending(self) -> Request | None:
        """Return the request whose outcome is open, if there is one."""
        request = self.newest
        return request if request is not None and request.outcome is None else None

    @property
    def landing(self) -> bool:
        """Return whether the autopilot is being asked to land."""
        return self.pending is not None and self.pending.goal is LAND

    def acknowledge(self, ack: Any, now: float) -> None:
        """Take a COMMAND_ACK."""
        # To us, not to a ground station; MAVLink 1 does not say.
        ours = (ack.target_system in (0, self._link.source_system)
                and ack.target_component in (0, self._link.source_component))
        if ours and self.newest is not None and self.newest.acknowledge(
                ack.command, ack.result, now):
            self._housekeeping.request_reasons()

    def step(self, streaming_for: float, now: float) -> None:
        """
        Send the next command of the pending request, and pass its failure to the permission.

        :param streaming_for: how long setpoints have been going out without a gap, s.
        """
        request = self.pending
        if request is None:
            return
        if not self._ended_here(request, now):
            self._ask(request, streaming_for, now)
            if request.outcome is not None and not request.outcome.success:
                request.outcome = request.outcome._replace(message=explained(
                    request.outcome.message, self._link.telemetry.estimator, now,
                    self._housekeeping.parameters.values))
        if request.goal is OFFBOARD and request.outcome is not None and (
                not request.outcome.success):
            self._gate.permit(self._gate.permission.failed(request.outcome.message))

    def _status(self, now: float) -> VehicleStatus | None:
        return self._link.telemetry.current(now, self._gate.limits.link_timeout)

    def offboard_obstacle(self, now: float, in_air: bool = True) -> tuple[str, bool]:
        """
        Return why the vehicle may not fly our setpoints now, as far as it is received, or ''.

        And whether the next seconds may clear it, because something has not been received yet.

        :param in_air: whether it has to be in the air, and in the envelope, by now.
        """
        return next(filter(lambda found: found[0], self._offboard_checks(now, in_air)),
                    ('', False))

    def _offboard_checks(self, now: float, in_air: bool) -> Iterator[tuple[str, bool]]:
        """Yield the result of each check of offboard, the first one first; '' if it passes."""
        telemetry, gate = self._link.telemetry, self._gate
        dialect, parameters = telemetry.dialect, self._housekeeping.parameters
        forwarding = self._housekeeping.without_gps
        # The autopilot may not have had the time to send everything.
        waits = now - self._housekeeping.alive_since < STREAM_TIMEOUT
        yield gate.permission.taken_over(now), False
        yield gate.misaligned(now) or gate.contradiction(now), False
        if self._require_failsafe and dialect is not None:
            yield parameter_check.obstacle(dialect, parameters, forwarding), False
        if dialect is None or self._status(now) is None:
            return
        if gate.speed(now) is None:
            yield 'no velocity known: neither odom nor LOCAL_POSITION_NED', waits
        flying, height = telemetry.flying(now), gate.heights.height(now)
        if in_air:
            yield IN_AIR[flying], flying is None and waits
            yield envelope.outside(gate.limits, height), height is None and waits
        yield self._end.battery_low(now), False
        if self._require_failsafe:
            yield parameter_check.unread(dialect, parameters, forwarding), True

    def _takeoff_obstacle(self, height: float, now: float) -> str:
        """Return why the vehicle may not climb by ``height``, m, or ''."""
        telemetry, status, limits = self._link.telemetry, self._status(now), self._gate.limits
        dialect, values = telemetry.dialect, self._housekeeping.parameters.values
        if status is None or dialect is None:
            return NOT_RECEIVED
        name, reached = dialect.minimum_takeoff, height + (self._gate.heights.height(now) or 0.0)
        if name not in values:
            self._housekeeping.parameters.again(name)
        climbs, least = f'{dialect.title} would climb', values.get(name, 0.0)
        above = f'it would end {reached:.1f} m above the place of arming: beyond '
        return first_reason(
            (not status.armed, 'disarmed: arm first'),
            # A second climb would begin at the height that the first has reached by now.
            (telemetry.flying(now) or telemetry.landed == mavlink.MAV_LANDED_STATE_TAKEOFF,
             'already in the air'),
            (telemetry.altitude(now) is None,
             'no LOCAL_POSITION_NED: the height reached would be unknown'),
            (name and name not in values,
             f'{name} is not known yet: {climbs} that high at least'),
            (not height >= least - TOLERANCE,
             f'{climbs} to {name} = {least:g} m, above takeoff_height = {height:g} m'),
            (reached < limits.height_min, f'{above}height_min = {limits.height_min:g} m'),
            (reached > limits.height_max, f'{above}height_max = {limits.height_max:g} m'))

    def begin(self, goal: Goal, now: float, obstacle: str = '', why: str = '') -> Request:
        """
        Begin a request.

        :param obstacle: why it is refused at once, or ''.
        :param why: why the bridge itself requests it; '' for a request by a person.
        """
        gate, pending, superseded = self._gate, self.pending, None
        obstacle = first_reason(
            # Nor is it known how to ask.
            (goal.ends_flight and self._link.telemetry.dialect is None, NOT_RECEIVED),
            (self.stopping and not goal.ends_flight, 'the bridge is stopping'),
            (obstacle, obstacle),
            (pending is not None and not goal.ends_flight,
             f'still waiting for {pending.goal.name if pending is not None else ""}'))
        if goal.ends_flight:
            # From here on only braking goes out, even if the autopilot refuses.
            gate.permit(gate.permission.ended(why or f'{goal.name} requested'))
            if pending is not None:
                superseded = pending.refuse(f'superseded by {goal.name}').goal
        if obstacle:
            return Request(goal, now).refuse(obstacle)
        self.newest = request = Request(goal, now, superseded, own=bool(why))
        if goal is OFFBOARD:
            gate.permit(gate.permission.requested(now))
        return request

    def _ended_here(self, request: Request, now: float) -> bool:
        """End a request for offboard that has become pointless, or is in vain."""
        permission = self._gate.permission
        if request.goal is not OFFBOARD:
            return False
        if permission.phase not in (Phase.READY, Phase.ACTIVE):
            request.refuse(permission.reason)  # a reboot or the pilot was quicker
            return True
        # Requested before the autopilot was received: only now there is something to compare.
        reason, waits = ('', False) if request.sent else self.offboard_obstacle(now)
        if reason and not (waits and now - request.begun < STREAM_TIMEOUT):
            request.refuse(reason)
            if permission.since >= request.begun:  # else it was flying before
                self._gate.permit(permission.failed(reason, asked=False))
        return bool(reason)

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

    def takeoff_explains_mode(self, now: float) -> bool:
        """
        Return whether a take-off explains an offboard mode that misses no setpoint.

        ArduPilot takes off in GUIDED, and stays in it above. Before and while it climbs setpoints
        would do nothing, or end it; after our own take-off offboard has not been requested yet.
        """
        telemetry, newest = self._link.telemetry, self.newest
        if telemetry.dialect is None or not telemetry.dialect.setpoints_end_takeoff:
            return False
        ours = newest is not None and newest.goal.command == mavlink.MAV_CMD_NAV_TAKEOFF and (
            newest.outcome is None or newest.outcome.success)
        return ours or telemetry.flying(now) is False
