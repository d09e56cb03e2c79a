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
The bridge without ROS: inputs, one cycle of the control loop, outputs.

One thread owns the bridge, see ``setpoint_thread``; other threads may only read it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.gate.flight_end import EndParams, FlightEnd, Handover, HOLD
from flock_follower.gate.gate import Gate
from flock_follower.gate.permission import Cause, Phase, STICK, Taker, UNKNOWN
from flock_follower.gate.setpoint_rules import NONE, Setpoint
from flock_follower.gate.situation import AcceptedCommand
from flock_follower.gate.vehicle_status import AutopilotTraits, VehicleStatus
from flock_follower.gate.velocity_check import AUTOPILOT, MotionReport
from flock_follower.geometry import yaw_from_quaternion
from flock_follower.mavlink import commands, estimator_health
from flock_follower.mavlink.commands import NOT_RECEIVED, Request
from flock_follower.mavlink.dialects import MINIMUM_STREAM_RATE
from flock_follower.mavlink.housekeeping import Housekeeping
from flock_follower.mavlink.link import AUTOPILOT_COMPONENT, Link
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder
from flock_follower.mavlink.parameter_check import Recommendation
from flock_follower.mavlink.requests import Requests
from flock_follower.mavlink.setpoint_encoding import encode_setpoint
from flock_follower.mavlink.status_texts import GroundStationReport, StatusTexts
from flock_follower.mavlink.sticks import KINDS, STICK_GAP, StickWatch
from flock_follower.mavlink.takeover import EVIDENCE_AFTER, failsafe, PILOT, TakeoverWatch, UNNAMED
from flock_follower.mavlink.telemetry import Attitude, LocalPosition
from flock_follower.messages import OdometryState, to_nanoseconds
from flock_follower.messages.bridge_state import LOST, NO_AUTOPILOT
from flock_follower.ranges import first_reason

#: At the end of the bridge braking ends below this speed, m/s.
REST_SPEED: Final[float] = 0.1
#: It ends after this time at the latest, s.
STOP_TIMEOUT: Final[float] = 1.0
#: Action if the bridge stops its stream without a valid velocity. Silence alone leaves ArduPilot
#: in GUIDED, and PX4's failsafe first holds for 4 s on the invalid estimate.
BLIND_ACTIONS: Final[tuple[str, ...]] = ('land', 'silence')
#: Whether setpoints offset the wind; 'auto': if the autopilot does not.
WIND_COMPENSATIONS: Final[tuple[str, ...]] = ('auto', 'always', 'never')
_OTHER_VEHICLE: Final[str] = 'another vehicle took the place of a silent one'


class Cycle(NamedTuple):
    """The result of one cycle."""

    setpoint: Setpoint
    sent: bool
    """Whether the setpoint was sent."""
    first: AcceptedCommand | None
    """The command, if it was sent for the first time."""


class Bridge:
    """
    Turns commands and odometry into a stream of setpoints over a link.

    :param forwarder: if given, its odometry is sent as ODOMETRY.
    :param blind_action: one of ``BLIND_ACTIONS``.
    :param require_failsafe: whether offboard requires the ``offboard_rules`` of the dialect.
    :param recommendations: like ``estimate_rate`` and ``origin``, as in ``Housekeeping``.
    :param wind_compensation: one of ``WIND_COMPENSATIONS``.
    :param end: conditions under which the bridge itself ends a flight.
    :param report_to_gcs: whether the pilot's ground station receives reports.
    """

    def __init__(self, link: Link, gate: Gate, *, now: float,
                 forwarder: OdometryForwarder | None = None, blind_action: str = 'land',
                 require_failsafe: bool = True,
                 recommendations: Mapping[str, Sequence[Recommendation]] | None = None,
                 estimate_rate: float = 50.0,
                 origin: tuple[float, float, float] | None = None,
                 wind_compensation: str = 'auto', end: EndParams | None = None,
                 report_to_gcs: bool = False) -> None:
        self.link = link
        self.telemetry = link.telemetry
        self.gate = gate
        self.texts = StatusTexts()
        self.forwarder = forwarder
        self.blind_landing: Request | None = None
        """The landing requested because no velocity was valid, if any."""
        self.housekeeping = Housekeeping(link, recommendations, estimate_rate, origin,
                                         without_gps=forwarder is not None)
        self.end = FlightEnd(end)
        self.takeover = TakeoverWatch()
        self._reported_taker: Taker | None = None  # to the ground station
        self.sticks = StickWatch(self.end.params.stick_override)
        self.requests = Requests(link, self.gate, self.housekeeping, self.texts,
                                 self.end, require_failsafe)
        self.status = self.requests.status
        self.motion: tuple[OdometryState, float] | None = None
        """The motion by the attitude during flight without odometry, and its time, s."""
        self.handover: Request | None = None
        """The last request by which the bridge itself ended a flight, if any."""
        self.ground_station = GroundStationReport()
        self._reports = report_to_gcs
        gate.autopilot = gate.autopilot._replace(fused=forwarder is not None)
        self._wind_compensation = wind_compensation
        self._start = self._streaming_since = now
        self._last_sent = -math.inf
        self._blind_action = blind_action
        self._last_command: AcceptedCommand | None = None
        self._armed: bool | None = None
        self._stopping_since = math.inf
        self._vehicle = 0, 0  # reboots, and changes of the vehicle
        self._takers: dict[str, Callable[[Any, float], object]] = {
            'STATUSTEXT': self.texts.add, 'EVENT': self.texts.add_event,
            'COMMAND_ACK': self.requests.acknowledge, 'TIMESYNC': self.housekeeping.take_timesync,
            **dict.fromkeys(KINDS, lambda message, now: self.sticks.take(
                message, now, self.telemetry.transmitter_lost(now))),
            # Each reboot begins another check.
            'PARAM_VALUE': lambda message, _: self.housekeeping.parameters.take(message),
            'PARAM_ERROR': lambda message, _: self.housekeeping.parameters.take_error(message),
            'AUTOPILOT_VERSION': lambda message, _: self.housekeeping.parameters.take_version(
                message)}

    def alive(self, now: float) -> bool:
        """Return whether the autopilot is connected."""
        return self.telemetry.alive(now, self.gate.limits.link_timeout)

    def state(self, now: float) -> str:
        """Return the text of ``mavlink_bridge/state`` at ``now``, s: the state and its reason."""
        permission = self.gate.permission
        announced, idle = permission.announcement(), permission.phase is Phase.INACTIVE
        if idle and (unreceived := self.housekeeping.unreceived_reason(now)):
            announced = f'{permission.phase.value}: {unreceived}'
        return first_reason(
            (self.telemetry.dialect is None, f'{NO_AUTOPILOT}: no HEARTBEAT yet'),
            (not self.alive(now), f'{NO_AUTOPILOT}: {LOST}{announced} before'), (True, announced))

    def withheld(self) -> str:
        """Return why no setpoint may be sent, or ''."""
        return NOT_RECEIVED if self.telemetry.dialect is None else self.gate.withheld

    def forward(self, state: OdometryState, time: float, now: float) -> str:
        """
        Take odometry stamped at a time, s, to forward it; return '' or why it is refused.

        The barometer corrects the vertical velocity of the odometry, because the autopilot's
        height follows this velocity, also in the hold mode.
        """
        if self.forwarder is None:
            return ''
        east, north, up = state.velocity.tolist()
        velocity = np.array([east, north, self.gate.corrected_climb_rate(up)])
        return self.forwarder.take(state._replace(velocity=velocity), time, now)

    def velocity_fault(self, now: float) -> str:
        """Return why the autopilot's own velocity is invalid, or ''."""
        forwarded = math.inf if self.forwarder is None else self.forwarder.silence(now)
        return estimator_health.velocity_fault(
            self.telemetry.estimator, self.telemetry.gps, forwarded, now)

    def refusal(self, now: float) -> str:
        """Return why ``offboard`` would be refused after a take-off, if known, or ''."""
        return self.requests.offboard_obstacle(now, bool(self.telemetry.is_flying(now)))

    def unready(self, now: float) -> str | None:
        """Return the reasons against the service ``arm``, or ''; None: unknown."""
        status, dialect = self.status(now), self.telemetry.dialect
        if status is None or dialect is None or status.armed or (
                not self.housekeeping.has_reasons(now)):
            return None
        against = self.texts.unready(now, dialect.arming_mode(status.mode))
        return against and estimator_health.explain_refusal(against, self.telemetry.estimator, now)

    # The setpoint thread.

    def receive(self, now: float) -> list[Any]:
        """Take the data that have arrived, and return the autopilot's messages."""
        messages = self.link.receive(now)
        for message in messages:
            self._take(message, now)
        position, attitude = self.telemetry.local_position, self.telemetry.attitude
        if position is not None and position.time == now:
            gps = self.telemetry.gps
            report = MotionReport(position.velocity, position=position.position,
                                  std=0.0 if gps is None else gps.accuracy)
            if refused := self.velocity_fault(now) or self.gate.take_motion(
                    AUTOPILOT, report, self._age(position, now), now):
                self.link.ignored[f'LOCAL_POSITION_NED {refused}'] += 1
        if attitude is not None and attitude.time == now:
            time = now - self._age(attitude, now)
            self.gate.motion.take_yaw(AUTOPILOT, yaw_from_quaternion(attitude.quaternion), time)
            motion = self.gate.take_attitude(
                attitude.quaternion, attitude.angular_velocity, time, now)
            self.motion = None if motion is None else (motion, time)
        altitude, battery = self.telemetry.sensor_altitude, self.telemetry.battery
        if altitude is not None and altitude.time == now and (
                refused := self.gate.take_height(altitude.altitude, now, altitude.source)):
            self.link.ignored[f'{altitude.source} {refused}'] += 1
        if battery is not None and battery.time == now:
            self.end.take_battery(battery.remaining, now)
        return messages

    def _age(self, estimate: LocalPosition | Attitude, now: float) -> float:
        return self.housekeeping.timesync.age(estimate.time_boot_ms, to_nanoseconds(now))

    def _take(self, message: Any, now: float) -> None:
        self.takeover.take(message, self.telemetry.dialect, now)
        if (status := self.telemetry.shown(message)) is not None:
            # Each one: of two that arrive at once, the first may show that the pilot took over.
            self._take_status(status, now)
        elif message.get_type() in self._takers:
            self._takers[message.get_type()](message, now)

    def cycle(self, now: float) -> Cycle:
        """Send the messages due at ``now``: a setpoint, HEARTBEAT, commands and requests."""
        status = self.telemetry.status
        if (dialect := self.telemetry.dialect) is not None:
            self.gate.autopilot = AutopilotTraits(
                dialect.hover_thrust, self._wind_compensation == 'always' or (
                    self._wind_compensation == 'auto' and not dialect.compensates_wind),
                self.forwarder is not None)
        if status is not None:
            self._take_status(status, now)
            self._refer_height(status, now)
        flew = self.gate.flies
        setpoint, accepted = self._decide(now)
        if flew and not self.gate.flies:
            self._fell_silent(now)
        # TCP buffers data: no setpoint is queued while the link is dead.
        late = self.link.transport.delivers_late and not self.alive(now)
        sent = setpoint.kind != NONE and not late and self.link.send(
            self._message(setpoint.acceleration, setpoint, now))
        if sent:
            self._streaming_since = now if not self._streaming_for(now) else self._streaming_since
            self._last_sent = now
        self.send_odometry(now)
        self.housekeeping.step(now, self.alive(now))
        for change in self.housekeeping.changes():
            self.ground_station.take_warning(change)
        self.requests.step(self._streaming_for(now), now)
        self._end_flight(now)
        # On a line too slow for all, setpoints go first.
        if self._reports and self.alive(now) and not self.link.transport.is_congested():
            for message in self.ground_station.due(self._boot_time(now), now):
                self.link.send(message)
        first = accepted if sent and accepted is not self._last_command else None
        self._last_command = first or self._last_command
        return Cycle(setpoint, sent, first)

    def _decide(self, now: float) -> tuple[Setpoint, AcceptedCommand | None]:
        return self.gate.decide(now, self.telemetry.silence(now), self.withheld(),
                                self.velocity_fault(now), self.telemetry.mode_age(now))

    def _message(self, acceleration: ArrayLike, setpoint: Setpoint, now: float) -> Any:
        return encode_setpoint(acceleration, setpoint.yaw, self._boot_time(now),
                               self.link.target_system, AUTOPILOT_COMPONENT)

    def _boot_time(self, now: float) -> int:
        """Return the ``time_boot_ms`` of messages sent at ``now``, s: ms since the start."""
        return round((now - self._start) * 1e3) % 2**32

    def _streaming_for(self, now: float) -> float:
        """Return the time for which setpoints have been sent without a gap, s."""
        broken = now - self._last_sent > 1.0 / MINIMUM_STREAM_RATE
        return 0.0 if broken else now - self._streaming_since

    def _fell_silent(self, now: float) -> None:
        # A landing that has ended the permission is the end of the flight, not a loss.
        if self.gate.permission.cause is not Cause.SILENT:
            return
        self.ground_station.take_handover(self.gate.permission.reason)
        # While the mode is unknown the pilot may have taken over: nothing is requested. Nor does a
        # landing replace the mode requested for a stick that moved.
        if self._blind_action == 'land' and self.status(now) is not None and (
                self.end.handover.cause is not Cause.STICK):
            self.blind_landing = self.requests.pending if self.requests.landing else (
                self.requests.begin(commands.land, now, end=Handover(
                    self.gate.permission.reason, cause=Cause.SILENT)))

    def _forget_ended_flight(self, status: VehicleStatus) -> None:
        """Report the requests that ended a flight during this flight only."""
        newest = self.requests.newest
        by_operator = newest is not None and newest is not self.blind_landing and not newest.own
        if by_operator or not status.armed:
            self.blind_landing = None
        if not status.armed:
            self.handover = None

    def _refer_height(self, status: VehicleStatus, now: float) -> None:
        """Set height 0: the place of arming, or home if the arming was not observed."""
        heights, left = self.gate.heights, self.telemetry.has_left_ground(now)
        armed_now, self._armed = status.armed and self._armed is False, status.armed
        if not status.armed:
            heights.refer(None, now)
        elif armed_now or (not heights.has_reference and left is False):
            heights.refer(0.0, now)
        elif not heights.has_reference and left and (
                (above := self.telemetry.height_above_home(now)) is not None):
            heights.refer(above, now)

    def _end_flight(self, now: float) -> None:
        """Request the hold mode or a landing if the flight must end."""
        flies, pending, status = self.gate.flies, self.requests.pending, self.status(now)
        handover, newest = self.handover, self.requests.newest
        if status is None:
            return  # The pilot may have switched modes: a request would take the vehicle back.
        self._forget_ended_flight(status)
        end = self.end.reason(
            self.gate.active_since, self.gate.commands.received,
            self.gate.handover(now) if flies else '', now)
        if moved := self.sticks.has_moved and self.housekeeping.watches_sticks():
            end = Handover(STICK.text, cause=Cause.STICK)
            if self.end.handover.cause is not Cause.STICK and newest is not None and (
                    newest.own and now - newest.began <= STICK_GAP and (
                        status.offboard or status.mode in newest.current.modes)):
                # The stick began to move before the bridge requested that mode by itself.
                self.end.begin()
                flies, pending = True, None
        held = ''
        if handover is not None and handover.outcome is not None and handover.outcome.success:
            held, *_ = handover.current.modes
        ask = self.end.step(flies, pending is not None and pending.goal.ends_flight, end, held,
                            status, now)
        if ask and not self.requests.stopping:
            stop = partial(commands.position, lands=self.blind_landing is not None) if moved else (
                commands.hold)
            self.handover = self.requests.begin(
                stop if ask == HOLD else commands.land, now, end=self.end.handover)
            self.ground_station.take_handover(self.end.why)

    def send_odometry(self, now: float) -> None:
        """Send the odometry that is queued for forwarding."""
        if self.forwarder is None or self.telemetry.dialect is None:
            return
        if self.housekeeping.origin.awaited:
            self.forwarder.withhold()
            return
        for message in self.forwarder.messages(self.telemetry.dialect, now):
            # On a line too slow for both, setpoints go first.
            room = not self.link.transport.is_congested()
            self.forwarder.sent(room and self.link.send(message), now)

    def stop(self, now: float) -> None:
        """Accept no more commands: the following cycles brake."""
        self._stopping_since = now
        self.requests.stopping = True
        self.gate.permit(self.gate.permission.end('the bridge is stopping'))

    def has_stopped(self, now: float) -> bool:
        """Return whether the end begun by ``stop`` is complete."""
        return not self.gate.flies or (self.gate.speed(now) or 0.0) < REST_SPEED or (
            now - self._stopping_since >= STOP_TIMEOUT)

    def finish(self, now: float) -> None:
        """
        Send the final messages.

        A vehicle that still flies our setpoints receives a command. If a pending request ends the
        flight (a landing, or the pilot's mode after a moved stick), its command is sent again;
        else the command of the pilot's mode if a stick moved, or of the hold mode. While the mode
        is unknown, no command is sent. The last message is a level setpoint, because autopilots
        obey it for up to seconds: a braking setpoint would make the vehicle fly backwards after it
        has stopped.
        """
        # While the line is silent, or the mode unknown, the pilot may have taken over.
        if self.telemetry.dialect is not None and self.gate.flies and (
                self.status(now) is not None):
            pending = self.requests.pending
            ends = pending is not None and pending.goal.ends_flight and pending.current.modes
            moved = self.sticks.has_moved and self.housekeeping.watches_sticks()
            goal = pending.current if pending is not None and ends else (
                commands.position if moved else commands.hold)(self.telemetry.dialect)
            self.link.send_command(goal.command, goal.params)
        setpoint, _ = self._decide(now)
        if setpoint.kind != NONE:
            self.link.send(self._message(np.zeros(3), setpoint, now))

    def _take_status(self, status: VehicleStatus, now: float) -> None:
        """Pass the status in a HEARTBEAT or CURRENT_MODE to the permission."""
        before, self._vehicle = self._vehicle, (self.telemetry.reboots, self.link.peer_changes)
        if before != self._vehicle:
            if before[1] != self._vehicle[1] and self.requests.pending is not None:
                self.requests.pending.refuse(_OTHER_VEHICLE)
            self.gate.permit(self.gate.permission.reset(
                'the autopilot rebooted' if before[0] != self._vehicle[0] else _OTHER_VEHICLE))
        flew = self.gate.permission.flies
        self.gate.take_status(status, self.telemetry.mode_time, self.telemetry.is_flying(now))
        if self.gate.permission.flies and not flew:
            self.sticks.begin(now)
        if self.gate.permission.phase is not Phase.TAKEN_OVER:
            self._reported_taker = None
        self._attribute_takeover(now)
        self.requests.observe(status)

    def _attribute_takeover(self, now: float) -> None:
        """Determine who has taken over; report it once known, or after EVIDENCE_AFTER."""
        permission, dialect = self.gate.permission, self.telemetry.dialect
        if permission.phase is not Phase.TAKEN_OVER or permission.taker in (PILOT, STICK) or (
                dialect is None):
            return
        taker = self.takeover.taker(dialect, permission.received)
        if now - permission.received > EVIDENCE_AFTER and taker != PILOT:
            taker = permission.taker  # later evidence belongs to another failsafe
        self.gate.permit(permission.name_taker(taker, now))
        settled = taker not in (UNKNOWN, failsafe(UNNAMED)) or (
            now - permission.received > EVIDENCE_AFTER)
        if settled and taker != self._reported_taker:
            self._reported_taker = taker
            self.ground_station.take_handover(taker.text)
