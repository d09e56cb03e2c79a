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
Asking the autopilot for a mode or for arming, and finding out whether it happened.

An ACK is not enough: PX4 answers DO_SET_MODE with two, the first of which always says accepted.
A request has succeeded when HEARTBEAT shows it, and only then; where it does not, the ACK's result
and the autopilot's own words (STATUSTEXT) say why.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from flock_follower.mavlink import px4
from flock_follower.mavlink.px4 import VehicleStatus

#: How long to wait for HEARTBEAT (1 Hz) to show what was asked for, s.
CONFIRM_TIMEOUT: Final[float] = 3.5
#: An unanswered command is sent again after this, s.
RESEND_PERIOD: Final[float] = 1.0
#: After a refusal, wait this long for the text that explains it, s.
REASON_WAIT: Final[float] = 0.5
#: OFFBOARD is asked for once the stream has run this long, s: with a margin for delays on the way.
STREAM_BEFORE_OFFBOARD: Final[float] = px4.STREAM_BEFORE_OFFBOARD + 0.5
#: The stream must be running; where it does not start within this, s, the request fails.
STREAM_TIMEOUT: Final[float] = 3.0
_STATUSTEXT_CHUNK: Final[int] = 50
_RESULT_PREFIX: Final[str] = 'MAV_RESULT_'


def result_words(result: int) -> str:
    """Return a MAV_RESULT in words: 'temporarily rejected'."""
    entry = mavlink.enums['MAV_RESULT'].get(result)
    if entry is None or not entry.name.startswith(_RESULT_PREFIX):
        return f'result {result}'
    return str(entry.name.removeprefix(_RESULT_PREFIX).lower().replace('_', ' '))


class StatusTexts:
    """The autopilot's recent STATUSTEXTs, long ones joined from their chunks of 50 characters."""

    def __init__(self) -> None:
        self._texts: deque[tuple[float, int, str]] = deque(maxlen=50)
        self._chunks: dict[int, list[str]] = {}

    def add(self, message: Any, now: float) -> str | None:
        """Take a STATUSTEXT; return the text once it is complete."""
        piece = str(message.text)
        if message.id:
            chunks = self._chunks.setdefault(message.id, [])
            if message.chunk_seq != len(chunks):  # one was lost: give what there is
                chunks.append('...')
            chunks.append(piece)
            if len(piece) == _STATUSTEXT_CHUNK:
                return None
            piece = ''.join(self._chunks.pop(message.id))
        # PX4 ends texts with a tab where it also sends them as events.
        text = piece.strip('\x00\t\n ')
        self._texts.append((now, message.severity, text))
        return text

    def since(self, time: float, worst: int = mavlink.MAV_SEVERITY_NOTICE) -> list[str]:
        """Return the distinct texts from ``time`` on, of the given severity or worse."""
        return list(dict.fromkeys(
            text for t, severity, text in self._texts if t >= time and severity <= worst))


class Outcome(NamedTuple):
    """How a request ended, in words for people."""

    success: bool
    message: str


@dataclass(frozen=True)
class Goal:
    """What is asked for, how, and how HEARTBEAT shows that it has come about."""

    name: str
    command: int
    params: tuple[float, ...]
    reached: Callable[[VehicleStatus], bool]
    needs_stream: bool = False
    ends_flight: bool = False
    """Whether it takes the vehicle out of our hands, and so waits for no other request."""


def arm(value: bool) -> Goal:
    """Return the goal of arming or disarming; disarming in the air is refused by PX4."""
    return Goal('armed' if value else 'disarmed', mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
                (1.0 if value else 0.0,), lambda status: status.armed == value,
                ends_flight=not value)


def mode(name: str) -> Goal:
    """Return the goal of a PX4 flight mode, see ``px4.MODES``; OFFBOARD waits for the stream."""
    main, sub = px4.MODES[name]
    return Goal(name, mavlink.MAV_CMD_DO_SET_MODE,
                (float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(main), float(sub)),
                lambda status: status.mode == name, needs_stream=name == px4.OFFBOARD)


def leave_offboard() -> Goal:
    """Return the goal of leaving OFFBOARD for Hold, which keeps the position."""
    hold = mode(px4.HOLD)
    return Goal('out of OFFBOARD', hold.command, hold.params, lambda status: not status.offboard,
                ends_flight=True)


class Request:
    """
    One request to the autopilot, stepped until it has an ``outcome``.

    Feed it every COMMAND_ACK and call ``step`` often; it says when to send the command.
    """

    def __init__(self, goal: Goal, now: float) -> None:
        self.goal = goal
        self.outcome: Outcome | None = None
        self._start = now
        self._first_sent: float | None = None
        self._last_sent = now
        self._attempts = 0
        self._answered = False
        self._result: int | None = None
        self._refused_at: float | None = None

    def acknowledge(self, command: int, result: int, now: float) -> None:
        """Take a COMMAND_ACK."""
        if command != self.goal.command or self._first_sent is None:
            return
        self._answered = True
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            return
        self._result = result
        if result != mavlink.MAV_RESULT_ACCEPTED and self._refused_at is None:
            self._refused_at = now

    def step(self, status: VehicleStatus | None, *, streaming_for: float, texts: StatusTexts,
             now: float) -> int | None:
        """
        Return the confirmation count with which to send the command now, or None.

        :param status: from the newest HEARTBEAT, None where none is fresh.
        :param streaming_for: how long setpoints have been going out without a gap, s.
        """
        if self.outcome is not None:
            return None
        if status is not None and self.goal.reached(status):
            if self._first_sent is None:
                self._finish(True, f'already {self.goal.name}')
            else:
                self._finish(True, f'{self.goal.name}: HEARTBEAT shows {status.mode}, '
                                   f'{_armed(status)}, after {now - self._first_sent:.1f} s')
            return None
        if self._first_sent is None:
            return self._begin(status, streaming_for, now)
        if self._refused_at is not None and now - self._refused_at >= REASON_WAIT:
            self._finish(False, self._refusal(texts))
        elif now - self._first_sent >= CONFIRM_TIMEOUT:
            self._finish(False, self._unconfirmed(status, texts))
        elif not self._answered and now - self._last_sent >= RESEND_PERIOD:
            return self._send(now)
        return None

    def _begin(self, status: VehicleStatus | None, streaming_for: float,
               now: float) -> int | None:
        waited = now - self._start
        if status is None:
            if waited >= STREAM_TIMEOUT:
                self._finish(False, f'{self.goal.name}: no HEARTBEAT from the autopilot')
            return None
        if self.goal.needs_stream and streaming_for < STREAM_BEFORE_OFFBOARD:
            if waited >= STREAM_TIMEOUT:
                self._finish(False, f'{self.goal.name}: no setpoint stream has been running for '
                                    f'{STREAM_BEFORE_OFFBOARD} s')
            return None
        self._first_sent = now
        return self._send(now)

    def _send(self, now: float) -> int:
        self._last_sent = now
        self._attempts += 1
        return min(self._attempts - 1, 255)

    def _said(self, texts: StatusTexts) -> str:
        said = [] if self._first_sent is None else texts.since(self._first_sent)
        return f': {"; ".join(said)}' if said else ''

    def _refusal(self, texts: StatusTexts) -> str:
        result = 'no result' if self._result is None else result_words(self._result)
        return f'{self.goal.name} refused: {result}{self._said(texts)}'

    def _unconfirmed(self, status: VehicleStatus | None, texts: StatusTexts) -> str:
        if not self._answered:
            return (f'{self.goal.name}: no answer to {self._attempts} commands'
                    f'{self._said(texts)}')
        now_is = 'no HEARTBEAT comes' if status is None else (
            f'it shows {status.mode}, {_armed(status)}')
        return (f'{self.goal.name} not shown by HEARTBEAT within {CONFIRM_TIMEOUT} s: {now_is}'
                f'{self._said(texts)}')

    def refuse(self, message: str) -> Request:
        """End without having asked the autopilot, and return self."""
        self._finish(False, f'{self.goal.name} refused: {message}')
        return self

    def _finish(self, success: bool, message: str) -> None:
        self.outcome = Outcome(success, message)


def _armed(status: VehicleStatus) -> str:
    return 'armed' if status.armed else 'disarmed'
