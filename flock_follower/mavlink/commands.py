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
Requests a mode, arming or a take-off of the autopilot, and checks that it happened.

An ACK is not enough: PX4 answers DO_SET_MODE with two ACKs, and the first is always ACCEPTED. A
request succeeds when the vehicle shows the result (the mode in HEARTBEAT, the height after a
take-off). If it does not, the result in the ACK and the autopilot's STATUSTEXT give the reason. A
HEARTBEAT from before the command was sent does not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import Dialect, VehicleStatus
from flock_follower.mavlink.status_texts import StatusTexts

#: How long to wait for HEARTBEAT (1 Hz) to show what was asked for, s.
CONFIRM_TIMEOUT: Final[float] = 3.5
#: An unanswered command is sent again after this, s.
RESEND_PERIOD: Final[float] = 1.0
#: After a refusal, wait this long for the text that explains it, s.
REASON_WAIT: Final[float] = 0.5
#: Time to get going, and slowest climb, of a take-off, s and m/s; ArduPilot spools up for seconds.
TAKEOFF_DELAY: Final[float] = 10.0
SLOWEST_CLIMB: Final[float] = 0.3
#: The stream must be running; where it does not start within this, s, the request fails.
STREAM_TIMEOUT: Final[float] = 3.0
_RESULT_PREFIX: Final[str] = 'MAV_RESULT_'


def result_words(result: int) -> str:
    """Return a MAV_RESULT in words: 'temporarily rejected'."""
    entry = mavlink.enums['MAV_RESULT'].get(result)
    if entry is None or not entry.name.startswith(_RESULT_PREFIX):
        return f'result {result}'
    return str(entry.name.removeprefix(_RESULT_PREFIX).lower().replace('_', ' '))


class Vehicle(NamedTuple):
    """What is known of the vehicle while it is heard."""

    dialect: Dialect
    status: VehicleStatus
    altitude: float | None = None
    """m above the origin of its local frame."""
    heard: float = math.inf
    """When it showed that last, by HEARTBEAT or CURRENT_MODE, s."""
    airborne: bool = True
    """Whether it flies, as far as it reports."""


class Outcome(NamedTuple):
    """How a request ended, in words for people."""

    success: bool
    message: str


@dataclass(frozen=True)
class Goal:
    """What is asked for, how, and how the vehicle shows that it has come about."""

    name: str
    command: int
    params: Callable[[Dialect], tuple[float, ...]]
    reached: Callable[[Vehicle], bool]
    needs_stream: bool = False
    """Whether setpoints have to be flowing first, see ``Dialect.stream_before_offboard``."""
    ends_flight: bool = False
    """Whether it takes the vehicle out of our hands: waits for no other request or HEARTBEAT."""
    insists: bool = False
    """Whether it is asked for even where the vehicle seems to be so already."""
    timeout: float = CONFIRM_TIMEOUT
    """How long to wait for the vehicle to show it, s."""
    before: Callable[[Vehicle], Goal | None] = lambda vehicle: None
    """What has to be reached first, by what is known of the vehicle when it is begun."""
    instead: Callable[[Dialect], Goal | None] = lambda dialect: None
    """What is asked for where the autopilot refuses it."""
    abandoned: Goal | None = None
    """What is asked for where it was accepted, and by the end of its time neither came about nor
    left the vehicle in Hold."""
    through: Callable[[Dialect], tuple[str, ...]] | None = None
    """The modes it leads through from that at the beginning; None: any. Another is the pilot's."""
    needs_arming: bool = False
    """Whether it is in vain once the vehicle is disarmed."""


def enter(mode: str, *others: str, ends_flight: bool = False) -> Goal:
    """Return the goal of a mode, by its name, or where that is refused of the next."""
    return Goal(
        mode, mavlink.MAV_CMD_DO_SET_MODE, lambda dialect: dialect.set_mode_parameters(mode),
        lambda vehicle: vehicle.status.mode == mode, ends_flight=ends_flight,
        through=lambda dialect: (mode,),
        instead=lambda dialect: enter(*others, ends_flight=ends_flight) if others else None)


def arm(value: bool, streaming: bool = False) -> Goal:
    """
    Return the goal of arming or disarming; disarming in the air is refused by autopilots.

    After a landing ArduPilot stays in LAND and PX4 returns to OFFBOARD, in which they do not arm
    (PX4 does while ``streaming`` setpoints): another mode first.
    """
    def armable(vehicle: Vehicle) -> Goal | None:
        mode, dialect = vehicle.status.mode, vehicle.dialect
        stuck = mode in dialect.unarmable_modes and not vehicle.status.armed
        return enter(*dialect.arming_modes) if stuck and not (
            streaming and mode == dialect.offboard) else None

    return Goal('arm' if value else 'disarm', mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
                lambda dialect: (1.0 if value else 0.0,),
                lambda vehicle: vehicle.status.armed == value, ends_flight=not value,
                insists=not value, before=armable if value else lambda vehicle: None)


#: The mode that obeys our setpoints: OFFBOARD, GUIDED.
OFFBOARD: Final[Goal] = Goal(
    'offboard', mavlink.MAV_CMD_DO_SET_MODE,
    lambda dialect: dialect.set_mode_parameters(dialect.offboard),
    lambda vehicle: vehicle.status.offboard, needs_stream=True,
    through=lambda dialect: (dialect.offboard,))
#: Out of that mode, into the one that keeps the position; PX4 has none without a global origin.
HOLD: Final[Goal] = Goal(
    'hold', mavlink.MAV_CMD_DO_SET_MODE,
    lambda dialect: dialect.set_mode_parameters(dialect.hold),
    lambda vehicle: not vehicle.status.offboard, ends_flight=True,
    through=lambda dialect: (dialect.hold,),
    instead=lambda dialect: enter(*dialect.hold_instead, ends_flight=True))
#: Landing here: reached when the vehicle descends, not when it is down.
LAND: Final[Goal] = Goal(
    'land', mavlink.MAV_CMD_DO_SET_MODE,
    lambda dialect: dialect.set_mode_parameters(dialect.land),
    lambda vehicle: vehicle.status.mode == vehicle.dialect.land, ends_flight=True, insists=True,
    through=lambda dialect: (dialect.land,))


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
        'takeoff', mavlink.MAV_CMD_NAV_TAKEOFF,
        lambda dialect: dialect.takeoff_parameters(
            height, sea_level_altitude, above_home),
        lambda vehicle: (vehicle.airborne and vehicle.altitude is not None
                         and vehicle.altitude >= enough),
        timeout=TAKEOFF_DELAY + height / SLOWEST_CLIMB,
        before=lambda vehicle: replace(OFFBOARD, needs_stream=False)
        if vehicle.dialect.setpoints_end_takeoff else None,
        # Whatever it climbs to by now, it is not what was asked for.
        through=lambda dialect: dialect.takeoff_modes, needs_arming=True, abandoned=LAND)


class Request:
    """
    One request to the autopilot, stepped until it has an ``outcome``.

    Feed it every COMMAND_ACK and call ``step`` often; it says when to send which command.

    :param superseded: what was still being asked for, and may come about yet.
    :param own: whether the bridge itself asks for it.
    """

    def __init__(self, goal: Goal, now: float, superseded: Goal | None = None,
                 own: bool = False) -> None:
        self.goal = goal
        self.own = own
        self.outcome: Outcome | None = None
        self.current = goal
        """The goal pursued now: ``goal``, or what has to be reached before it, or instead."""
        self._then: Goal | None = None
        self._refused: list[str] = []
        self._failed = False
        self._superseded = superseded
        self._prepared = False
        self._known: Vehicle | None = None
        self._untold = ''
        self._mode = ''
        self.begun = self._start = now
        self._first_sent: float | None = None
        self._last_sent = now
        self._attempts = 0
        self._answered = False
        self._result: int | None = None
        self._refused_at: float | None = None

    @property
    def sent(self) -> bool:
        """Return whether the command of the goal has been sent."""
        return self._first_sent is not None

    def acknowledge(self, command: int, result: int, now: float) -> bool:
        """Take a COMMAND_ACK; return whether it is the first that refuses."""
        if command != self.current.command or self._first_sent is None:
            return False
        self._answered = True
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            return False
        self._result = result
        if result == mavlink.MAV_RESULT_ACCEPTED or self._refused_at is not None:
            return False
        self._refused_at = now
        return True

    def step(self, vehicle: Vehicle | None, *, streaming_for: float, texts: StatusTexts,
             now: float) -> int | None:
        """
        Return the confirmation count with which to send the command of ``current`` now, or None.

        :param vehicle: as known now, None where no HEARTBEAT is fresh.
        :param streaming_for: how long setpoints have been going out without a gap, s.
        """
        if self.outcome is not None:
            return None
        self._known = vehicle or self._known
        if vehicle is not None and not self._prepared:
            self._prepared = True
            self._mode = vehicle.status.mode
            before = self.goal.before(vehicle)
            self._then = self.goal if before else None
            self._begin_step(before or self.goal, now)
        if vehicle is not None and self.current.reached(vehicle):
            if vehicle.heard > (self._start if self._first_sent is None else self._first_sent):
                if self._first_sent is not None or not self._insists():
                    self._reached(vehicle, now)
                    return None
            elif self._first_sent is None and not self._insists() and (
                    now - self._start < STREAM_TIMEOUT):
                return None  # the next HEARTBEAT tells whether it is so still
        if vehicle is not None and (reason := self._overtaken(vehicle)):
            self.refuse(reason)
            return None
        if self._first_sent is None:
            return self._begin(vehicle, streaming_for, now)
        if self._refused_at is not None and now - self._refused_at >= REASON_WAIT:
            self._give_up(self._refusal(texts), vehicle, now)
        elif now - self._first_sent >= self._patience():
            why = self._unconfirmed(vehicle, texts)
            safe = self.current.abandoned
            holds = vehicle is not None and vehicle.status.mode == vehicle.dialect.hold
            if safe is not None and self._answered and not holds:
                self._abandon(why, safe, vehicle, now)
            else:
                self._give_up(why, vehicle, now)
        elif now - self._last_sent >= RESEND_PERIOD and self._unheeded():
            return self._send(now)
        return None

    def refuse(self, message: str) -> Request:
        """End without having asked the autopilot, and return self."""
        self._finish(False, f'{self.goal.name} refused: {message}')
        return self

    def _begin_step(self, goal: Goal, now: float) -> None:
        self.current = goal
        self._start = self._last_sent = now
        self._first_sent = self._result = self._refused_at = None
        self._attempts = 0
        self._answered = False

    def _reached(self, vehicle: Vehicle, now: float) -> None:
        if self._then is not None:
            self._mode = vehicle.status.mode
            goal, self._then = self._then, None
            self._begin_step(goal, now)
        elif self._first_sent is None:
            self._finish(True, f'{self.current.name}: {_shown(vehicle)}, already')
        else:
            self._finish(True, f'{self.current.name}: {_shown(vehicle)}, '
                               f'after {now - self._first_sent:.1f} s')

    def _give_up(self, why: str, vehicle: Vehicle | None, now: float) -> None:
        """Ask for what is to be asked for instead, or end."""
        instead = self.current.instead(vehicle.dialect) if vehicle is not None else None
        if instead is None or not self._answered:
            self._finish(False, '; '.join(filter(None, (why, self._untold))))
            return
        self._refused.append(why)
        self._begin_step(instead, now)

    def _abandon(self, why: str, instead: Goal, vehicle: Vehicle | None, now: float) -> None:
        """Ask for something safe, whatever becomes of it: the goal has failed."""
        self._refused.append(why)
        self._failed = True
        if vehicle is not None:
            self._mode = vehicle.status.mode
        self._begin_step(instead, now)

    def _insists(self) -> bool:
        return self.current.insists or self._superseded is not None

    def _unheeded(self) -> bool:
        # An ACK of a mode command may answer this request or an earlier one: it does not say. If
        # it was this one's, the pilot may have left the mode between two HEARTBEATs: only what
        # ends a flight is asked for again.
        return not self._answered or (
            self.current.ends_flight and self.current.command == mavlink.MAV_CMD_DO_SET_MODE)

    def _overtaken(self, vehicle: Vehicle) -> str:
        """Return what the pilot, or a failsafe, has done meanwhile, or ''."""
        goal, status = self.current, vehicle.status
        if goal.needs_arming and not status.armed:
            return 'disarmed meanwhile'
        if goal.through is None:
            return ''
        expected = {self._mode, *goal.through(vehicle.dialect)}
        if self._superseded is not None and self._superseded.through is not None:
            expected.update(self._superseded.through(vehicle.dialect))
        if self._mode in vehicle.dialect.takeoff_modes:  # one leads on to the next
            expected.update(vehicle.dialect.takeoff_modes)
        if status.mode in expected:
            return ''
        return f'the mode was changed to {status.mode} meanwhile'

    def _begin(self, vehicle: Vehicle | None, streaming_for: float, now: float) -> int | None:
        waited = now - self._start
        if vehicle is None:
            if self.current.ends_flight:  # it may hear us though we do not hear it
                self._first_sent = now
                return self._send(now)
            if waited >= STREAM_TIMEOUT:
                self._finish(False, f'{self.current.name}: no HEARTBEAT from the autopilot')
            return None
        needed = vehicle.dialect.stream_before_offboard
        if self.current.needs_stream and streaming_for < needed:
            if waited >= STREAM_TIMEOUT:
                self._finish(False, f'{self.current.name}: no setpoint stream has been running '
                                    f'for {needed} s')
            return None
        self._first_sent = now
        return self._send(now)

    def _send(self, now: float) -> int:
        self._last_sent = now
        self._attempts += 1
        return min(self._attempts - 1, 255)

    def _patience(self) -> float:
        return self.current.timeout if self._answered else CONFIRM_TIMEOUT

    def _said(self, texts: StatusTexts) -> str:
        said = [] if self._first_sent is None else texts.since(self._first_sent)
        return f': {"; ".join(said)}' if said else ''

    def _refusal(self, texts: StatusTexts) -> str:
        goal, vehicle, mode = self.current, self._known, ''
        if vehicle is not None and not (
                goal.ends_flight and goal.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM):
            mode = goal.through(vehicle.dialect)[0] if goal.through else vehicle.status.mode
        reasons = texts.why(self._start if self._first_sent is None else self._first_sent, mode)
        self._untold = vehicle.dialect.no_reason if vehicle is not None and not reasons else ''
        result = 'no result' if self._result is None else result_words(self._result)
        return f'{goal.name} refused: ' + ': '.join(filter(None, (result, '; '.join(reasons))))

    def _unconfirmed(self, vehicle: Vehicle | None, texts: StatusTexts) -> str:
        goal = self.current
        if not self._answered:
            unreceived = ', and no HEARTBEAT' if vehicle is None else ''
            return (f'{goal.name}: no answer to {self._attempts} commands{unreceived}'
                    f'{self._said(texts)}')
        now_is = 'no HEARTBEAT comes' if vehicle is None else _shown(vehicle)
        return f'{goal.name} not reached within {goal.timeout:.1f} s: {now_is}{self._said(texts)}'

    def _finish(self, success: bool, message: str) -> None:
        self.outcome = Outcome(success and not self._failed,
                               '; '.join([*self._refused, message]))


def _shown(vehicle: Vehicle) -> str:
    armed = 'armed' if vehicle.status.armed else 'disarmed'
    return f'HEARTBEAT shows {vehicle.status.mode}, {armed}'
