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
The questions to the autopilot, and its answers: without an answer the value is unknown.

``sent`` and ``take`` recognize questions and answers in the messages themselves, so every question
is counted. Only a message that the autopilot sends because of our message is an answer: telemetry
also arrives if our transmit wire is cut. Times are s.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import enum_name

#: After this time without any answer, s, the line works one way only.
PATIENCE: Final[float] = 3.0
#: It does so after this many questions at least.
TRIES: Final[int] = 3
NO_ANSWER: Final[str] = (
    'the autopilot answers none of our messages: transmit wire, port, system id')
TIMESYNC: Final[str] = 'TIMESYNC'
RATES: Final[str] = 'message rates'
REASONS: Final[str] = 'reasons against arming'
#: Messages that are requested as such, and that are their own answers.
_MESSAGES: Final[dict[int, str]] = {
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: 'AUTOPILOT_VERSION',
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 'GPS_GLOBAL_ORIGIN',
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 'HOME_POSITION'}
_REQUESTS: Final = (mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)


@dataclass
class Question:
    """One question; ``tries`` and ``since``, s, count from the first try after an answer."""

    tries: int = 0
    since: float = math.inf
    answered: float = -math.inf
    """Time of the newest answer, s."""

    def ask(self, now: float) -> None:
        """Count a try at ``now``."""
        self.tries += 1
        self.since = min(self.since, now)

    def answer(self, now: float) -> None:
        """Take an answer at ``now``."""
        self.tries, self.since, self.answered = 0, math.inf, now

    def is_ignored(self, now: float) -> bool:
        """Return whether the question got no answer after enough tries and time."""
        return self.tries >= TRIES and now - self.since >= PATIENCE


class LinkQuestions:
    """
    The questions of one link to its autopilot.

    :param source: our own system and component id, to which answers are addressed.
    """

    def __init__(self, source: tuple[int, int]) -> None:
        self._source = source
        self._times: deque[int] = deque(maxlen=10)  # of our TIMESYNCs, ns
        self._questions: dict[str, Question] = {}
        self._any = Question()

    def begin_again(self) -> None:
        """Forget all answers: the autopilot has rebooted, or was replaced."""
        self._questions, self._any = {}, Question()

    def pause(self) -> None:
        """Stop counting the questions from before a loss of the link; keep the answers."""
        for question in (self._any, *self._questions.values()):
            question.tries, question.since = 0, math.inf

    def sent(self, message: Any, now: float) -> None:
        """Take a message of ours."""
        for name in self._asks(message):
            self._questions.setdefault(name, Question()).ask(now)
            self._any.ask(now)

    def take(self, message: Any, now: float) -> None:
        """Take a message of the autopilot."""
        kind = message.get_type()
        name = kind if kind in _MESSAGES.values() else ''
        if kind == 'TIMESYNC':
            name = TIMESYNC if message.tc1 and message.ts1 in self._times else ''
        elif kind in ('PARAM_VALUE', 'PARAM_ERROR'):
            name = parameter_question(message.param_id)
        elif kind == 'COMMAND_ACK' and self.is_addressed(message):
            self._any.answer(now)
            # A refusal is an answer, too; but a refused request for the reasons names none.
            done = message.command != mavlink.MAV_CMD_RUN_PREARM_CHECKS or (
                message.result == mavlink.MAV_RESULT_ACCEPTED)
            name = _command(message.command) if done else ''
        if name in self._questions:
            # Autopilots send these two without a question, too.
            if kind not in ('HOME_POSITION', 'GPS_GLOBAL_ORIGIN'):
                self._any.answer(now)
            self._questions[name].answer(now)

    def answer_time(self, name: str) -> float:
        """Return the time of the newest answer to a question, s; minus infinity if none."""
        question = self._questions.get(name)
        return -math.inf if question is None else question.answered

    def unknown(self, now: float) -> list[str]:
        """Return the questions without a valid answer."""
        # A copy: diagnostics read them from another thread.
        return [name for name, question in self._questions.copy().items()
                if question.tries and (math.isinf(question.answered) or question.is_ignored(now))]

    def is_unanswered(self, now: float) -> bool:
        """Return whether the autopilot answers nothing."""
        return self._any.is_ignored(now)

    def _asks(self, message: Any) -> list[str]:
        """Return the questions in a message of ours."""
        kind = message.get_type()
        if kind == 'TIMESYNC' and not message.tc1:
            self._times.append(message.ts1)
            return [TIMESYNC]
        if kind == 'PARAM_REQUEST_READ':
            return [parameter_question(message.param_id)]
        if kind == 'SET_GPS_GLOBAL_ORIGIN':
            return ['GPS_GLOBAL_ORIGIN']
        if kind != 'COMMAND_LONG':
            return []
        name = _command(message.command)
        if message.command not in _REQUESTS:
            return [name]
        requested = _MESSAGES.get(int(message.param1), '')
        return [*filter(None, (name if name == RATES else '', requested))] or [name]

    def is_addressed(self, ack: Any) -> bool:
        """Return whether a COMMAND_ACK is for us; in MAVLink 1 its target is 0."""
        return all(target in (0, own) for target, own in zip(
            (ack.target_system, ack.target_component), self._source))


def parameter_question(name: str | bytes) -> str:
    """Return the question for the value of a parameter."""
    text = name.decode('ascii', 'replace') if isinstance(name, bytes) else name
    return 'parameter ' + text.rstrip('\0')


def _command(command: int) -> str:
    return {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: RATES,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: REASONS}.get(command) or enum_name(
                'MAV_CMD', command)
