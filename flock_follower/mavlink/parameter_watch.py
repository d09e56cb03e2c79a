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
Detects that a parameter of the autopilot changes in flight, although a rule depends on it.

``offboard`` was permitted with the values at take-off: failsafe, frame, source of the height. A
change is reported, and the flight continues. The next ``offboard`` is refused until the value is
restored or the vehicle is disarmed. Times are s.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

#: Every parameter that a rule depends on is read again after this, s: two readings, one of which
#: may be lost, show a change within 5 s.
WATCH_PERIOD: Final[float] = 2.0
#: Its value is unknown after so many requests without an answer.
UNKNOWN_AFTER: Final[int] = 4
CHANGED: Final[str] = 'changed in flight'
_REMEDY: Final[str] = 'set it back, or land and disarm'


class ParameterWatch:
    """The values of a flight: the values at arming, or the first values that were read later."""

    def __init__(self) -> None:
        self._flown: dict[str, float] = {}
        self._changes: dict[str, tuple[float, float]] = {}

    def step(self, values: Mapping[str, float], names: Iterable[str], armed: bool) -> list[str]:
        """
        Take the newest values; return each new change as text.

        :param names: of the parameters on which a rule depends.
        """
        if not armed:
            self._flown, self._changes = {}, {}
        new = []
        for name in names:
            if name not in values:
                continue
            change = before, value = self._flown.setdefault(name, values[name]), values[name]
            if value == before:
                self._changes.pop(name, None)
            elif self._changes.get(name) != change:
                self._changes = {**self._changes, name: change}
                new.append(_text(name, *change))
        return new

    def obstacle(self) -> str:
        """Return the changes that refuse the next ``offboard``, or ''."""
        # A copy: diagnostics read them from another thread.
        changes = '; '.join(_text(name, *change) for name, change in self._changes.copy().items())
        return changes and f'{changes}: {_REMEDY}'


def _text(name: str, before: float, value: float) -> str:
    return f'{name} {CHANGED} from {before:g} to {value:g}'
