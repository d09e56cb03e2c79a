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
Reads the autopilot's parameters that the bridge depends on, and reports those that differ.

The bridge writes no parameter. The recommendations are the files in ``config/`` that
QGroundControl (``.params``) and MAVProxy (``.parm``) load; the comment before an entry gives its
reason. If the comment begins with ``Any but 0``, the entry differs only if the value is 0: off.

``obstacle`` returns which of these parameters forbid ``offboard``, and why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import math
import re
import struct
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import Dialect

#: An unanswered question is asked again after this, s.
RETRY_PERIOD: Final[float] = 2.0
#: The differences are reported after this, s, if some are not answered by then.
PATIENCE: Final[float] = 5.0
#: Entries after this comment matter only if odometry is forwarded.
FORWARDING_SECTION: Final[str] = 'Only with forward_odometry'
#: How the comment of an entry begins of which any other value but 0 will do.
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
        """Return whether a value is another than recommended, in a way that matters."""
        if self.why.startswith(ANY_BUT_ZERO):
            return value == 0.0
        return not math.isclose(value, self.value, rel_tol=1e-5, abs_tol=1e-9)


def read_recommendations(text: str, *, forwarding: bool) -> list[Recommendation]:
    """
    Return the entries of a ``.params`` or ``.parm`` file.

    :param forwarding: whether those that matter only with forwarded odometry are wanted too.
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
    """For people: what differs and why it matters."""


class ParameterCheck:
    """
    Reads parameters; ``step`` returns which one to ask for now, one at a time.

    ``values`` holds the autopilot's answers. ``result`` may be called from any thread, everything
    else from one.

    :param needed: names to read that are not compared with anything.
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
        """Return the name to ask for at ``now``, s, or ''."""
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


#: An autopilot may fly the last setpoint for this long, s. ArduPilot's default is 3 s, in which it
#: gained 8.5 m/s, at 2.5 m/s^2, and flew 36 m.
LONGEST: Final[float] = 1.0
#: Bits of PX4's EKF2_EV_CTRL: horizontal position, and velocity.
_FUSED_BITS: Final[int] = 1 | 4
_EXTERNAL_NAVIGATION: Final[int] = 6
_ANYWAY: Final[str] = 'require_failsafe:=false'


class Rule(NamedTuple):
    """A parameter, and the values of it with which nothing may be flown by setpoints."""

    name: str
    forbidden: Callable[[float], bool]
    advice: str
    """What follows NAME = VALUE: why, and what to set."""
    forwarding: bool = False
    """Whether it matters only if odometry is forwarded."""


_TOO_LONG: Final[str] = (' s: it would fly the last acceleration for so long if the bridge died; '
                         f'set it to {LONGEST:g} s at most')
_NOT_FUSED: Final[str] = ': it does not fuse the odometry that is forwarded to it; '


#: By the name of the dialect; the values are those of PX4 1.14 to 1.16, ArduCopter 4.6 and 4.7.
RULES: Final[Mapping[str, tuple[Rule, ...]]] = MappingProxyType({
    'px4': (
        Rule('COM_OF_LOSS_T', lambda value: value > LONGEST, _TOO_LONG),
        Rule('COM_OBL_RC_ACT', lambda value: value in (6, 7),
             ': it would stop its motors in the air (6: terminate, 7: disarm) if the bridge died; '
             'set it to 5 (Hold), or 4 (Land) where odometry is forwarded'),
        Rule('EKF2_EV_CTRL', lambda value: not (
            math.isfinite(value) and int(value) & _FUSED_BITS == _FUSED_BITS),
             f'{_NOT_FUSED}set bits 0 (horizontal position) and 2 (velocity), as 13 does',
             forwarding=True)),
    'ardupilot': (
        Rule('GUID_TIMEOUT', lambda value: value > LONGEST, _TOO_LONG),
        Rule('VISO_TYPE', lambda value: value == 0, f'{_NOT_FUSED}set it to 1 (MAVLink)',
             forwarding=True),
        *(Rule(f'EK3_SRC1_{source}', lambda value: value != _EXTERNAL_NAVIGATION,
               f'{_NOT_FUSED}set it to {_EXTERNAL_NAVIGATION} (ExternalNav)', forwarding=True)
          for source in ('POSXY', 'VELXY')))})


def rules(dialect: Dialect, forwarding: bool) -> list[Rule]:
    """Return the rules that apply; ``forwarding`` is whether odometry is forwarded."""
    return [rule for rule in RULES[dialect.name] if forwarding or not rule.forwarding]


def obstacle(dialect: Dialect, parameters: ParameterCheck, forwarding: bool) -> str:
    """Return why the vehicle may not be flown by setpoints, by a parameter of its own, or ''."""
    values, applicable = parameters.values, rules(dialect, forwarding)
    for rule in applicable:
        if rule.name in values and rule.forbidden(values[rule.name]):
            return f'{rule.name} = {values[rule.name]:g}{rule.advice} (or {_ANYWAY})'
    unread = ', '.join(rule.name for rule in applicable if rule.name not in values)
    return unread and (
        f'{unread} could not be read: {dialect.title} might not be safe without the bridge, or '
        f'not fuse forwarded odometry ({_ANYWAY} flies all the same)')
