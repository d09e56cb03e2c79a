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

"""Valid values of numbers and names of topics, with their check; suggestions for names."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
import difflib
from functools import cache
import math
from numbers import Integral, Real
import re
from typing import Any, Final


@dataclass(frozen=True)
class Range:
    """
    Finite numbers from ``low`` to ``high``, both included, in a unit.

    ``above`` excludes ``low`` itself; ``whole`` permits integers only. Infinity means no limit.
    """

    low: float = -math.inf
    high: float = math.inf
    unit: str = ''
    above: bool = False
    whole: bool = False

    def __str__(self) -> str:
        """Return the valid range as text: 'a number in (0, 20] m/s^2'."""
        low, high = (str(int(bound)) if self.whole and math.isfinite(bound) else f'{bound:g}'
                     for bound in (self.low, self.high))
        if math.isinf(self.low) and math.isinf(self.high):
            return f'a finite number {self.unit}'.rstrip()
        return (f'{"an integer" if self.whole else "a number"} in '
                f'{"(" if self.above else "["}{low}, {high}'
                f'{")" if math.isinf(self.high) else "]"} {self.unit}').rstrip()

    def holds(self, value: Any) -> bool:
        """Return whether a value of any type is one of these numbers; True and False are not."""
        kind: Any = Integral if self.whole else Real
        if isinstance(value, bool) or not isinstance(value, kind):
            return False
        inside = self.low < value if self.above else self.low <= value  # False for NaN
        return bool(inside and value <= self.high and math.isfinite(value))

    def check(self, name: str, value: Any) -> None:
        """
        Check the value of a parameter.

        :raises ValueError: naming the parameter, its value and the valid range.
        """
        if not self.holds(value):
            shown = value if isinstance(value, Real) else repr(value)
            raise ValueError(f'{name} = {shown}: must be {self}')


#: Largest offset between the clocks of images and odometry that is applied, s.
MAX_OFFSET: Final[float] = 0.2
#: Largest error of the hover thrust that the gate offsets, m/s^2.
THRUST_OFFSET_MAX = 1.2
#: Values of parameters that planner and gate have in common.
A_MAX = Range(1.5, 20.0, 'm/s^2')
#: Default of ``predict_timeout`` of the planner, s; ``check`` judges the gaps of poses by it.
PREDICT_TIMEOUT: Final[float] = 0.5
#: Below it gusts and the velocity error of odometry are as large as the limit.
V_MAX = Range(0.1, 5.0, 'm/s')
ODOM_TIMEOUT = Range(0.1, 1.0, 's')


#: Words of a name in ROS, relative.
WORDS: Final = '[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*'


def check_topic(name: str, value: Any) -> None:
    """
    Check a parameter that is the name of a topic: relative, absolute or private.

    :raises ValueError: naming the parameter, its value and the form of a topic.
    """
    if not isinstance(value, str) or not re.fullmatch(f'(/|~/)?{WORDS}', value):
        raise ValueError(f'{name} = {value!r}: must be the name of a topic: words joined by /, '
                         'each of letters, digits and _, not beginning with a digit')


def parameter(default: Any, valid: Range | tuple[str, ...] | None = None, meaning: str = '', *,
              live: bool | None = None) -> Any:
    """
    Return a field of a :class:`Checked` dataclass.

    :param default: its default, or ``dataclasses.MISSING``.
    :param valid: the values of a number, or of each of a tuple of numbers; the choices of a text.
    :param meaning: one line without its unit, which ``valid`` has.
    :param live: whether a node accepts new values in flight; None: no node declares it.
    """
    return field(default=default, metadata={'valid': valid, 'meaning': meaning, 'live': live})


class Checked:
    """
    A frozen dataclass that checks its numbers and choices when it is made, see :func:`parameter`.

    :raises ValueError: naming the field, its value and the valid range.
    """

    @classmethod
    @cache
    def valid(cls) -> Mapping[str, Range | tuple[str, ...]]:
        """Return the valid values of each field that is a number or a choice."""
        return {each.name: each.metadata['valid'] for each in fields(cls)  # type: ignore[arg-type]
                if each.metadata.get('valid')}

    def __post_init__(self) -> None:
        """Check every field that has valid values."""
        for name, valid in self.valid().items():
            value = getattr(self, name)
            if isinstance(valid, Range):
                for number in value if isinstance(value, tuple) else (value,):
                    valid.check(name, number)
            elif value not in valid:
                raise ValueError(f'{name} = {value!r}: must be one of {", ".join(valid)}')


def suggestion(name: str, known: Collection[str], otherwise: str = 'it has') -> str:
    """Return the most similar known name as a question; if none is similar, all known names."""
    near = difflib.get_close_matches(name, sorted(known), n=1)
    return f'did you mean {near[0]}?' if near else (
        f'{otherwise} {", ".join(sorted(known)) or "none"}')


def first_reason(*checks: tuple[object, str]) -> str:
    """Return the text of the first check whose condition is true, '' if there is none."""
    return next((reason for holds, reason in checks if holds), '')
