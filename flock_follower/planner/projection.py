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
The points that lie in two balls and obey linear bounds: which is nearest, which goes farthest.

Closed forms, for a handful of bounds in two or three dimensions. Every set met here is convex.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array

_TOLERANCE = 1e-9  # of lengths of the order of 1; what is left over is cut off by the caller


class Ball(NamedTuple):
    """All points at most ``radius`` from ``centre`` (n,)."""

    centre: Array
    radius: float

    def holds(self, point: Array) -> bool:
        """Return whether the point is inside, but for rounding."""
        return _length(point - self.centre) <= self.radius + _TOLERANCE


class Bound(NamedTuple):
    """All points x with ``normal . x >= least``; the normal (n,) need not be of unit length."""

    normal: Array
    least: float

    def holds(self, point: Array) -> bool:
        """Return whether the point is inside, but for rounding."""
        return float(self.normal @ point) >= self.least - _TOLERANCE


class Lens(NamedTuple):
    """All points in both of two balls; they must have one in common."""

    first: Ball
    second: Ball

    def nearest(self, wanted: Array) -> Array:
        """Return the point of the lens that is nearest to the wanted one."""
        one, other = self.first, self.second
        if one.holds(wanted) and other.holds(wanted):
            return wanted
        for ball, rest in ((one, other), (other, one)):
            away = wanted - ball.centre
            distance = _length(away)
            point = wanted if distance <= ball.radius else (
                ball.centre + away * (ball.radius / distance))
            if rest.holds(point):
                return point
        return self._on_rim(wanted - one.centre)

    def farthest(self, direction: Array) -> Array:
        """Return the point of the lens that is farthest in a direction, which is not zero."""
        unit = direction / _length(direction)
        for ball, rest in (self, self[::-1]):
            point = ball.centre + ball.radius * unit
            if rest.holds(point):
                return point
        return self._on_rim(unit)

    def _on_rim(self, towards: Array) -> Array:
        """Return the point where both surfaces meet that lies farthest in a direction."""
        (centre, radius), (other, other_radius) = self
        axis = other - centre
        distance = _length(axis)
        if distance == 0.0:
            return centre
        axis = axis / distance
        along = (distance + (radius - other_radius) * (radius + other_radius) / distance) / 2.0
        along = min(max(along, -radius), radius)
        across = towards - axis * float(axis @ towards)
        middle = centre + along * axis
        length = _length(across)
        if length <= _TOLERANCE * _length(towards):
            return middle  # every direction is as good, and the middle lies inside
        return middle + across * (math.sqrt(max(radius ** 2 - along ** 2, 0.0)) / length)


def nearest(wanted: Array, bounds: Sequence[Bound], lens: Lens) -> Array | None:
    """
    Return the point of the lens within all bounds that is nearest to ``wanted``, or None.

    The nearest point is the nearest of the points that meet some of the bounds with equality, at
    most n of them, among those that keep the others: all such choices are tried.
    """
    best, least = None, math.inf
    for flat in _flats(bounds, lens):
        point = flat.nearest(wanted)
        if all(bound.holds(point) for bound in bounds):
            distance = _length(point - wanted)
            if distance < least:
                best, least = point, distance
    return best


def farthest(direction: Array, bounds: Sequence[Bound], lens: Lens) -> Array | None:
    """Return the point of the lens within all bounds farthest in a direction, or None."""
    best, most = None, -math.inf
    for flat in _flats(bounds, lens):
        point = flat.farthest(direction)
        if all(bound.holds(point) for bound in bounds):
            reach = float(direction @ point)
            if reach > most:
                best, most = point, reach
    return best


def lexicographic(wanted: Array, bounds: Sequence[Bound], lens: Lens) -> Array:
    """
    Return the point of the lens nearest to ``wanted`` that meets the bounds, the first ones first.

    A bound that the ones before it leave no room for is met as nearly as they allow, so none
    costs one before it anything.
    """
    met: list[Bound] = []
    best: Array | None = None
    for bound in bounds:
        best = farthest(bound.normal, met, lens)
        if best is not None:
            met.append(Bound(bound.normal, min(bound.least, float(bound.normal @ best))))
    point = nearest(wanted, met, lens)
    if point is not None:
        return point
    # Only rounding leads here: the bounds leave one point, and the last search found it.
    return lens.nearest(wanted) if best is None else best


class _Flat(NamedTuple):
    """A lens cut by the flat ``foot + basis y``; in the coordinates y it is a lens again."""

    foot: Array
    basis: Array
    lens: Lens

    def nearest(self, wanted: Array) -> Array:
        return self.foot + self.basis @ self.lens.nearest(self.basis.T @ (wanted - self.foot))

    def farthest(self, direction: Array) -> Array:
        inside = self.basis.T @ direction
        if _length(inside) <= _TOLERANCE * _length(direction):
            return self.nearest(self.foot)
        return self.foot + self.basis @ self.lens.farthest(inside)


def _flats(bounds: Sequence[Bound], lens: Lens) -> Iterator[_Flat]:
    """Yield the lens itself, and its cuts by every choice of at most n planes."""
    n = len(lens.first.centre)
    for count in range(min(n, len(bounds)) + 1):
        for chosen in combinations(bounds, count):
            if not chosen:
                yield _Flat(np.zeros(n), np.eye(n), lens)
                continue
            _, sizes, rows = np.linalg.svd(np.array([b.normal for b in chosen]))
            if sizes[-1] <= 1e-6 * sizes[0]:
                continue  # parallel bounds: no common point, or one is superfluous
            foot = np.linalg.lstsq(np.array([b.normal for b in chosen]),
                                   np.array([b.least for b in chosen]), rcond=None)[0]
            basis = rows[count:].T
            balls = []
            for centre, radius in lens:
                offset = centre - foot
                inside = basis.T @ offset
                left = radius ** 2 - _length(offset - basis @ inside) ** 2
                if left < -_TOLERANCE * max(radius, 1.0):
                    break
                balls.append(Ball(inside, math.sqrt(max(left, 0.0))))
            if len(balls) == 2:
                yield _Flat(foot, basis, Lens(*balls))


def _length(vector: Array) -> float:
    return math.sqrt(float(vector @ vector))
