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
Whether a set of parameters can fly: one judgment for nodes, ``check``, ``evaluate``, scenarios.

Each parameter has a range; the rules here limit combinations, also with the camera and the marker
if known. A dangerous combination is refused, with the nearest accepted value. A combination that
only flies badly causes a warning. ``docs/guard.md``, "Settings", has the reasons.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import math
from typing import Any, Final, NamedTuple

from flock_follower.ranges import THRUST_OFFSET_MAX

#: Longest time in which the vehicle stops from ``v_max``, s, although the offset of the thrust
#: takes its share of ``a_max``.
STOP_TIME: Final[float] = 0.95
#: Least distance between hulls that the law may aim at, m.
NEAREST: Final[float] = 0.6
#: Least width of the band, m: narrower bands are as wide as the errors of guard and odometry.
NARROWEST: Final[float] = 0.45
#: Width of the band, m, below which a leader that reverses leaves it.
NARROW: Final[float] = 1.0
#: Largest sine of the elevation at which the neighbor is followed. With 0.42 and more a neighbor
#: that walks at random came near to 0.55 m out of the image, with 0.34 to 1.66 m.
STEEPEST: Final[float] = 0.3
#: Width of a marker, px, below which it is lost.
MARKER_LOST_WIDTH: Final[float] = 12.0
#: Images that may be lost in a row before the neighbor is not followed any more.
LOST_IMAGES: Final[float] = 2.0
#: Assumed acceleration of a hidden neighbor, m/s^2, above which the vehicle retreats from nothing.
RESTLESS: Final[float] = 3.0


class Camera(NamedTuple):
    """The camera and the marker; None: unknown."""

    rate: float | None = None
    """Rate of the processed images, Hz."""
    marker: float | None = None
    """Width of the marker at a distance of 1 m, px."""
    half_height: float | None = None
    """Angle from the optical axis to the upper edge of the image, rad."""


class Judgment(NamedTuple):
    """A parameter whose value is dangerous, or flies badly, together with the other parameters."""

    dangerous: bool
    parameter: str
    value: float
    valid: str
    """The nearest accepted value, such as 'at least 2.4 m/s^2'."""
    why: str

    def __str__(self) -> str:
        """Return the judgment as one line."""
        must = 'must' if self.dangerous else 'should'
        return f'{self.parameter} = {self.value:g}: {must} be {self.valid}: {self.why}'


UNKNOWN: Final[Camera] = Camera()


def find_unsafe_settings(values: Mapping[str, Any], camera: Camera = UNKNOWN) -> list[Judgment]:
    """
    Return the settings that are dangerous or fly badly, dangerous settings first.

    :param values: of one or several nodes, by name; rules about missing values are not applied.
    """
    found = [*_stop(values), *_band(values), *_sight(values, camera), *_height(values, camera),
             *_hidden(values)]
    return sorted(found, key=lambda each: not each.dangerous)


def refuse(values: Mapping[str, Any], camera: Camera = UNKNOWN) -> None:
    """
    Refuse a set of parameters that is dangerous.

    :raises ValueError: naming the parameter, its value and the nearest accepted value.
    """
    for each in find_unsafe_settings(values, camera):
        if each.dangerous:
            raise ValueError(str(each))


def left_for_motion(a_max: float) -> float:
    """Return the part of ``a_max``, m/s^2, that the thrust offset leaves for horizontal motion."""
    return math.sqrt(max(a_max ** 2 - THRUST_OFFSET_MAX ** 2, 0.0))


def _stop(values: Mapping[str, Any]) -> Iterator[Judgment]:
    if not {'a_max', 'v_max'} <= values.keys():
        return
    a_max, v_max = float(values['a_max']), float(values['v_max'])
    if v_max > STOP_TIME * left_for_motion(a_max):
        least = math.hypot(v_max / STOP_TIME, THRUST_OFFSET_MAX)
        yield Judgment(True, 'a_max', a_max, f'at least {math.ceil(100.0 * least) / 100.0:g} '
                       f'm/s^2 for v_max = {v_max:g}',
                       f'it stops within {STOP_TIME:g} s, and a wrong hover thrust takes '
                       f'{THRUST_OFFSET_MAX:g} m/s^2 of it')


def _band(values: Mapping[str, Any]) -> Iterator[Judgment]:
    if not {'d0', 'd1'} <= values.keys():
        return
    near, far = (math.sqrt(float(values[name])) for name in ('d0', 'd1'))
    if near < NEAREST:
        yield Judgment(True, 'd0', values['d0'], f'at least {NEAREST ** 2:g} m^2',
                       f'the band begins {near:.2f} m from the hull of the neighbor')
    least = f'at least {math.ceil(100.0 * (near + NARROWEST) ** 2) / 100.0:g} m^2'
    if far - near < NARROWEST:
        yield Judgment(True, 'd1', values['d1'], f'{least} for d0 = {values["d0"]:g}',
                       f'a band of {far - near:.2f} m is as wide as the errors')
    elif far - near < NARROW:
        wide = math.ceil(100.0 * (near + NARROW) ** 2) / 100.0
        yield Judgment(False, 'd1', values['d1'], f'at least {wide:g} m^2',
                       f'a leader that reverses leaves a band of {far - near:.2f} m')


def _sight(values: Mapping[str, Any], camera: Camera) -> Iterator[Judgment]:
    if camera.marker is not None and 'd1' in values:
        far, range_max = math.sqrt(float(values['d1'])), camera.marker / MARKER_LOST_WIDTH
        far += float(values.get('radius', 0.0))
        if far > range_max:
            most = max(range_max - float(values.get('radius', 0.0)), 0.0)
            yield Judgment(True, 'd1', values['d1'],
                           f'at most {math.floor(100.0 * most ** 2) / 100.0:g} m^2',
                           f'the marker is not found beyond {range_max:.1f} m')
    if camera.rate is not None and camera.rate > 0.0:
        least = LOST_IMAGES / camera.rate
        for name, dangerous, why in (
                ('predict_timeout', True, 'it loses the neighbor between two images'),
                ('perception_timeout', False, 'it brakes between two images')):
            if float(values.get(name, math.inf)) < least:
                yield Judgment(
                    dangerous, name, values[name], f'at least {math.ceil(100 * least) / 100:g} s '
                    f'for images at {camera.rate:.1f} Hz', why)


def _height(values: Mapping[str, Any], camera: Camera) -> Iterator[Judgment]:
    if not {'altitude_offset', 'd0', 'd1'} <= values.keys():
        return
    middle = 0.5 * (math.sqrt(float(values['d0'])) + math.sqrt(float(values['d1'])))
    view = 1.0 if camera.half_height is None else math.sin(camera.half_height)
    most = middle * min(STEEPEST, view)
    if abs(float(values['altitude_offset'])) > most:
        yield Judgment(True, 'altitude_offset', values['altitude_offset'],
                       f'within {math.floor(100.0 * most) / 100.0:g} m',
                       'the neighbor leaves the image above or below and comes near unseen')


def _hidden(values: Mapping[str, Any]) -> Iterator[Judgment]:
    assumed = float(values.get('leader_acceleration_max', 0.0))
    if assumed > RESTLESS:
        yield Judgment(False, 'leader_acceleration_max', assumed, f'at most {RESTLESS:g} m/s^2',
                       'it retreats at every short loss of sight')
