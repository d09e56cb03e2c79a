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

The bounds are taken one after the other (Seidel, "Small-dimensional linear programming and convex
hulls made easy", Discrete & Computational Geometry 6, 1991, here with balls and distances): while
the best point for those before keeps a bound, it stays the best. Where it does not, the best
point lies in the bound's plane, since the set is convex: it is sought there, under the bounds
before, in one dimension less; in one dimension an interval is all there is. Where the plane holds
no such point, this is the first bound that those before leave no room for. In two dimensions m
bounds cost at most m^2 steps, however they lie, and as a rule a few m.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array

_TOLERANCE = 1e-9  # of lengths of the order of 1; what is left over is cut off by the caller
_ROUNDING = 1e-11  # likewise inside a search: far above rounding, far below what one asks `holds`
_PARALLEL = 1e-11  # slope along a plane of a bound that is parallel to it but for rounding
_HUGE = 1e30  # stands for infinity, which cannot be subtracted from itself


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
    """Return the point of the lens within all bounds that is nearest to ``wanted``, or None."""
    return _best(_Goal(wanted, False), bounds, lens)


def farthest(direction: Array, bounds: Sequence[Bound], lens: Lens) -> Array | None:
    """Return a point of the lens within all bounds farthest in a direction, or None."""
    return _best(_Goal(direction, True), bounds, lens)


def lexicographic(wanted: Array, bounds: Sequence[Bound], lens: Lens) -> Array:
    """
    Return the point of the lens nearest to ``wanted`` that meets the bounds, the first ones first.

    A bound that the ones before it leave no room for is met as nearly as they allow, so none
    costs one before it anything.
    """
    normals, least = _rows(bounds, len(wanted))
    told = normals.any(axis=1)  # a bound without a direction is met nowhere better than elsewhere
    return _lexicographic(wanted, normals[told], least[told], lens)


class _Goal(NamedTuple):
    """What is best: to be nearest to a place (n,), or farthest in a direction (n,)."""

    vector: Array
    far: bool

    def over(self, lens: Lens) -> Array:
        """Return the best point (n,) of a lens."""
        if not self.far:
            return lens.nearest(self.vector)
        return lens.farthest(self.vector) if self.vector.any() else lens.nearest(self.vector)

    def between(self, low: float, high: float) -> float:
        """Return the best number of an interval, in one dimension."""
        best = float(self.vector[0])
        return min(max(math.copysign(math.inf, best) if self.far else best, low), high)


class _Plane(NamedTuple):
    """The points ``foot + basis y`` of a plane, foot (n,), and what it cuts out of a lens."""

    foot: Array
    basis: Array
    """(n, n - 1), with columns of length 1 at right angles."""
    lens: Lens
    """In the coordinates y (n - 1,); where the plane misses the lens a point near it."""
    gap: float
    """By how much the plane misses the lens; at most 0 if it does not."""

    @classmethod
    def of(cls, normal: Array, level: float, lens: Lens) -> _Plane:
        """Return the plane ``normal . x == level``; normal (n,)."""
        size = _length(normal)
        unit, least = (normal / size, level / size) if size else (normal, level)
        basis = _across(unit)
        (centre, radius), (other, other_radius) = lens
        height, other_height = least - float(unit @ centre), least - float(unit @ other)
        cut = math.sqrt(max((radius - height) * (radius + height), 0.0))
        other_cut = math.sqrt(
            max((other_radius - other_height) * (other_radius + other_height), 0.0))
        between = basis.T @ (other - centre)
        gap = max(abs(height) - radius, abs(other_height) - other_radius,
                  _length(between) - cut - other_cut)
        return cls(centre + height * unit, basis,
                   Lens(Ball(np.zeros(len(between)), cut), Ball(between, other_cut)),
                   gap if size else math.inf)

    def within(self, goal: _Goal) -> _Goal:
        """Return a goal in the plane's coordinates."""
        return _Goal(self.basis.T @ (goal.vector if goal.far else goal.vector - self.foot),
                     goal.far)

    def rows(self, normals: Array, least: Array) -> tuple[Array, Array]:
        """Return bounds, normals (m, n) and least (m,), in the plane's coordinates."""
        slopes = normals @ self.basis
        slopes[abs(slopes) < _PARALLEL] = 0.0
        return slopes, least - normals @ self.foot

    def lift(self, point: Array) -> Array:
        """Return the point (n,) that has the coordinates (n - 1,)."""
        return self.foot + self.basis @ point


def _best(goal: _Goal, bounds: Sequence[Bound], lens: Lens) -> Array | None:
    point, met = _optimum(goal, *_rows(bounds, len(goal.vector)), lens)
    return point if met == len(bounds) else None


def _rows(bounds: Sequence[Bound], n: int) -> tuple[Array, Array]:
    """Return the normals (m, n) of m bounds, and what they ask for (m,)."""
    return (np.array([bound.normal for bound in bounds]).reshape(-1, n),
            np.clip([bound.least for bound in bounds], -_HUGE, _HUGE))


def _optimum(goal: _Goal, normals: Array, least: Array, lens: Lens,
             in_order: bool = True) -> tuple[Array, int]:
    """
    Return the best point (n,) within as many of the first bounds as leave room, and how many.

    In one dimension, or not ``in_order``, both count only if that is all of them.
    """
    if len(goal.vector) == 1:
        low, high, met = _room(*_ends(lens), normals[:, 0], least)
        return np.array([goal.between(low, high)]), met
    point, k = goal.over(lens), 0
    if not in_order:  # those missed most first: fewer of the others are then missed
        order = np.argsort(normals @ point - least)
        normals, least = normals[order], least[order]
    while True:
        missed = np.flatnonzero(normals[k:] @ point < least[k:] - _ROUNDING)
        if not len(missed):
            return point, len(least)
        k += int(missed[0])
        plane = _Plane.of(normals[k], float(least[k]), lens)
        if plane.gap > _ROUNDING:
            return point, k
        inside, met = _optimum(plane.within(goal), *plane.rows(normals[:k], least[:k]), plane.lens,
                               in_order=False)
        if met < k:
            return point, k
        point, k = plane.lift(inside), k + 1


def _lexicographic(wanted: Array, normals: Array, least: Array, lens: Lens) -> Array:
    """Do as ``lexicographic`` with bounds as rows: normals (m, n) and least (m,)."""
    if len(wanted) == 1:
        low, high = _ends(lens)
        for slope, value in zip(normals[:, 0].tolist(), least.tolist()):
            if slope > 0.0:
                low = max(low, min(value / slope, high))
            elif slope < 0.0:
                high = min(high, max(value / slope, low))
        return np.array([_Goal(wanted, False).between(low, high)])
    point, k = _optimum(_Goal(wanted, False), normals, least, lens)
    if k == len(least):
        return point
    while True:
        reached, met = _optimum(_Goal(normals[k], True), normals[:k], least[:k], lens)
        if met == k:
            break
        k = met  # only rounding leads here: up to this bound already there is hardly a point
    # All that is left lies in the plane that meets the bound as nearly as possible.
    plane = _Plane.of(normals[k], min(float(least[k]), float(normals[k] @ reached)), lens)
    others = np.arange(len(least)) != k
    slopes, values = plane.rows(normals[others], least[others])
    felt = slopes.any(axis=1)
    inside = _lexicographic(plane.basis.T @ (wanted - plane.foot), slopes[felt], values[felt],
                            plane.lens)
    return plane.lift(inside)


def _ends(lens: Lens) -> tuple[float, float]:
    """Return the ends of a lens in one dimension; twice the middle if rounding emptied it."""
    (centre, radius), (other, other_radius) = lens
    low = max(float(centre[0]) - radius, float(other[0]) - other_radius)
    high = min(float(centre[0]) + radius, float(other[0]) + other_radius)
    return (low, high) if low <= high else ((low + high) / 2.0,) * 2


def _room(low: float, high: float, slopes: Array, least: Array) -> tuple[float, float, int]:
    """Return what bounds ``slopes y >= least``, (m,), leave of an interval, and how many do."""
    for k, (slope, value) in enumerate(zip(slopes.tolist(), (least - _ROUNDING).tolist())):
        if slope > 0.0:
            low = max(low, value / slope)
        elif slope < 0.0:
            high = min(high, value / slope)
        elif value > 0.0:
            return low, high, k
        if low > high:
            return low, high, k
    return low, high, len(least)


def _across(unit: Array) -> Array:
    """Return a basis (n, n - 1) of the plane across a unit vector, by a Householder reflection."""
    if len(unit) == 2:
        return np.array([[-unit[1]], [unit[0]]])
    mirror = unit.copy()
    mirror[-1] += math.copysign(1.0, mirror[-1])
    basis: Array = mirror[:, None] * (mirror[:-1] / -abs(mirror[-1]))
    basis.ravel()[::len(unit)] += 1.0  # the diagonal
    return basis


def _length(vector: Array) -> float:
    return math.sqrt(float(vector @ vector))
