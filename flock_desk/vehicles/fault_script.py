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
What goes wrong with the embedded autopilot, and when: a list of faults, or a YAML file of them.

::

    faults:
      - {at: 2.0, fault: drop, for: 3.0, direction: sent, share: 0.3}
      - {at: 5.0, fault: drop, message: HEARTBEAT}
      - {at: 6.0, fault: delay, for: 1.0, by: 0.25}
      - {at: 8.0, fault: duplicate, for: 1.0}
      - {at: 9.0, fault: garbage, for: 1.0, bytes: 40, share: 0.5}
      - {at: 12.0, fault: refuse, command: NAV_TAKEOFF, result: denied, reason: Not today}
      - {at: 15.0, fault: pilot, mode: POSCTL}
      - {at: 5.0, after: setpoint, fault: pilot, mode: POSCTL, climb: 2.0}
      - {at: 20.0, fault: vision, for: 4.0}
      - {at: 22.0, fault: barometer, for: 5.0, offset: -1.5}
      - {at: 25.0, fault: battery, remaining: 0.15}
      - {at: 30.0, fault: reboot, for: 3.0}

``at`` and ``for`` are s since the start; without ``for`` a fault stays, and a reboot takes 3 s.
``direction`` is as the autopilot sees it: sent, received or both. A pilot may act ``after`` the
first setpoint was received instead of the start, and may ``climb``, m, in a mode that keeps a
place. ``offset`` is added to the barometer's height, m. ``remaining`` is what the battery has from
then on, a share of its capacity; -1 makes it unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
import math
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink
import yaml

from flock_follower.ranges import Range

DIRECTIONS: Final[tuple[str, ...]] = ('sent', 'received', 'both')
CLOCKS: Final[tuple[str, ...]] = ('start', 'setpoint')
BOOT_TIME: Final[float] = 3.0  # s
#: What may be said of each fault besides ``at``, in a file.
_OPTIONS: Final[dict[str, tuple[str, ...]]] = {
    'drop': ('for', 'direction', 'share', 'message'),
    'delay': ('for', 'direction', 'share', 'message', 'by'),
    'duplicate': ('for', 'direction', 'share', 'message'),
    'garbage': ('for', 'direction', 'share', 'bytes'),
    'refuse': ('for', 'command', 'result', 'reason'),
    'pilot': ('after', 'mode', 'climb'),
    'vision': ('for',),
    'barometer': ('for', 'offset'),
    'battery': ('remaining',),
    'reboot': ('for',),
}
_REQUIRED: Final[dict[str, tuple[str, ...]]] = {
    'delay': ('by',), 'refuse': ('command',), 'pilot': ('mode',), 'barometer': ('offset',),
    'battery': ('remaining',)}
_NUMBERS: Final[dict[str, Range]] = {
    'at': Range(0.0, 1e6, 's'), 'duration': Range(0.0, 1e6, 's'), 'share': Range(0.0, 1.0),
    'by': Range(0.0, 60.0, 's'), 'climb': Range(-100.0, 100.0, 'm'),
    'offset': Range(-1000.0, 1000.0, 'm'), 'remaining': Range(-1.0, 1.0),
    'size': Range(1, 10_000, whole=True)}
_FIELDS: Final[dict[str, str]] = {'fault': 'kind', 'for': 'duration', 'bytes': 'size'}


@dataclass(frozen=True)
class Fault:
    """One fault, validated; ValueError names the field, its value and the valid range."""

    kind: str
    at: float
    """s since the start, or since what ``after`` says."""
    duration: float | None = None
    """s; None: it stays, and a reboot takes BOOT_TIME."""
    direction: str = 'both'
    share: float = 1.0
    """Of the messages, those that it befalls, by lot."""
    message: str = ''
    """The only message type that it befalls; '' for all."""
    by: float = 0.0
    """The delay, s."""
    size: int = 32
    """How many bytes of garbage."""
    command: str = ''
    """The command refused, without MAV_CMD_."""
    result: str = 'denied'
    """The MAV_RESULT of the refusal, without MAV_RESULT_."""
    reason: str = ''
    """STATUSTEXT of the refusal."""
    mode: str = ''
    """The mode that the pilot switches to."""
    climb: float = 0.0
    """How far the pilot then climbs, m."""
    offset: float = 0.0
    """Added to the barometer's height, m."""
    remaining: float = 1.0
    """What is left in the battery, a share of its capacity; below 0: unknown."""
    after: str = 'start'
    """Where ``at`` counts from: the start, or the first setpoint received."""

    def __post_init__(self) -> None:
        if self.kind not in _OPTIONS:
            raise ValueError(f'fault = {self.kind!r}: must be one of {", ".join(_OPTIONS)}')
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in _NUMBERS:
                if value is not None or field.name != 'duration':
                    _NUMBERS[field.name].check(_option(field.name), value)
            elif not isinstance(value, str):
                raise ValueError(f'{_option(field.name)} = {value!r}: must be a word')
        if self.direction not in DIRECTIONS:
            raise ValueError(f'direction = {self.direction!r}: must be one of '
                             f'{", ".join(DIRECTIONS)}')
        if self.after not in CLOCKS:
            raise ValueError(f'after = {self.after!r}: must be one of {", ".join(CLOCKS)}')
        if self.kind == 'refuse':
            self.refusal()
        if self.message and f'MAVLINK_MSG_ID_{self.message}' not in vars(mavlink):
            raise ValueError(f'message = {self.message!r}: must be a message of MAVLink common')

    @property
    def end(self) -> float:
        """Return when it ends, s since the start."""
        if self.duration is None:
            return self.at + BOOT_TIME if self.kind == 'reboot' else math.inf
        return self.at + self.duration

    def active(self, time: float) -> bool:
        """Return whether it acts at a time, s since the start."""
        return self.at <= time < self.end

    def befalls(self, direction: str, message: str, time: float) -> bool:
        """Return whether it acts on a message in a direction."""
        return (self.active(time) and self.direction in (direction, 'both')
                and self.message in ('', message))

    def refusal(self) -> tuple[int, tuple[int, str]]:
        """Return the number of the command, and the MAV_RESULT and reason of its refusal."""
        command = _number('MAV_CMD', 'command', self.command)
        return command, (_number('MAV_RESULT', 'result', self.result.upper()), self.reason)


def load_faults(path: str | Path) -> tuple[Fault, ...]:
    """
    Read a YAML file of faults.

    :raises ValueError: where it cannot be read, or says anything that is not understood; names
        the file and the place in the list.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise ValueError(f'faults = {str(path)!r}: {error.strerror}') from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = ' '.join(str(error).split())
        raise ValueError(f'faults = {str(path)!r}: not YAML: {reason}') from None
    if not isinstance(content, dict) or list(content) != ['faults'] or not isinstance(
            content['faults'], list):
        raise ValueError(f"{path}: must hold one key, 'faults', with a list")
    faults = []
    for number, entry in enumerate(content['faults'], start=1):
        try:
            faults.append(_fault(entry))
        except ValueError as error:
            raise ValueError(f'{path}: fault {number}: {error}') from None
    return tuple(faults)


def _fault(entry: Any) -> Fault:
    if not isinstance(entry, dict):
        raise ValueError(f'{entry!r}: must be a mapping with at and fault')
    kind = entry.get('fault')
    if kind not in _OPTIONS:
        raise ValueError(f'fault = {kind!r}: must be one of {", ".join(_OPTIONS)}')
    known = ('at', 'fault', *_OPTIONS[kind])
    for name in entry:
        if name not in known:
            raise ValueError(f'{name!r} means nothing to {kind}: must be one of '
                             f'{", ".join(known)}')
    for name in ('at', *_REQUIRED.get(kind, ())):
        if name not in entry:
            raise ValueError(f'{kind} needs {name!r}')
    return Fault(**{_FIELDS.get(str(name), str(name)): value for name, value in entry.items()})


def _option(field: str) -> str:
    """Return the name of a field in a file."""
    return next((option for option, name in _FIELDS.items() if name == field), field)


def _number(group: str, option: str, name: str) -> int:
    for number, entry in mavlink.enums[group].items():
        if entry.name == f'{group}_{name}':
            return int(number)
    raise ValueError(f'{option} = {name!r}: must be a {group} without its prefix')
