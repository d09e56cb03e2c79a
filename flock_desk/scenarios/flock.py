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

"""A flock of followers: their formation, what each carries, and which of them fails."""

from __future__ import annotations

from dataclasses import dataclass, fields, MISSING
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.ranges import Checked, parameter, Range

FORMATIONS = ('line', 'wedge', 'ring', 'grid')
SIDES = ('front', 'left', 'right', 'back', 'up', 'down')
LEADER = 'leader'
ARM = 0.6  # rad between an arm of a wedge and straight behind the leader
_CIRCLE = 6  # followers on the innermost circle of a ring: as far apart as from its middle


class Part(Checked):
    """A part of a scenario, checked as it is made."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in fields(self):  # type: ignore[arg-type]
            if field.type == 'Interval':
                low, high = getattr(self, field.name)
                if low > high:
                    raise ValueError(f'{field.name} = {[low, high]}: must be [lowest, highest]')


@dataclass(frozen=True)
class FollowerFailure(Part):
    """Failure of one follower's computer: the vehicle is silent, hovers, and then disappears."""

    follower: int = parameter(MISSING, Range(1, whole=True), 'Number of the follower, from 1 on.')
    at: float = parameter(MISSING, Range(0.0, 3600.0, 's'), 'Time of the failure, s.')
    gone: float = parameter(8.0, Range(0.0, 3600.0, 's'), 'Time from failure to disappearance, s.')


@dataclass(frozen=True)
class Flock(Part):
    """Several followers of one leader, in flights in lock step."""

    followers: int = parameter(4, Range(1, 50, whole=True))
    formation: str = parameter(
        'line', FORMATIONS,
        "Initial formation: 'line', one behind the other; 'wedge'; 'ring' round the leader; "
        "'grid', in rows.")
    spacing: float = parameter(1.8, Range(0.1, 20.0, 'm'), 'Distance of each to the one ahead, m.')
    faces: tuple[str, ...] = parameter(
        ('back',), None,
        "Sides of every body that carry a marker, the leader's too: some of ``SIDES``.")
    cameras: tuple[str, ...] = parameter(
        ('front',), None, "Viewing directions of every follower's cameras: some of ``SIDES``.")
    half_width: float = parameter(
        0.5, Range(0.1, 5.0),
        "Tangent of a camera's horizontal half angle of view. The image's aspect ratio and the "
        'angle per pixel do not change. Four cameras leave no gap from about 1.1 on.')
    farthest: float = parameter(
        5.0, Range(0.5, 100.0, 'm'), 'Distance up to which a marker is found, m.')
    words: bool = parameter(
        False, None, 'Whether followers send each other their states and detections.')
    ranges: bool = parameter(
        False, None,
        "Whether followers measure their distances by radio, with the errors of 'ranges'.")
    delay: float = parameter(
        0.05, Range(0.0, 2.0, 's'), 'Delay of a message from sender to receiver, s.')
    loss: float = parameter(0.0, Range(0.0, 1.0), 'Share of messages that do not arrive.')
    fails: FollowerFailure | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ('faces', 'cameras'):
            given = getattr(self, name)
            if not given or len(set(given)) < len(given) or not set(given) <= set(SIDES):
                raise ValueError(f'{name} = [{", ".join(given)}]: must be some of '
                                 f'{", ".join(SIDES)}, each once')
        if self.fails is not None and self.fails.follower > self.followers:
            raise ValueError(f'fails = follower {self.fails.follower}: must be an integer in '
                             f'[1, followers], where followers = {self.followers}')

    @property
    def names(self) -> list[str]:
        """Return the names of the vehicles: the leader, then the followers."""
        return [LEADER, *(f'follower_{k}' for k in range(1, self.followers + 1))]

    @property
    def all_round(self) -> bool:
        """Return whether cameras look to all sides."""
        return set(SIDES[:4]) <= set(self.cameras)


class Place(NamedTuple):
    """Where a follower begins."""

    offset: Array
    """(3,), from the leader, which faces along x, m."""
    ahead: int
    """Number of the vehicle that it faces, its neighbor; 0 is the leader."""


def places(flock: Flock) -> list[Place]:
    """Return where the followers begin, in the order of their numbers."""
    return [Place(flock.spacing * np.array([x, y, 0.0]), ahead)
            for x, y, ahead in _SHAPES[flock.formation](flock.followers)]


def facing_ahead(places: list[Place]) -> Array:
    """Return the yaws (n,), rad, with which followers face the vehicles ahead."""
    offsets = [np.zeros(3), *(place.offset for place in places)]
    to = [offsets[place.ahead] - place.offset for place in places]
    return np.array([math.atan2(y, x) for x, y, _ in to])


def _line(count: int) -> list[tuple[float, float, int]]:
    return [(-float(k), 0.0, k - 1) for k in range(1, count + 1)]


def _wedge(count: int) -> list[tuple[float, float, int]]:
    return [(-row * math.cos(ARM), side * row * math.sin(ARM), max(k - 2, 0))
            for k in range(1, count + 1)
            for row, side in [((k + 1) // 2, 1.0 if k % 2 else -1.0)]]


def _ring(count: int) -> list[tuple[float, float, int]]:
    found: list[tuple[float, float, int]] = []
    inner, circle = 0, 0  # numbers up to which the circles before are filled
    while len(found) < count:
        circle += 1
        first, many = len(found), min(_CIRCLE * circle, count - len(found))
        for i in range(many):
            angle = math.pi + 2.0 * math.pi * i / many
            x, y = circle * math.cos(angle), circle * math.sin(angle)
            ahead = 0 if circle == 1 else 1 + inner + min(
                range(first - inner), key=lambda k: math.dist(found[inner + k][:2], (x, y)))
            found.append((x, y, ahead))
        inner = first
    return found


def _grid(count: int) -> list[tuple[float, float, int]]:
    columns = math.isqrt(count)
    return [(-1.0 - row, 0.5 * (min(columns, count - row * columns) - 1) - column,
             max(k + 1 - columns, 0))
            for k in range(count) for row, column in [divmod(k, columns)]]


_SHAPES = {'line': _line, 'wedge': _wedge, 'ring': _ring, 'grid': _grid}
