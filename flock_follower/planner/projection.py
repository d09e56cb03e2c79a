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
bounds cost at most m^2 steps, however they lie, and as a rule a few m. Three dimensions are in
here, two, and one, in ``plane_projection``.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner import plane_projection
from flock_follower.planner.plane_projection import (
    Discs,
    PARALLEL,
    product,
    ROUNDING,
    Side,
    TOLERANCE,
)

_HUGE = 1e30  # stands for infinity, which cannot be subtracted from itself


class Ball(NamedTuple):
    """All points at most ``radius`` from ``centre`` (n,)."""

    centre: Array
    radius: float

    def holds(self, point: Array) -> bool:
        """Return whether the point is inside, but for rounding."""
        return _length(point - self.centre) <= self.radius + TOLERANCE


class Bound(NamedTuple):
    """All points x with ``normal . x >= least``; the normal (n,) need not be of unit length."""

    normal: Array
    least: float

    def holds(self, point: Array) -> bool:
        """Return whether the point is inside, but for rounding."""
        return float(self.normal @ point) >= self.least - TOLERANCE


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
        if length <= TOLERANCE * _length(towards):
            return middle  # every direction is as good, and the middle lies inside
        return middle + across * (math.sqrt(max(radius ** 2 - along ** 2, 0.0)) / length)

    @property
    def discs(self) -> Discs:
        """Return the same in a plane."""
        (centre, radius), (other, other_radius) = self
        return Discs(_number(centre), radius, _number(other), other_radius)


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
    # A bound without a direction is met nowhere better than elsewhere.
    if len(wanted) < 3:
        return _array(plane_projection.lexicographic(
            _number(wanted), [side for side in _sides(bounds) if side[0]], lens.discs), wanted)
    normals, least = _rows(bounds)
    told = normals.any(axis=1)
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


class _Plane(NamedTuple):
    """The points ``foot + basis y`` of a plane, foot (3,), and what it cuts out of a lens."""

    foot: Array
    basis: Array
    """(3, 2), with columns of length 1 at right angles."""
    discs: Discs
    """In the coordinates y, as complex numbers; where the plane misses the lens a point near."""
    gap: float
    """By how much the plane misses the lens; at most 0 if it does not."""

    @classmethod
    def of(cls, normal: Array, level: float, lens: Lens) -> _Plane:
        """Return the plane ``normal . x == level``; normal (3,)."""
        size = _length(normal)
        unit, least = (normal / size, level / size) if size else (normal, level)
        basis = _across(unit)
        (centre, radius), (other, other_radius) = lens
        height, other_height = least - float(unit @ centre), least - float(unit @ other)
        cut = math.sqrt(max((radius - height) * (radius + height), 0.0))
        other_cut = math.sqrt(
            max((other_radius - other_height) * (other_radius + other_height), 0.0))
        between = _number(basis.T @ (other - centre))
        gap = max(abs(height) - radius, abs(other_height) - other_radius,
                  abs(between) - cut - other_cut)
        return cls(centre + height * unit, basis, Discs(0j, cut, between, other_cut),
                   gap if size else math.inf)

    def within(self, goal: _Goal) -> complex:
        """Return a goal in the plane's coordinates."""
        return _number(self.basis.T @ (goal.vector if goal.far else goal.vector - self.foot))

    def sides(self, normals: Array, least: Array) -> list[Side]:
        """Return bounds, normals (m, 3) and least (m,), in the plane's coordinates."""
        slopes = normals @ self.basis
        slopes[abs(slopes) < PARALLEL] = 0.0
        return [(complex(x, y), value) for (x, y), value in zip(
            slopes.tolist(), (least - normals @ self.foot).tolist())]

    def lift(self, point: complex) -> Array:
        """Return the point (3,) that has the coordinates."""
        return self.foot + self.basis @ np.array([point.real, point.imag])


def _best(goal: _Goal, bounds: Sequence[Bound], lens: Lens) -> Array | None:
    if len(goal.vector) < 3:
        number, met = plane_projection.optimum(
            _number(goal.vector), goal.far, _sides(bounds), lens.discs)
        return _array(number, goal.vector) if met == len(bounds) else None
    point, met = _optimum(goal, *_rows(bounds), lens)
    return point if met == len(bounds) else None


def _sides(bounds: Sequence[Bound]) -> list[Side]:
    return [(_number(normal), min(max(least, -_HUGE), _HUGE)) for normal, least in bounds]


def _rows(bounds: Sequence[Bound]) -> tuple[Array, Array]:
    """Return the normals (m, 3) of m bounds, and what they ask for (m,)."""
    return (np.array([bound.normal for bound in bounds]).reshape(-1, 3),
            np.clip([bound.least for bound in bounds], -_HUGE, _HUGE))


def _optimum(goal: _Goal, normals: Array, least: Array, lens: Lens) -> tuple[Array, int]:
    """Return the best point (3,) for as many of the first bounds as leave room, and how many."""
    point, k = goal.over(lens), 0
    while True:
        missed = np.flatnonzero(normals[k:] @ point < least[k:] - ROUNDING)
        if not len(missed):
            return point, len(least)
        k += int(missed[0])
        plane = _Plane.of(normals[k], float(least[k]), lens)
        if plane.gap > ROUNDING:
            return point, k
        place, sides = plane.within(goal), plane.sides(normals[:k], least[:k])
        # Those missed most first: fewer of the others are then missed.
        start, _ = plane_projection.optimum(place, goal.far, (), plane.discs)
        sides.sort(key=lambda side: product(side[0], start) - side[1])
        inside, met = plane_projection.optimum(place, goal.far, sides, plane.discs)
        if met < k:
            return point, k
        point, k = plane.lift(inside), k + 1


def _lexicographic(wanted: Array, normals: Array, least: Array, lens: Lens) -> Array:
    """Do as ``lexicographic`` with bounds as rows: normals (m, 3) and least (m,)."""
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
    felt = [side for side in plane.sides(normals[others], least[others]) if side[0]]
    return plane.lift(plane_projection.lexicographic(
        plane.within(_Goal(wanted, False)), felt, plane.discs))


def _across(unit: Array) -> Array:
    """Return a basis (3, 2) of the plane across a unit vector, by a Householder reflection."""
    mirror = unit.copy()
    mirror[-1] += math.copysign(1.0, mirror[-1])
    basis: Array = mirror[:, None] * (mirror[:-1] / -abs(mirror[-1]))
    basis.ravel()[::len(unit)] += 1.0  # the diagonal
    return basis


def _number(vector: Array) -> complex:
    """Return a vector (1,) or (2,) as a complex number."""
    return complex(*vector.tolist())


def _array(number: complex, like: Array) -> Array:
    """Return a complex number as a vector (1,) or (2,), of the length of another."""
    return np.array([number.real, number.imag][:len(like)])


def _length(vector: Array) -> float:
    return math.sqrt(float(vector @ vector))
