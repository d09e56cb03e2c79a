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

An ACK is not enough: PX4 answers DO_SET_MODE with two ACKs, and the first is always ACCEPTED. A
request succeeds when the vehicle shows the result (the mode in HEARTBEAT, the height after a
take-off). If it does not, the result in the ACK and the autopilot's STATUSTEXT give the reason. A
HEARTBEAT from before the command was sent does not count.

``Goal`` is what a request asks for, ``Request`` the state machine that pursues it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import Dialect, enum_name, VehicleStatus
from flock_follower.mavlink.status_texts import StatusTexts
from flock_follower.ranges import first_reason

#: How long to wait for HEARTBEAT (1 Hz) to show the result, s.
CONFIRM_TIMEOUT: Final[float] = 3.5
#: An unanswered command is sent again after this, s.
RESEND_PERIOD: Final[float] = 1.0
#: After a refusal, wait this long for the text that explains it, s.
REASON_WAIT: Final[float] = 0.5
#: Delay and slowest climb of a take-off, s and m/s; ArduPilot spools up for seconds.
TAKEOFF_DELAY: Final[float] = 10.0
SLOWEST_CLIMB: Final[float] = 0.3
#: A request fails if the setpoint stream, or HEARTBEAT, does not start within this, s.
STREAM_TIMEOUT: Final[float] = 3.0
NOT_RECEIVED: Final[str] = 'no HEARTBEAT from the autopilot'
_SET_MODE: Final[int] = mavlink.MAV_CMD_DO_SET_MODE
_ARM: Final[int] = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
TAKEOFF: Final[int] = mavlink.MAV_CMD_NAV_TAKEOFF


class Vehicle(NamedTuple):
    """State of the vehicle while HEARTBEAT is fresh."""

    dialect: Dialect
    status: VehicleStatus
    altitude: float | None = None
    """m above the origin of its local frame."""
    shown_time: float = math.inf
    """When HEARTBEAT or CURRENT_MODE last showed the requested state, s."""
    airborne: bool = True
    """Whether it flies, as far as it reports."""


class Outcome(NamedTuple):
    """The result of a request, in words for people."""

    success: bool
    message: str


@dataclass(frozen=True)
class Goal:
    """A request: its command, and how the vehicle shows that it is fulfilled."""

    name: str
    command: int
    params: Callable[[Dialect], tuple[float, ...]]
    reached: Callable[[Vehicle], bool]
    modes: Callable[[Dialect], tuple[str, ...]] = lambda dialect: ()
    """The modes that it leads through; (): any. In any other mode the pilot has taken over."""
    ends_flight: bool = False
    """Whether it takes the vehicle out of our hands: waits for no other request or HEARTBEAT."""
    insists: bool = False
    """Whether it is requested even if the vehicle already shows it."""
    timeout: float = CONFIRM_TIMEOUT
    """Time to wait for the requested state, s."""
    before: Callable[[Vehicle], Goal | None] = lambda vehicle: None
    """What has to be reached first, by the state of the vehicle when the request begins."""
    instead: Callable[[Dialect], Goal | None] = lambda dialect: None
    """The request that replaces it if the autopilot refuses it."""


def _mode_goal(name: str, mode: Callable[[Dialect], str], **options: Any) -> Goal:
    """Return the goal of entering the mode that ``mode`` returns for a dialect."""
    return Goal(name, _SET_MODE, lambda dialect: dialect.set_mode_parameters(mode(dialect)),
                **{'reached': lambda vehicle: vehicle.status.mode == mode(vehicle.dialect),
                   'modes': lambda dialect: (mode(dialect),), **options})


def enter(mode: str, *others: str, ends_flight: bool = False) -> Goal:
    """Return the goal of a mode; if that is refused, of the next one."""
    return _mode_goal(
        mode, lambda dialect: mode, ends_flight=ends_flight,
        instead=lambda dialect: enter(*others, ends_flight=ends_flight) if others else None)


#: The mode that obeys our setpoints: OFFBOARD, GUIDED.
OFFBOARD: Final[Goal] = _mode_goal('offboard', lambda dialect: dialect.offboard)
#: Out of that mode, into the one that keeps the position; PX4 has none without a global origin.
HOLD: Final[Goal] = _mode_goal(
    'hold', lambda dialect: dialect.hold, ends_flight=True,
    reached=lambda vehicle: not vehicle.status.offboard,
    instead=lambda dialect: enter(*dialect.hold_instead, ends_flight=True))
#: Landing here: reached when the vehicle descends, not when it is down.
LAND: Final[Goal] = _mode_goal(
    'land', lambda dialect: dialect.land, ends_flight=True, insists=True)


def arm(value: bool, streaming: bool = False) -> Goal:
    """
    Return the goal of arming or disarming; disarming in the air is refused by autopilots.

    After a landing ArduPilot stays in LAND, and PX4 returns to OFFBOARD or AUTO.TAKEOFF. ArduPilot
    does not arm in LAND. PX4 arms in OFFBOARD only while ``streaming`` setpoints, and climbs at
    once if armed in AUTO.TAKEOFF. So arming requests another mode first.
    """
    def armable(vehicle: Vehicle) -> Goal | None:
        mode, dialect = vehicle.status.mode, vehicle.dialect
        stuck = mode in dialect.unarmable_modes and not vehicle.status.armed
        return enter(*dialect.arming_modes) if value and stuck and not (
            streaming and mode == dialect.offboard) else None

    return Goal('arm' if value else 'disarm', _ARM, lambda dialect: (float(value),),
                lambda vehicle: vehicle.status.armed == value, ends_flight=not value,
                insists=not value, before=armable)


def takeoff(height: float, altitude: float, sea_level_altitude: float | None,
            above_home: float) -> Goal:
    """
    Return the goal of climbing by ``height``, m, from the present height.

    Nearly: autopilots are content a little below. ArduPilot takes off in its offboard mode.

    :param altitude: present height above the local origin, m.
    :param sea_level_altitude: present height above sea level, m; None if unknown.
    :param above_home: present height above home, m, by the autopilot's estimate.
    """
    enough = altitude + height - max(0.2, 0.1 * height)
    return Goal(
        'takeoff', TAKEOFF,
        lambda dialect: dialect.takeoff_parameters(height, sea_level_altitude, above_home),
        lambda vehicle: (vehicle.airborne and vehicle.altitude is not None
                         and vehicle.altitude >= enough),
        modes=lambda dialect: dialect.takeoff_modes,
        timeout=TAKEOFF_DELAY + height / SLOWEST_CLIMB,
        # A copy of OFFBOARD, which needs no setpoint stream.
        before=lambda vehicle: (
            replace(OFFBOARD) if vehicle.dialect.setpoints_end_takeoff else None))


def result_text(result: int | None) -> str:
    """Return a MAV_RESULT in words: 'temporarily rejected'."""
    name = enum_name('MAV_RESULT', result) or f'result {result}'
    return 'no result' if result is None else name.lower().replace('_', ' ')


class Request:
    """
    One request to the autopilot, stepped until it has an ``outcome``.

    Feed it every COMMAND_ACK and call ``step`` often; it returns when to send which command.

    :param superseded: the goal that was still requested, and may be reached yet.
    :param own: whether the bridge itself makes the request.
    """

    def __init__(self, goal: Goal, now: float, superseded: Goal | None = None,
                 own: bool = False) -> None:
        self.goal = goal
        self.own = own
        self.begun = now
        self.outcome: Outcome | None = None
        self._superseded = superseded
        self._next: Goal | None = None
        self._refused: list[str] = []
        self._known: Vehicle | None = None
        self._advice = ''
        self._mode = ''
        self._begin(goal, now)

    def _begin(self, goal: Goal, now: float) -> None:
        self.current = goal
        """The goal pursued now: ``goal``, or what has to be reached before it, or instead."""
        self._since = self._last_sent = now  # since the beginning, then since the first command
        self._attempts = 0
        self._result: int | None = None
        self._refused_at: float | None = None

    @property
    def sent(self) -> bool:
        """Return whether the command of ``current`` has been sent."""
        return self._attempts > 0

    def acknowledge(self, command: int, result: int, now: float) -> bool:
        """Take a COMMAND_ACK; return whether it is the first that refuses."""
        if command != self.current.command or not self.sent:
            return False
        refuses = result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
        if refuses or self._result is None:
            self._result = result
        if not refuses or self._refused_at is not None:
            return False
        self._refused_at = now
        return True

    def step(self, vehicle: Vehicle | None, *, streaming_for: float, texts: StatusTexts,
             now: float) -> int | None:
        """
        Return the confirmation count with which to send the command of ``current`` now, or None.

        :param vehicle: its state now, None if no HEARTBEAT is fresh.
        :param streaming_for: how long setpoints have been going out without a gap, s.
        """
        if self.outcome is not None:
            return None
        self._known = vehicle or self._known
        if vehicle is not None and not self._mode:
            self._mode = vehicle.status.mode
            before = self.goal.before(vehicle)
            self._next = self.goal if before else None
            self._begin(before or self.goal, now)
        insists = self.current.insists or self._superseded is not None
        if vehicle is not None and self.current.reached(vehicle) and (self.sent or not insists):
            if vehicle.shown_time > self._since:
                self._reached(vehicle, now)
                return None
            if not self.sent and now - self._since < STREAM_TIMEOUT:
                return None  # the next HEARTBEAT shows whether it is still so
        if vehicle is not None and (reason := self._overtaken(vehicle)):
            self.refuse(reason)
            return None
        if not self.sent:
            return self._first(vehicle, streaming_for, now)
        if self._refused_at is not None and now - self._refused_at >= REASON_WAIT:
            self._fail(self._refusal(texts), vehicle, False, now)
        elif now - self._since >= (CONFIRM_TIMEOUT if self._result is None
                                   else self.current.timeout):
            self._fail(self._unconfirmed(vehicle, texts), vehicle, True, now)
        elif now - self._last_sent >= RESEND_PERIOD and (self._result is None or (
                # An ACK of a mode command may answer an earlier one: it does not say. If it was
                # this one's, the pilot may have left the mode between two HEARTBEATs: only what
                # ends a flight is sent again.
                self.current.ends_flight and self.current.command == _SET_MODE)):
            return self._send(now)
        return None

    def refuse(self, message: str) -> Request:
        """End the request with a reason, and return self."""
        self._finish(False, f'{self.goal.name} refused: {message}')
        return self

    def _reached(self, vehicle: Vehicle, now: float) -> None:
        if self._next is not None:
            self._mode = vehicle.status.mode
            goal, self._next = self._next, None
            self._begin(goal, now)
            return
        duration = f'after {now - self._since:.1f} s' if self.sent else 'already'
        self._finish(True, f'{self.current.name}: {_shown(vehicle)}, {duration}')

    def _fail(self, why: str, vehicle: Vehicle | None, late: bool, now: float) -> None:
        """Request something else after a refusal, or after the time is over (``late``); or end."""
        instead = self.current.instead(vehicle.dialect) if vehicle is not None else None
        if late and self.current.command == TAKEOFF and not (
                vehicle is not None and vehicle.status.mode == vehicle.dialect.hold):
            instead = LAND  # it may climb on
        if instead is None or self._result is None:
            self._finish(False, '; '.join(filter(None, (why, self._advice))))
            return
        self._refused.append(why)
        self._mode = vehicle.status.mode if vehicle is not None else self._mode
        self._begin(instead, now)

    def _overtaken(self, vehicle: Vehicle) -> str:
        """Return what the pilot, or a failsafe, has done meanwhile, or ''."""
        status, dialect = vehicle.status, vehicle.dialect
        if self.current.command == TAKEOFF and not status.armed:
            return 'disarmed meanwhile'
        goals = [goal for goal in (self.current, self._superseded) if goal is not None]
        expected = {self._mode, *(mode for goal in goals for mode in goal.modes(dialect)),
                    # One leads on to the next.
                    *(dialect.takeoff_modes if self._mode in dialect.takeoff_modes else ())}
        return '' if status.mode in expected or not self.current.modes(dialect) else (
            f'the mode was changed to {status.mode} meanwhile')

    def _first(self, vehicle: Vehicle | None, streaming_for: float, now: float) -> int | None:
        """Send the command for the first time if its conditions are met; else wait, or end."""
        stream = vehicle.dialect.stream_before_offboard if vehicle is not None else 0.0
        missing = first_reason(
            (vehicle is None and not self.current.ends_flight, NOT_RECEIVED),
            (self.current is OFFBOARD and streaming_for < stream,
             f'no setpoint stream has been running for {stream} s'))
        if not missing:
            self._since = now
            return self._send(now)
        if now - self._since >= STREAM_TIMEOUT:
            self._finish(False, f'{self.current.name}: {missing}')
        return None

    def _send(self, now: float) -> int:
        self._last_sent = now
        self._attempts += 1
        return min(self._attempts - 1, 255)

    def _refusal(self, texts: StatusTexts) -> str:
        goal, vehicle, mode = self.current, self._known, ''
        if vehicle is not None and not (goal.ends_flight and goal.command == _ARM):
            mode, *_ = *goal.modes(vehicle.dialect), vehicle.status.mode
        reasons = texts.why(self._since, mode)
        self._advice = vehicle.dialect.no_reason if vehicle is not None and not reasons else ''
        return f'{goal.name} refused: ' + ': '.join(
            filter(None, (result_text(self._result), '; '.join(reasons))))

    def _unconfirmed(self, vehicle: Vehicle | None, texts: StatusTexts) -> str:
        problem = f'{self.current.name} not reached within {self.current.timeout:.1f} s: ' + (
            'no HEARTBEAT comes' if vehicle is None else _shown(vehicle))
        if self._result is None:
            problem = f'{self.current.name}: no answer to {self._attempts} commands' + (
                ', and no HEARTBEAT' if vehicle is None else '')
        return ': '.join(filter(None, (problem, '; '.join(texts.since(self._since)))))

    def _finish(self, success: bool, message: str) -> None:
        abandoned = self.current is LAND and self.goal is not LAND
        self.outcome = Outcome(success and not abandoned, '; '.join([*self._refused, message]))


def _shown(vehicle: Vehicle) -> str:
    armed = 'armed' if vehicle.status.armed else 'disarmed'
    return f'HEARTBEAT shows {vehicle.status.mode}, {armed}'
