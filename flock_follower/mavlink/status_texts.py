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
The autopilot's own words: STATUSTEXT messages, long texts joined from their chunks.

Where PX4 hears no ground station, and says nothing, its EVENTs stand in: see ``px4_events``.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.px4_events import ArmingChecks

#: Characters of one STATUSTEXT; a shorter chunk is the last of its text.
CHUNK: Final[int] = 50
#: A text whose next chunk does not come within this, s, is taken as it is.
CHUNK_TIMEOUT: Final[float] = 0.4
#: A text of more chunks than this, and more unfinished texts than this, are taken as they are.
MOST_CHUNKS: Final[int] = 20
MOST_UNFINISHED: Final[int] = 5
#: ArduPilot repeats what keeps it from arming, marked so, every 30 s.
PREARM: Final[str] = 'PreArm: '
PREARM_PERIOD: Final[float] = 35.0
#: Stands for what was lost.
GAP: Final[str] = '...'


class AutopilotText(NamedTuple):
    """One whole text."""

    time: float
    """When it was complete, s."""
    severity: int
    """MAV_SEVERITY: the smaller, the worse."""
    text: str


@dataclass
class _Unfinished:
    severity: int
    time: float
    """When the newest of its chunks came, s."""
    next_chunk: int = 0
    pieces: list[str] = field(default_factory=list)


class StatusTexts:
    """
    The recent texts; ``add`` takes messages, ``since`` and ``new`` return whole texts.

    Every chunk that arrives is told, with ``GAP`` where another was lost. Nothing waits for long:
    a text of just 50 characters, or a multiple, may come without a chunk that ends it.
    """

    def __init__(self) -> None:
        self.checks = ArmingChecks()
        self._said = False
        self._texts: deque[AutopilotText] = deque(maxlen=50)
        self._new: deque[AutopilotText] = deque(maxlen=200)
        self._unfinished: dict[int, _Unfinished] = {}

    def add(self, message: Any, now: float) -> str | None:
        """Take a STATUSTEXT; return the text once it is complete."""
        self._said = True
        number, chunk, piece = message.id, message.chunk_seq, str(message.text)
        self._expire(now)
        if not number:
            return self._finish(message.severity, piece, now)
        known = self._unfinished.get(number)
        if known is not None and chunk < known.next_chunk:  # its end was lost, another text begins
            self._give_up(number, now)
            known = None
        if known is None:
            if len(self._unfinished) >= MOST_UNFINISHED:
                self._give_up(next(iter(self._unfinished)), now)
            known = self._unfinished[number] = _Unfinished(message.severity, now)
        if chunk != known.next_chunk:
            known.pieces.append(GAP)
        known.pieces.append(piece)
        known.next_chunk, known.time = chunk + 1, now
        if len(piece) == CHUNK and known.next_chunk < MOST_CHUNKS:
            return None
        del self._unfinished[number]
        return self._finish(known.severity, ''.join(known.pieces), now)

    def add_event(self, message: Any, now: float) -> None:
        """Take an EVENT; its words count where no STATUSTEXT says the same."""
        words = self.checks.take(message, now)
        if words and not self._said:
            self._finish(message.log_levels & 0xF, words, now)

    def why(self, time: float, mode: str) -> list[str]:
        """Return what was said from ``time`` on, and what was last reported against a mode."""
        return list(dict.fromkeys([*self.since(time), *self.checks.against(mode)]))

    def unready(self, now: float, mode: str) -> str:
        """Return what was said of late, or last reported, against arming in a mode, or ''."""
        said = [text.text.partition(PREARM)[2] for text in list(self._texts)
                if PREARM in text.text and now - text.time <= PREARM_PERIOD]
        return '; '.join(dict.fromkeys([*said, *self.checks.against(mode)]))

    def since(self, time: float, worst: int = mavlink.MAV_SEVERITY_NOTICE) -> list[str]:
        """Return the distinct texts from ``time`` on, of the given severity or worse."""
        return list(dict.fromkeys(
            text for t, severity, text in self._texts if t >= time and severity <= worst))

    def new(self, now: float) -> list[AutopilotText]:
        """Return the texts that were completed, or given up, since the last call."""
        self._expire(now)
        texts = list(self._new)
        self._new.clear()
        return texts

    def _expire(self, now: float) -> None:
        for number in [number for number, unfinished in self._unfinished.items()
                       if now - unfinished.time > CHUNK_TIMEOUT]:
            self._give_up(number, now)

    def _give_up(self, number: int, now: float) -> None:
        """Take a text as it is; whether more was to come is not known."""
        unfinished = self._unfinished.pop(number)
        self._finish(unfinished.severity, ''.join([*unfinished.pieces, GAP]), now)

    def _finish(self, severity: int, text: str, now: float) -> str:
        # PX4 ends texts with a tab where it also sends them as events.
        text = text.strip('\x00\t\n ')
        for texts in (self._texts, self._new):
            texts.append(AutopilotText(now, severity, text))
        return text
