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

"""The one check of numbers: what it takes, what it refuses, and in which words."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
import importlib
import math
import pkgutil
from typing import Any

import numpy as np
import pytest

from flock_desk import scenarios
import flock_follower
from flock_follower.mavlink.parameter_table import origin
from flock_follower.ranges import Checked, parameter, Range, suggestion

SPEED = Range(0.05, 20.0, 'm/s')
POSITIVE = Range(0.0, 2.0, 's', above=True)
COUNT = Range(1, 255, whole=True)


@pytest.mark.parametrize('value', [0.05, 20.0, 1, np.float32(2.0), np.int64(3)])
def test_numbers_inside_and_the_bounds_are_taken(value: Any) -> None:
    SPEED.check('v_max', value)


@pytest.mark.parametrize('value', [
    0.0499, 20.001, -1.0, math.nan, math.inf, True, None, '1.0', [1.0], 1.0 + 0.0j])
def test_everything_else_is_refused_with_name_value_and_range(value: Any) -> None:
    with pytest.raises(ValueError) as error:
        SPEED.check('v_max', value)
    shown = repr(value)
    assert str(error.value) == f'v_max = {shown}: must be a number in [0.05, 20] m/s'


def test_an_open_bound_does_not_belong_to_the_range() -> None:
    POSITIVE.check('period', 1e-9)
    POSITIVE.check('period', 2.0)
    with pytest.raises(ValueError, match=r'^period = 0\.0: must be a number in \(0, 2\] s$'):
        POSITIVE.check('period', 0.0)


@pytest.mark.parametrize('value', [0, 256, 1.0, 2.5, True, '1'])
def test_a_whole_number_is_no_float(value: Any) -> None:
    COUNT.check('system_id', 255)
    with pytest.raises(ValueError, match=r'must be an integer in \[1, 255\]$'):
        COUNT.check('system_id', value)


def test_infinity_is_never_valid_large_bounds_keep_digits() -> None:
    assert not Range().holds(math.inf) and Range().holds(-1e300)
    assert str(Range()) == 'a finite number'
    assert str(Range(0.0, unit='m')) == 'a number in [0, inf) m'
    assert str(Range(0, 2**31 - 1, whole=True)) == 'an integer in [0, 2147483647]'


@dataclass(frozen=True)
class Example(Checked):
    speed: float = parameter(1.0, SPEED)
    corner: tuple[float, float] = parameter((0.0, 1.0), POSITIVE)
    mode: str = parameter('hold', ('hold', 'leader'))


@pytest.mark.parametrize(('values', 'message'), [
    ({'speed': 0.0}, r'^speed = 0\.0: must be a number in \[0\.05, 20\] m/s$'),
    ({'corner': (1.0, 3.0)}, r'^corner = 3\.0: must be a number in \(0, 2\] s$'),
    ({'mode': 'spin'}, "^mode = 'spin': must be one of hold, leader$")])
def test_a_checked_dataclass_refuses_as_it_is_made(values: Any, message: str) -> None:
    Example(corner=(1.0, 2.0))
    with pytest.raises(ValueError, match=message):
        Example(**{'corner': (1.0, 2.0), **values})


def checked_classes() -> list[type[Checked]]:
    """Return every class of the package, but for nodes, that is checked."""
    for package in (flock_follower, scenarios):
        for module in pkgutil.walk_packages(package.__path__, f'{package.__name__}.'):
            if not module.name.startswith('flock_follower.nodes'):
                importlib.import_module(module.name)
    found, new = [], [Checked]
    while new:
        new = [each for kind in new for each in kind.__subclasses__()
               if each.__module__.startswith('flock_')]
        found += new
    return found


def test_every_number_of_a_checked_dataclass_has_a_range() -> None:
    classes = [each for each in checked_classes() if is_dataclass(each) and each.valid()]
    assert len(classes) > 10
    for each in classes:
        numbers = {field.name for field in fields(each)
                   if field.type in ('float', 'int', 'Interval', 'Vector', 'tuple[float, ...]',
                                     'tuple[float, float, float]')}
        assert numbers == {name for name, valid in each.valid().items()
                           if isinstance(valid, Range)}, each


@pytest.mark.parametrize(('known', 'text'), [
    (['v_max', 'a_max'], 'did you mean v_max?'), (['rate', 'loop'], 'it has loop, rate'),
    ([], 'it has none')])
def test_a_wrong_name_is_answered_by_the_nearest_else_all(known: list[str], text: str) -> None:
    assert suggestion('vmax', known) == text


@pytest.mark.parametrize(('place', 'message'), [
    ([91.0, 0.0, 0.0], r'latitude = 91\.0: must be a number in \[-90, 90\] deg'),
    ([0.0, -181.0, 0.0], r'longitude = -181\.0: must be a number in \[-180, 180\] deg'),
    ([0.0, 0.0, 2e4], r'height = 20000\.0: must be a number in \[-10000, 10000\] m')])
def test_an_origin_off_the_earth_is_refused(place: list[float], message: str) -> None:
    assert origin([47.4, 8.5, 488.0]) == (47.4, 8.5, 488.0)
    with pytest.raises(ValueError, match=rf'^global_origin = \[.*\]: {message}$'):
        origin(place)
