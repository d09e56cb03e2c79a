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
Requests by people and by the bridge: arm, offboard, take off, land; one at a time.

A request that cannot succeed, or is dangerous, is refused here. Other requests are sent to the
autopilot. The permission to send setpoints changes with the request, and with its outcome.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, Final

from flock_follower.gate import envelope
from flock_follower.gate.flight_end import FlightEnd, Handover, NO_HANDOVER
from flock_follower.gate.gate import Gate
from flock_follower.gate.permission import Phase
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.mavlink import commands, parameter_check
from flock_follower.mavlink.commands import Goal, NOT_RECEIVED, Request, Vehicle
from flock_follower.mavlink.dialects import Dialect, PX4
from flock_follower.mavlink.estimator_health import explain_refusal, find_misplacement
from flock_follower.mavlink.housekeeping import Housekeeping
from flock_follower.mavlink.identity import not_hovering
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.status_texts import StatusTexts
from flock_follower.ranges import first_reason

#: Obstacles to offboard, by the reported landed state.
UNKNOWN_IF_FLYING: Final[str] = (
    'the autopilot does not report whether it flies (EXTENDED_SYS_STATE)')
IN_AIR: Final[dict[bool | None, str]] = {
    True: '', False: 'on the ground: arm, call takeoff, and request offboard in the air',
    None: f'{UNKNOWN_IF_FLYING}, which counts as on the ground'}
#: Names of the goals that the permission follows.
OFFBOARD, LAND = 'offboard', 'land'
#: PX4 accepts a take-off this much below its minimum height, m.
TOLERANCE: Final[float] = 0.1


class Requests:
    """
    Begins requests, and continues the pending request.

    :param end: end of the flight; reset by a request of an operator.
    :param require_failsafe: whether offboard requires the ``offboard_rules`` of the dialect.
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

    # Requests by people; the outcome appears in the request that is returned.

    def arm(self, value: bool, now: float) -> Request:
        """Arm or disarm."""
        self._end.begin()
        status, streaming = self.status(now), self._gate.permission.streams
        mode = '' if status is None or status.armed else status.mode
        return self.begin(lambda dialect: commands.arm(dialect, value, mode, streaming), now)

    def offboard(self, value: bool, now: float, obstacle: str = '') -> Request:
        """
        Request the mode that flies our setpoints, or the hold mode.

        :param obstacle: why more than one node commands, or ''.
        """
        self._end.begin()
        if not value:
            return self.begin(commands.hold, now)
        flies = self._gate.permission.phase is Phase.ACTIVE
        return self.begin(commands.offboard, now, '' if flies else (
            obstacle or self.offboard_obstacle(now)))

    def land(self, now: float) -> Request:
        """Land here."""
        self._end.begin()
        return self.begin(commands.land, now)

    def takeoff(self, height: float, now: float) -> Request:
        """Climb by ``height``, m."""
        self._end.begin()
        telemetry = self._link.telemetry
        return self.begin(lambda dialect: commands.takeoff(
            dialect, height, telemetry.altitude(now) or 0.0, telemetry.sea_level_altitude(now),
            telemetry.height_above_home(now) or 0.0), now, self._takeoff_obstacle(height, now))

    @property
    def pending(self) -> Request | None:
        """Return the pending request, if there is one."""
        request = self.newest
        return request if request is not None and request.outcome is None else None

    @property
    def landing(self) -> bool:
        """Return whether a landing is pending."""
        return self.pending is not None and self.pending.goal.name == LAND

    def acknowledge(self, ack: Any, now: float) -> None:
        """Take a COMMAND_ACK."""
        ours = self._link.questions.is_addressed(ack)  # not to a ground station
        if ours and self.newest is not None and self.newest.acknowledge(
                ack.command, ack.result, now):
            self._housekeeping.request_reasons()

    def observe(self, status: VehicleStatus) -> None:
        """Take the status in each HEARTBEAT or CURRENT_MODE, also of two that arrive at once."""
        if self.pending is not None:
            self.pending.observe(status.mode)

    def begin(self, make: Callable[[Dialect], Goal], now: float, obstacle: str = '',
              end: Handover = NO_HANDOVER) -> Request:
        """
        Begin a request.

        :param make: returns the goal for an autopilot.
        :param obstacle: why the request is refused at once, or ''.
        :param end: why the bridge makes the request; '' for a request by a person.
        """
        gate, pending, superseded = self._gate, self.pending, None
        dialect = self._link.telemetry.dialect
        goal = make(dialect or PX4)  # without a dialect it is refused, and any will do
        received = dialect is not None and (goal.ends_flight or self.status(now) is not None)
        obstacle = first_reason(
            (not received, NOT_RECEIVED),
            (self.stopping and not goal.ends_flight, 'the bridge is stopping'),
            (obstacle, obstacle),
            (pending is not None and not goal.ends_flight,
             f'still waiting for {pending.goal.name if pending is not None else ""}'))
        if goal.ends_flight:
            # From here on setpoints only brake, even if the autopilot refuses.
            gate.permit(gate.permission.end(end.why or f'{goal.name} requested', end.cause))
            if pending is not None:
                superseded = pending.refuse(f'superseded by {goal.name}').goal
        request = Request(dialect or PX4, goal, now, superseded, own=bool(end.why))
        if obstacle:
            return request.refuse(obstacle)
        self.newest = request
        if goal.name == OFFBOARD:
            gate.permit(gate.permission.request(now))
        return request

    def step(self, streaming_for: float, now: float) -> None:
        """
        Send the next command of the pending request, and pass its failure to the permission.

        :param streaming_for: time for which setpoints have been sent without a gap, s.
        """
        request, permission = self.pending, self._gate.permission
        if request is None:
            return
        offboard = request.goal.name == OFFBOARD
        if offboard and permission.phase not in (Phase.READY, Phase.ACTIVE):
            request.refuse(permission.reason)  # a reboot, or the pilot, came first
            return
        self._ask(request, streaming_for, now)
        if request.outcome is not None and not request.outcome.success:
            request.outcome = request.outcome._replace(message=explain_refusal(
                request.outcome.message, self._link.telemetry.estimator, now))
            if offboard:
                self._gate.permit(permission.fail(request.outcome.message))

    def _ask(self, request: Request, streaming_for: float, now: float) -> None:
        telemetry, status, vehicle = self._link.telemetry, self.status(now), None
        if status is not None:
            vehicle = Vehicle(status, telemetry.altitude(now),
                              telemetry.shown_time(request.current.command),
                              telemetry.is_flying(now) is not False)
        elif request.own:
            return  # The pilot may have switched modes: to repeat it would take the vehicle back.
        confirmation = request.step(vehicle, streaming_for=streaming_for, texts=self._texts,
                                    now=now)
        goal = request.current
        if confirmation is not None and (vehicle is not None or goal.ends_flight):
            self._link.send_command(goal.command, goal.params, confirmation)

    def status(self, now: float) -> VehicleStatus | None:
        """Return the vehicle's status, None while the link is not alive."""
        return self._link.telemetry.current(now, self._gate.limits.link_timeout)

    # Why a request would be refused here.

    def offboard_obstacle(self, now: float, in_air: bool = True) -> str:
        """
        Return why the vehicle may not fly our setpoints now, by the received messages, or ''.

        :param in_air: whether the vehicle must be in the air, and inside the envelope.
        """
        telemetry, gate = self._link.telemetry, self._gate
        dialect = telemetry.dialect
        if dialect is None or self.status(now) is None:
            return NOT_RECEIVED
        reasons = [self._link.identity.conflict(now), self._housekeeping.unreceived_reason(now),
                   gate.permission.takeover_refusal(now),
                   gate.contradiction(now),
                   not_hovering(telemetry.vehicle_type, telemetry.vtol_state(now))]
        if gate.speed(now) is None:
            reasons.append('no velocity known: neither odom nor LOCAL_POSITION_NED')
        if in_air:
            reasons += [IN_AIR[telemetry.is_flying(now)],
                        envelope.refuse_height(gate.limits, gate.heights.height(now))]
        reasons += [self._housekeeping.watch.obstacle(), self._end.battery_low(now),
                    self._housekeeping.origin.obstacle,
                    find_misplacement(telemetry.local_place(now), telemetry.home(),
                                      gate.odometry_position)]
        if self._require_failsafe:
            reasons.append(parameter_check.obstacle(
                dialect, self._housekeeping.parameters, self._housekeeping.without_gps))
        return next(filter(None, reasons), '')

    def _takeoff_obstacle(self, height: float, now: float) -> str:
        """Return why the vehicle may not climb by ``height``, m, or ''."""
        telemetry, status, limits = self._link.telemetry, self.status(now), self._gate.limits
        if status is None or telemetry.dialect is None:
            return NOT_RECEIVED
        if not status.armed:
            return 'disarmed: arm first'
        # A second climb would begin at the height that the first has reached by now.
        left = telemetry.has_left_ground(now)
        if left is None:
            return UNKNOWN_IF_FLYING
        if left:
            return 'already in the air'
        if telemetry.altitude(now) is None:
            return 'no LOCAL_POSITION_NED: the height reached would be unknown'
        name, values = telemetry.dialect.minimum_takeoff, self._housekeeping.parameters.values
        if name and not height >= values.get(name, math.inf) - TOLERANCE:
            return (f'{name} = {values.get(name, "unknown")} m: '
                    f'it would climb that high, above takeoff_height = {height:g} m')
        beyond = envelope.find_exceeded_bound(
            limits, envelope.Location(height + (self._gate.heights.height(now) or 0.0)), 0.0)
        return beyond and f'it would end at {beyond}'
