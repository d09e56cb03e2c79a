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

"""Which of the autopilot's own parameters forbid ``offboard``, and why."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from types import MappingProxyType
from typing import Final, NamedTuple

from flock_follower.mavlink.dialect import Dialect
from flock_follower.mavlink.parameter_check import ParameterCheck

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
    words: str
    """What follows NAME = VALUE: why, and what to set."""
    forwarding: bool = False
    """Whether it matters only where odometry is forwarded."""


_TOO_LONG: Final[str] = (' s: it would fly the last acceleration for so long if the bridge died; '
                         f'set it to {LONGEST:g} s at most')
_NOT_FUSED: Final[str] = ': it does not fuse the odometry that is forwarded to it; '


def _source(name: str) -> Rule:
    return Rule(name, lambda value: value != _EXTERNAL_NAVIGATION,
                f'{_NOT_FUSED}set it to {_EXTERNAL_NAVIGATION} (ExternalNav)', forwarding=True)


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
        _source('EK3_SRC1_POSXY'), _source('EK3_SRC1_VELXY'))})


def rules(dialect: Dialect, forwarding: bool) -> list[Rule]:
    """Return the rules that apply; ``forwarding`` is whether odometry is forwarded."""
    return [rule for rule in RULES[dialect.name] if forwarding or not rule.forwarding]


def obstacle(dialect: Dialect, parameters: ParameterCheck | None, forwarding: bool) -> str:
    """Return why the vehicle may not be flown by setpoints, by a parameter of its own, or ''."""
    values = {} if parameters is None else parameters.values
    return next((f'{rule.name} = {values[rule.name]:g}{rule.words} (or {_ANYWAY})'
                 for rule in rules(dialect, forwarding)
                 if rule.name in values and rule.forbidden(values[rule.name])), '')


def unread(dialect: Dialect, parameters: ParameterCheck | None, forwarding: bool) -> str:
    """Return which of them have not been read, having them asked for once more, or ''."""
    names = [rule.name for rule in rules(dialect, forwarding)
             if parameters is None or rule.name not in parameters.values]
    if parameters is not None:
        for name in names:
            parameters.again(name)
    return (f'{", ".join(names)} could not be read: {dialect.title} might not be safe without the '
            f'bridge, or not fuse what is forwarded ({_ANYWAY} flies all the same)'
            if names else '')
