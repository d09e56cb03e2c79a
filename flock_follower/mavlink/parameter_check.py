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
reason. Two lines of this comment have a fixed form. ``Good: 1, 3 to 5`` lists other accepted
values; without this line only the recommended value is accepted. ``Versions: 1.18 and later``,
``Versions: up to 1.17`` or ``Versions: 1.15 to 1.17`` names the firmware that has the parameter.

``obstacle`` returns the parameter that forbids ``offboard``, and the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
import re
import struct
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import Dialect, firmware_version, Rule, Version
from flock_follower.mavlink.parameter_watch import UNKNOWN_AFTER, WATCH_PERIOD

#: An unanswered request is repeated after this, s.
RETRY_PERIOD: Final[float] = 2.0
#: The differences are reported after this, s, if some are not answered by then.
PATIENCE: Final[float] = 5.0
#: Entries after this comment matter only if odometry is forwarded.
FORWARDING_SECTION: Final[str] = 'Only with forward_odometry'
#: MAV_PARAM_ERROR_DOES_NOT_EXIST, which older releases of pymavlink lack.
DOES_NOT_EXIST: Final[int] = 1
#: The first firmware of an entry without ``Versions:``, major and minor.
_FIRST_VERSION = (0, 0)
#: The last one.
_LAST_VERSION = (255, 255)
_ENTRY: Final = re.compile(
    r'(?:\d+\s+\d+\s+)?([A-Z]\w{0,15})[\s,]+([-+]?\d+(?:\.\d*)?)(?:\s+\d+)?')
_NUMBER: Final[str] = r'(-?\d+(?:\.\d+)?)'
_RANGE: Final = re.compile(rf'{_NUMBER}(?: to {_NUMBER})?')
_SERIES: Final[str] = r'(\d+)\.(\d+)'
_VERSIONS: Final = re.compile(
    rf'up to {_SERIES}|{_SERIES} and later|{_SERIES} to {_SERIES}')
_INTEGER_FORMATS: Final[dict[int, str]] = {
    mavlink.MAV_PARAM_TYPE_UINT8: '<Bxxx', mavlink.MAV_PARAM_TYPE_INT8: '<bxxx',
    mavlink.MAV_PARAM_TYPE_UINT16: '<Hxx', mavlink.MAV_PARAM_TYPE_INT16: '<hxx',
    mavlink.MAV_PARAM_TYPE_UINT32: '<I', mavlink.MAV_PARAM_TYPE_INT32: '<i'}


class Recommendation(NamedTuple):
    """One recommended parameter."""

    name: str
    value: float
    why: str
    good: tuple[tuple[float, float], ...] = ()
    """Ranges of other accepted values; empty if there are none."""
    since: tuple[int, int] = _FIRST_VERSION
    until: tuple[int, int] = _LAST_VERSION
    """``since``, ``until``: first and last firmware that has the parameter, major and minor."""

    def differs(self, value: float) -> bool:
        """Return whether a value is neither recommended nor accepted."""
        return not (any(low <= value <= high for low, high in self.good)
                    or math.isclose(value, self.value, rel_tol=1e-5, abs_tol=1e-9))

    def applies(self, version: Version | None) -> bool:
        """Return whether a firmware has the parameter; for None: whether all versions have it."""
        if version is None:
            return (self.since, self.until) == (_FIRST_VERSION, _LAST_VERSION)
        return self.since <= version[:2] <= self.until


def read_recommendations(text: str, *, forwarding: bool) -> list[Recommendation]:
    """
    Return the entries of a ``.params`` or ``.parm`` file.

    :param forwarding: whether to include the entries that matter only with forwarded odometry.
    :raises ValueError: naming the first line that is malformed.
    """
    found: list[Recommendation] = []
    comments: list[str] = []
    extent: dict[str, Any] = {}
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if line.startswith('#'):
            comment = line.lstrip('# ')
            if comment == FORWARDING_SECTION and not forwarding:
                break
            if read := _read_extent(comment, number):
                extent |= read
            else:
                comments.append(comment)
            continue
        # NAME VALUE, or as in QGroundControl's files: SYSTEM COMPONENT NAME VALUE TYPE.
        entry = _ENTRY.fullmatch(line)
        if entry:
            found.append(Recommendation(entry[1], float(entry[2]), ' '.join(comments), **extent))
        elif line:
            raise ValueError(f'line {number} = {line!r}: must be NAME VALUE, or SYSTEM COMPONENT '
                             'NAME VALUE TYPE')
        comments, extent = [], {}
    return found


def _read_extent(comment: str, number: int) -> dict[str, Any]:
    """Return the fields of a Recommendation in a comment, line ``number``; empty if none."""
    kind, _, text = comment.partition(': ')
    if kind == 'Good':
        ranges = [_RANGE.fullmatch(each) for each in text.split(', ')]
        if all(ranges):
            return {'good': tuple((float(each[1]), float(each[2] or each[1]))
                                  for each in ranges if each)}
        raise ValueError(f'line {number} = {comment!r}: must be Good: VALUE, VALUE to VALUE, ...')
    if kind != 'Versions':
        return {}
    if match := _VERSIONS.fullmatch(text):
        last, first, begin, end = (
            tuple(map(int, match.group(k, k + 1))) if match[k] else () for k in (1, 3, 5, 7))
        since, until = first or begin or _FIRST_VERSION, last or end or _LAST_VERSION
        if since <= until:
            return {'since': since, 'until': until}
    raise ValueError(f'line {number} = {comment!r}: must be Versions: up to 1.17, 1.18 and later, '
                     'or 1.15 to 1.17')


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
    """Text for people: each difference and its reason."""
    missing: tuple[str, ...] = ()
    """Text for people: each parameter that does not exist."""
    unproven: str = ''
    """Text for people: the firmware, if there are no recommendations for it."""
    unread: tuple[str, ...] = ()
    """Names of parameters that were not answered."""


class ParameterCheck:
    """
    Reads the firmware's version and parameters; ``step`` returns the parameter to request now.

    ``values`` holds the autopilot's answers, ``missing`` the parameters that do not exist.
    ``result`` may be called from any thread, everything else from one.

    :param recommended: entries that ``version`` does not have are not requested.
    :param dialect: of the autopilot; None while it is unknown: nothing is requested.
    :param needed: names to read without a comparison.
    """

    def __init__(self, recommended: Sequence[Recommendation] = (), dialect: Dialect | None = None,
                 *, needed: Sequence[str] = ()) -> None:
        self.values: dict[str, float] = {}
        self.missing: set[str] = set()
        self.version: Version | None = None
        self._dialect = dialect
        self._recommended = tuple(recommended)
        self._needed = tuple(needed)
        self._wanted = {*needed, *(entry.name for entry in recommended)}
        self._asked: dict[str, float] = {}  # when last, s
        self._tries: dict[str, int] = {}  # since the last answer
        self._version_asked = -math.inf  # s
        self._begun = math.inf
        self._patient = True

    @property
    def firmware(self) -> str:
        """Return the name and the version of the firmware, for people."""
        title = self._dialect.title if self._dialect is not None else 'autopilot'
        return f'{title} {self.version or "of unknown version"}'

    def version_due(self, now: float) -> bool:
        """Return whether to request AUTOPILOT_VERSION at ``now``, s."""
        due = (self._dialect is not None and self.version is None
               and now - self._version_asked >= RETRY_PERIOD)
        if due:
            self._version_asked = now
        return due

    def step(self, now: float) -> str:
        """Return the name to request at ``now``, s, or ''."""
        self._begun = min(self._begun, now)
        self._patient = now - self._begun < PATIENCE
        due = [name for name in self._names(self.version) if self._open(name)
               and now - self._asked.get(name, -math.inf) >= RETRY_PERIOD]
        due += [name for name in self.watched_names()
                if now - self._asked.get(name, -math.inf) >= WATCH_PERIOD]
        for name in due[:1]:
            self._asked[name] = now
            self._tries[name] = self._tries.get(name, 0) + 1
        return ''.join(due[:1])

    def watched_names(self) -> list[str]:
        """Return the names to read repeatedly: parameters of a rule that were answered before."""
        if self._dialect is None:
            return []
        kept = {*self._dialect.watched, *(rule.name for rule in self._dialect.offboard_rules)}
        return [name for name in self.values if name in kept]

    def is_known(self, name: str) -> bool:
        """Return whether a value was answered within the last few requests."""
        return name in self.values and self._tries.get(name, 0) <= UNKNOWN_AFTER

    def _names(self, version: Version | None) -> list[str]:
        """Return the names to read; those that rules need come first."""
        return list(dict.fromkeys((*self._needed, *(
            entry.name for entry in self._recommended if entry.applies(version)))))

    def _open(self, name: str) -> bool:
        return name not in self.values and name not in self.missing

    def take(self, message: Any) -> None:
        """Take a PARAM_VALUE."""
        name = _name_of(message)
        if name in self._wanted and self._dialect is not None:
            self.values[name] = parameter_value(
                message, bytewise=self._dialect.bytewise_parameters)
            self._tries[name] = 0
            self.missing.discard(name)

    def take_error(self, message: Any) -> None:
        """Take a PARAM_ERROR: a parameter that does not exist is not requested again."""
        name = _name_of(message)
        if message.error == DOES_NOT_EXIST and name in self._wanted and name not in self.values:
            self.missing.add(name)

    def take_version(self, message: Any) -> None:
        """Take an AUTOPILOT_VERSION, which can add parameters to read."""
        version = firmware_version(message)
        if version is not None and version != self.version:
            self.version = version
            self._begun, self._patient = math.inf, True

    def result(self) -> CheckResult | None:
        """Return the differences, None until every parameter is answered or PATIENCE is over."""
        values, missing, version = self.values.copy(), self.missing.copy(), self.version
        dialect, names = self._dialect, self._names(version)
        recommended = {entry.name: entry for entry in self._recommended if entry.applies(version)}
        unanswered = [name for name in names if name not in values and name not in missing]
        if version is None:
            unanswered.append('AUTOPILOT_VERSION')
        if dialect is None or (unanswered and self._patient):
            return None
        lines = [f'{name} = {values[name]:g}, recommended {entry.value:g}: {entry.why}'
                 for name, entry in recommended.items()
                 if name in values and entry.differs(values[name])]
        differing = len(lines)
        known = version is None or dialect.versions[0] <= version[:2] <= dialect.versions[1]
        return CheckResult(
            len(values), differing, len(unanswered), tuple(lines),
            tuple(f'{name} does not exist in {self.firmware}' + (
                f', recommended {recommended[name].value:g}: {recommended[name].why}'
                if name in recommended else '') for name in names if name in missing),
            '' if known else
            f'{self.firmware}: the recommended values are known for {dialect.known_versions}',
            tuple(unanswered))


def _name_of(message: Any) -> str:
    """Return the name of the parameter in a message."""
    name = message.param_id
    return (name.decode('ascii', 'replace') if isinstance(name, bytes) else name).rstrip('\0')


_ANYWAY: Final[str] = 'require_failsafe:=false'
#: The action if a parameter is not answered, whose cause is not known.
ASK: Final[str] = 'does the autopilot receive our messages? read them in the ground station'


def applicable_rules(dialect: Dialect, forwarding: bool) -> list[Rule]:
    """Return the rules that apply; ``forwarding`` is whether odometry is forwarded."""
    return [rule for rule in dialect.offboard_rules if forwarding or not rule.forwarding]


def obstacle(dialect: Dialect, parameters: ParameterCheck, forwarding: bool) -> str:
    """Return the parameter of the autopilot that forbids ``offboard``, and why, or ''."""
    values, applicable = parameters.values, applicable_rules(dialect, forwarding)
    for rule in applicable:
        if rule.name in values and rule.forbidden(values[rule.name]):
            return f'{rule.name} = {values[rule.name]:g}{rule.advice} (or {_ANYWAY})'
    doubt = f'{dialect.title} might not be safe without the bridge, or not fuse forwarded odometry'
    missing = [rule.name for rule in applicable if rule.name in parameters.missing]
    if missing:  # no setting helps
        return (f'{", ".join(missing)} {"does" if len(missing) == 1 else "do"} not exist in '
                f'{parameters.firmware}: {doubt}; its rules are known for '
                f'{dialect.known_versions}')
    unread = ', '.join(rule.name for rule in applicable if not parameters.is_known(rule.name))
    return unread and f'{unread} could not be read: {doubt}; {ASK}'
