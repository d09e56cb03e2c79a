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
Reads the autopilot's parameters that the bridge depends on, and reports differences.

The bridge writes no parameter. The recommendations are the files in ``config/`` that
QGroundControl (``.params``) and MAVProxy (``.parm``) load; the comment before an entry gives its
reason. If the comment begins with ``Any but 0``, the entry differs only if the value is 0: off.

``obstacle`` returns the parameter that forbids ``offboard``, and the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
import re
import struct
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import Dialect, Rule

#: An unanswered request is repeated after this, s.
RETRY_PERIOD: Final[float] = 2.0
#: The differences are reported after this, s, if some are not answered by then.
PATIENCE: Final[float] = 5.0
#: Entries after this comment matter only if odometry is forwarded.
FORWARDING_SECTION: Final[str] = 'Only with forward_odometry'
#: Beginning of the comment of an entry that admits any value but 0.
ANY_BUT_ZERO: Final[str] = 'Any but 0'
_ENTRY: Final = re.compile(
    r'(?:\d+\s+\d+\s+)?([A-Z]\w{0,15})[\s,]+([-+]?\d+(?:\.\d*)?)(?:\s+\d+)?')
_INTEGER_FORMATS: Final[dict[int, str]] = {
    mavlink.MAV_PARAM_TYPE_UINT8: '<Bxxx', mavlink.MAV_PARAM_TYPE_INT8: '<bxxx',
    mavlink.MAV_PARAM_TYPE_UINT16: '<Hxx', mavlink.MAV_PARAM_TYPE_INT16: '<hxx',
    mavlink.MAV_PARAM_TYPE_UINT32: '<I', mavlink.MAV_PARAM_TYPE_INT32: '<i'}


class Recommendation(NamedTuple):
    """One recommended parameter."""

    name: str
    value: float
    why: str

    def differs(self, value: float) -> bool:
        """Return whether a value differs from the recommended one."""
        if self.why.startswith(ANY_BUT_ZERO):
            return value == 0.0
        return not math.isclose(value, self.value, rel_tol=1e-5, abs_tol=1e-9)


def read_recommendations(text: str, *, forwarding: bool) -> list[Recommendation]:
    """
    Return the entries of a ``.params`` or ``.parm`` file.

    :param forwarding: whether to return those that matter only with forwarded odometry, too.
    :raises ValueError: naming the first line that is neither an entry, a comment, nor empty.
    """
    found: list[Recommendation] = []
    comments: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if line.startswith('#'):
            comments.append(line.lstrip('# '))
            if comments[-1] == FORWARDING_SECTION and not forwarding:
                break
            continue
        # NAME VALUE, or as in QGroundControl's files: SYSTEM COMPONENT NAME VALUE TYPE.
        entry = _ENTRY.fullmatch(line)
        if entry:
            found.append(Recommendation(entry[1], float(entry[2]), ' '.join(comments)))
        elif line:
            raise ValueError(f'line {number} = {line!r}: must be NAME VALUE, or SYSTEM COMPONENT '
                             'NAME VALUE TYPE')
        comments = []
    return found


def parameter_value(message: Any, *, bytewise: bool) -> float:
    """
    Return the value of a PARAM_VALUE.

    :param bytewise: whether integers are carried as their bytes (PX4), not by value (ArduPilot).
    """
    form = _INTEGER_FORMATS.get(message.param_type)
    if not bytewise or form is None:
        return float(message.param_value)
    return float(struct.unpack(form, struct.pack('<f', message.param_value))[0])


class CheckResult(NamedTuple):
    """The result of a finished check."""

    answered: int
    differing: int
    unanswered: int
    lines: tuple[str, ...]
    """For people: each difference, and its reason."""


class ParameterCheck:
    """
    Reads parameters; ``step`` returns the one to request now, one at a time.

    ``values`` holds the autopilot's answers. ``result`` may be called from any thread, everything
    else from one.

    :param needed: names to read, and not to compare.
    """

    def __init__(self, recommended: Sequence[Recommendation], *, bytewise: bool = False,
                 needed: Sequence[str] = ()) -> None:
        self.values: dict[str, float] = {}
        self._recommended = {entry.name: entry for entry in recommended}
        self._bytewise = bytewise
        self._asked = dict.fromkeys((*needed, *self._recommended), -math.inf)  # when last, s
        self._begun = math.inf
        self._patient = True

    def step(self, now: float) -> str:
        """Return the name to request at ``now``, s, or ''."""
        self._begun = min(self._begun, now)
        self._patient = now - self._begun < PATIENCE
        due = [name for name, asked in self._asked.items()
               if name not in self.values and now - asked >= RETRY_PERIOD]
        for name in due[:1]:
            self._asked[name] = now
        return ''.join(due[:1])

    def take(self, message: Any) -> None:
        """Take a PARAM_VALUE."""
        name = message.param_id
        name = (name.decode('ascii', 'replace') if isinstance(name, bytes) else name).rstrip('\0')
        if name in self._asked:
            self.values[name] = parameter_value(message, bytewise=self._bytewise)

    def result(self) -> CheckResult | None:
        """Return the differences, None until every parameter is answered or PATIENCE is over."""
        values = self.values.copy()
        unanswered = [name for name in self._asked if name not in values]
        if not self._asked or (unanswered and self._patient):
            return None
        lines = [f'{name} = {values[name]:g}, recommended {entry.value:g}: {entry.why}'
                 for name, entry in self._recommended.items()
                 if name in values and entry.differs(values[name])]
        differing = len(lines)
        if unanswered:
            lines.append(f'no answer about {", ".join(unanswered)}: '
                         'compare them with the recommended values by hand')
        return CheckResult(len(values), differing, len(unanswered), tuple(lines))


_ANYWAY: Final[str] = 'require_failsafe:=false'


def rules(dialect: Dialect, forwarding: bool) -> list[Rule]:
    """Return the rules that apply; ``forwarding`` is whether odometry is forwarded."""
    return [rule for rule in dialect.rules if forwarding or not rule.forwarding]


def obstacle(dialect: Dialect, parameters: ParameterCheck, forwarding: bool) -> str:
    """Return the reason in the autopilot's parameters against flying by setpoints, or ''."""
    values, applicable = parameters.values, rules(dialect, forwarding)
    for rule in applicable:
        if rule.name in values and rule.forbidden(values[rule.name]):
            return f'{rule.name} = {values[rule.name]:g}{rule.advice} (or {_ANYWAY})'
    unread = ', '.join(rule.name for rule in applicable if rule.name not in values)
    return unread and (
        f'{unread} could not be read: {dialect.title} might not be safe without the bridge, or '
        f'not fuse forwarded odometry ({_ANYWAY} flies all the same)')
