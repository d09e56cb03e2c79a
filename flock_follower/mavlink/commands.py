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
One request to the autopilot: a mode, arming, a take-off, a landing.

An ACK does not prove success: PX4 answers DO_SET_MODE with two ACKs, and the first is always
ACCEPTED. A request succeeds when telemetry shows the result (the mode in HEARTBEAT, the height
after a take-off). If telemetry does not show the result, the ACK and the autopilot's STATUSTEXT
give the reason. A HEARTBEAT from before the command does not count.

A pilot may switch the mode after a command. So a command is sent again only when a new report
shows that the mode has not changed; without reports it is sent during BURST_TIME only.

``Goal`` is the requested state, ``Request`` the state machine that pursues it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.mavlink.dialects import Dialect, enum_name
from flock_follower.mavlink.status_texts import StatusTexts
from flock_follower.ranges import first_reason

#: How long to wait for HEARTBEAT (1 Hz) to show the result, s.
CONFIRM_TIMEOUT: Final[float] = 3.5
#: An unanswered command is sent again after this, s ...
RESEND_PERIOD: Final[float] = 1.0
#: ... if the newest report of the mode is at most this old, s: a cycle at 5 Hz.
NEW_REPORT: Final[float] = 0.25
#: What ends a flight is sent in each cycle for this long, s, until an answer or a report comes; no
#: pilot switches as soon as that.
BURST_TIME: Final[float] = 0.12
#: After a refusal, wait this long for the text that explains it, s.
REASON_WAIT: Final[float] = 0.5
#: Longest delay of a take-off, s; ArduPilot spools up for seconds.
TAKEOFF_DELAY: Final[float] = 10.0
#: Slowest climb of a take-off, m/s.
SLOWEST_CLIMB: Final[float] = 0.3
#: A request fails if its command cannot be sent within this, s.
STREAM_TIMEOUT: Final[float] = 3.0
NOT_RECEIVED: Final[str] = 'no HEARTBEAT from the autopilot'
_SET_MODE: Final[int] = mavlink.MAV_CMD_DO_SET_MODE
_ARM: Final[int] = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
TAKEOFF: Final[int] = mavlink.MAV_CMD_NAV_TAKEOFF


class Vehicle(NamedTuple):
    """State of the vehicle while HEARTBEAT is fresh."""

    status: VehicleStatus
    altitude: float | None = None
    """Altitude above the origin of the local frame, m."""
    shown_time: float = math.inf
    """Time at which HEARTBEAT or CURRENT_MODE last showed the requested state, s."""
    airborne: bool = True
    """Whether the autopilot reports that the vehicle flies; None without a report."""


class Outcome(NamedTuple):
    """The result of a request, with a text for people."""

    success: bool
    message: str


@dataclass(frozen=True, kw_only=True)
class Goal:
    """The goal of a request: its command, and the telemetry that shows the result."""

    name: str
    command: int
    params: tuple[float, ...]
    reached: Callable[[Vehicle], bool]
    modes: tuple[str, ...] = ()
    """The modes during the request; (): any. In another mode the pilot has taken over."""
    ends_flight: bool = False
    """Whether it ends our control of the vehicle; then it is sent without waiting."""
    insists: bool = False
    """Whether the command is sent even if the vehicle is already in the requested state."""
    timeout: float = CONFIRM_TIMEOUT
    """Time to wait for the requested state, s."""
    stream: float = 0.0
    """Time for which setpoints must be sent before the command, s."""
    before: Goal | None = None
    """The goal to reach first."""
    instead: Goal | None = None
    """The goal that replaces this goal if the autopilot refuses it."""
    too_late: Goal | None = None
    """The goal that replaces this goal if it is not reached in time."""


def enter(dialect: Dialect, mode: str, *others: str, ends_flight: bool = False) -> Goal:
    """Return the goal of a mode; if it is refused, the next mode is requested."""
    return Goal(name=mode, command=_SET_MODE, params=dialect.set_mode_parameters(mode),
                reached=lambda vehicle: vehicle.status.mode == mode, modes=(mode,),
                ends_flight=ends_flight,
                instead=enter(dialect, *others, ends_flight=ends_flight) if others else None)


def offboard(dialect: Dialect) -> Goal:
    """Return the goal of the mode that obeys our setpoints: OFFBOARD, GUIDED."""
    return replace(enter(dialect, dialect.offboard), name='offboard',
                   stream=dialect.stream_before_offboard)


def hold(dialect: Dialect) -> Goal:
    """Return the goal of the hold mode; PX4 has no Hold without a global origin."""
    goal = enter(dialect, dialect.hold, *dialect.hold_instead, ends_flight=True)
    return replace(goal, name='hold', reached=lambda vehicle: not vehicle.status.offboard)


def position(dialect: Dialect, lands: bool = False) -> Goal:
    """Return the goal of the mode that obeys the pilot's sticks, else of hold or landing."""
    modes = dict.fromkeys(filter(None, (
        dialect.position, dialect.land if lands else dialect.hold)))
    return replace(enter(dialect, *modes, ends_flight=True), name='position',
                   reached=lambda vehicle: vehicle.status.mode not in (
                       dialect.offboard, dialect.hold, dialect.land))


def land(dialect: Dialect) -> Goal:
    """Return the goal of landing here: reached when the vehicle descends, not when it is down."""
    return replace(enter(dialect, dialect.land, ends_flight=True), name='land', insists=True)


def arm(dialect: Dialect, value: bool, mode: str = '', streaming: bool = False) -> Goal:
    """
    Return the goal of arming or disarming; disarming in the air is refused by autopilots.

    After a landing ArduPilot stays in LAND, and PX4 returns to OFFBOARD or AUTO.TAKEOFF. ArduPilot
    does not arm in LAND. PX4 arms in OFFBOARD only while setpoints are sent (``streaming``), and
    climbs at once if armed in AUTO.TAKEOFF. So in such a ``mode`` the goal first requests another
    mode, and then arms.
    """
    stuck = mode in dialect.unarmable_modes and not (streaming and mode == dialect.offboard)
    return Goal(name='arm' if value else 'disarm', command=_ARM, params=(float(value),),
                reached=lambda vehicle: vehicle.status.armed == value,
                ends_flight=not value, insists=not value,
                before=enter(dialect, *dialect.arming_modes) if value and stuck else None)


def takeoff(dialect: Dialect, height: float, altitude: float, sea_level_altitude: float | None,
            above_home: float) -> Goal:
    """
    Return the goal of climbing by ``height``, m, from the present height.

    Autopilots end a take-off a little below that height. ArduPilot takes off in its offboard mode.
    If the climb takes too long, the vehicle lands, because it could continue to climb.

    :param altitude: present height above the local origin, m.
    :param sea_level_altitude: present height above sea level, m; None if unknown.
    :param above_home: present height above home, m, by the autopilot's estimate.
    """
    enough = altitude + height - max(0.2, 0.1 * height)
    return Goal(
        name='takeoff', command=TAKEOFF,
        params=dialect.takeoff_parameters(height, sea_level_altitude, above_home),
        reached=lambda vehicle: (vehicle.airborne and vehicle.altitude is not None
                                 and vehicle.altitude >= enough),
        modes=dialect.takeoff_modes, timeout=TAKEOFF_DELAY + height / SLOWEST_CLIMB,
        before=replace(offboard(dialect), stream=0.0) if dialect.setpoints_end_takeoff else None,
        too_late=land(dialect))


class Request:
    """
    One request to the autopilot, stepped until it has an ``outcome``.

    It takes every COMMAND_ACK; ``step``, called often, returns whether to send its command.

    :param superseded: the goal of the request that this one replaces; it may still be reached.
    :param own: whether the bridge, not a person, makes the request.
    """

    def __init__(self, dialect: Dialect, goal: Goal, now: float, superseded: Goal | None = None,
                 own: bool = False) -> None:
        self.goal = goal
        self.own, self.began = own, now
        self.outcome: Outcome | None = None
        self._dialect = dialect
        self._superseded = superseded
        self._refused: list[str] = []
        self._shown = ''
        self._left: set[str] = set()  # the modes that were shown, and left
        self._next = goal if goal.before is not None else None
        self._begin(goal.before or goal, now, '')

    def _begin(self, goal: Goal, now: float, mode: str) -> None:
        self.current = goal
        """The present goal: ``goal``, the goal before it, or its replacement."""
        self._since = self._last_sent = now  # since the beginning, then since the first command
        self._attempts = 0
        self._mode = mode  # the vehicle's at the beginning
        self._result: int | None = None
        self._refused_at: float | None = None

    def acknowledge(self, command: int, result: int, now: float) -> bool:
        """Take a COMMAND_ACK; return whether it is the first refusal."""
        if command != self.current.command or not self._attempts:
            return False
        refuses = result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
        if refuses or self._result is None:
            self._result = result
        first = refuses and self._refused_at is None
        self._refused_at = now if first else self._refused_at
        return first

    def step(self, vehicle: Vehicle | None, *, streaming_for: float, texts: StatusTexts,
             now: float) -> int | None:
        """
        Return the confirmation count if the command of ``current`` is to be sent now, else None.

        :param vehicle: its present state, None if no HEARTBEAT is fresh.
        :param streaming_for: time for which setpoints have been sent without a gap, s.
        """
        if self.outcome is not None or (vehicle is not None and self._is_shown(vehicle, now)):
            return None
        if not self._attempts:
            missing = first_reason(
                (vehicle is None and not (
                    self.current.ends_flight and self.current is self.goal), NOT_RECEIVED),
                (streaming_for < self.current.stream,
                 f'no setpoint stream has been running for {self.current.stream} s'))
            if not missing:
                self._since = now
                return self._send(now)
            if now - self._since >= STREAM_TIMEOUT:
                self._finish(False, f'{self.current.name}: {missing}')
            return None
        waited = now - self._since
        # While the vehicle is not received no other mode is requested: a pilot may have switched.
        instead = None if vehicle is None else self.current.instead
        if self._refused_at is not None and now - self._refused_at >= REASON_WAIT:
            self._fail(self._refusal(texts), instead, vehicle, now)
        elif waited >= (CONFIRM_TIMEOUT if self._result is None else self.current.timeout):
            holds = vehicle is not None and vehicle.status.mode == self._dialect.hold
            late = None if holds else self.current.too_late
            self._fail(self._unconfirmed_reason(vehicle, texts), late or instead, vehicle, now)
        elif self._may_repeat(vehicle, now):
            return self._send(now)
        return None

    def _may_repeat(self, vehicle: Vehicle | None, now: float) -> bool:
        """Return whether to send the command again: not if a pilot may have switched since."""
        if vehicle is None or not vehicle.shown_time > self._last_sent:
            return self.current.ends_flight and self._result is None and (
                now - self._since <= BURST_TIME)
        if now - self._last_sent < RESEND_PERIOD or now - vehicle.shown_time > NEW_REPORT:
            return False
        # The ACK does not identify the request: it may answer an earlier mode command. If it
        # answers this one, the pilot may have left the mode between two HEARTBEATs: only a command
        # that ends a flight of our setpoints is sent again.
        return self._result is None or (
            self.current.ends_flight and self.current.command == _SET_MODE
            and (vehicle.status.offboard or self._superseded is not None))

    def observe(self, mode: str) -> None:
        """Take the mode in each report, also of several that arrive together."""
        if mode != self._shown:
            self._left.add(self._shown)
            self._shown = mode

    def refuse(self, message: str) -> Request:
        """End the request with a reason, and return self."""
        self._finish(False, f'{self.goal.name} refused: {message}')
        return self

    def _is_shown(self, vehicle: Vehicle, now: float) -> bool:
        """Return whether the vehicle has reached the goal, so that nothing is sent now, s."""
        self._mode = self._mode or vehicle.status.mode
        self.observe(vehicle.status.mode)
        insists = self.current.insists or self._superseded is not None
        if self.current.reached(vehicle) and (self._attempts or not insists):
            if vehicle.shown_time > self._since:
                self._note_reached(vehicle, now)
                return True
            # The next HEARTBEAT shows whether it is still so.
            if not self._attempts and now - self._since < STREAM_TIMEOUT:
                return True
        if reason := self._overtaken(vehicle):
            self.refuse(reason)
        return bool(reason)

    def _note_reached(self, vehicle: Vehicle, now: float) -> None:
        if self._next is not None:
            goal, self._next = self._next, None
            self._begin(goal, now, vehicle.status.mode)
            return
        duration = f'after {now - self._since:.1f} s' if self._attempts else 'already'
        self._finish(True, f'{self.current.name}: {_status(vehicle)}, {duration}')

    def _fail(self, why: str, instead: Goal | None, vehicle: Vehicle | None, now: float) -> None:
        """Request another goal after a refusal or a timeout, or end."""
        if instead is None or self._result is None:
            self._finish(False, why)
            return
        self._refused.append(why)
        self._begin(instead, now, self._mode if vehicle is None else vehicle.status.mode)

    def _overtaken(self, vehicle: Vehicle) -> str:
        """Return the change of mode by the pilot or a failsafe since the beginning, or ''."""
        status, through = vehicle.status, self._dialect.takeoff_modes
        if self.current.command == TAKEOFF and not status.armed:
            return 'disarmed meanwhile'
        expected = {self._mode, *self.current.modes,
                    *(self._superseded.modes if self._superseded is not None else ()),
                    # One leads to the next.
                    *(through if self._mode in through else ())}
        # Only a pilot returns to a mode, except to the one after a take-off.
        known = status.mode in expected and (status.mode not in self._left or (
            status.mode in through))
        return '' if known or not self.current.modes else (
            f'the mode was changed to {status.mode} meanwhile')

    def _send(self, now: float) -> int:
        self._last_sent = now
        self._attempts += 1
        return min(self._attempts - 1, 255)

    def _refusal(self, texts: StatusTexts) -> str:
        # PX4 reports the failed checks of a mode, or of arming in it.
        modes = (*self.current.modes, '' if self.current.ends_flight else self._mode)
        reasons = '; '.join(texts.why(self._since, modes[0])) or (
            '' if self.current.instead else self._dialect.no_reason)
        result = enum_name('MAV_RESULT', self._result).lower().replace('_', ' ')
        return ': '.join(filter(None, (f'{self.current.name} refused', result, reasons)))

    def _unconfirmed_reason(self, vehicle: Vehicle | None, texts: StatusTexts) -> str:
        shown = 'no HEARTBEAT comes' if vehicle is None else _status(vehicle)
        problem = (f'{self.current.name}: no answer to {self._attempts} commands'
                   if self._result is None else
                   f'{self.current.name} not reached within {self.current.timeout:.1f} s')
        return ': '.join(filter(None, (
            f'{problem}: {shown}', '; '.join(texts.since(self._since)))))

    def _finish(self, success: bool, message: str) -> None:
        abandoned = self.goal.too_late is not None and self.current is self.goal.too_late
        self.outcome = Outcome(success and not abandoned, '; '.join([*self._refused, message]))


def _status(vehicle: Vehicle) -> str:
    armed = 'armed' if vehicle.status.armed else 'disarmed'
    return f'HEARTBEAT shows {vehicle.status.mode}, {armed}'
