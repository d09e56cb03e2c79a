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
The best point of a plane within two discs and linear bounds.

The bounds are added one after the other (Seidel, "Small-dimensional linear programming and convex
hulls made easy", Discrete & Computational Geometry 6, 1991, here with discs and distances). If the
best point so far keeps the next bound, it remains the best point. Otherwise the best point lies on
the line of this bound, because the set is convex: it is the best point of an interval of the line.
If the interval is empty, the bounds before leave no room for this bound. m bounds need at most m^2
steps, usually a few m.

Points are complex numbers: small arrays would take ten times as long.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

LENGTH_TOLERANCE = 1e-9  # of lengths of the order of 1; the caller cuts off the rest
ROUNDING_ERROR = 1e-11  # likewise inside a search: far above rounding, far below LENGTH_TOLERANCE
PARALLEL = 1e-11  # slope along a line of a bound that is parallel to it but for rounding
_HUGE = 1e30  # stands for infinity, which cannot be subtracted from itself

#: A bound: a normal n and a level c; a point p keeps the bound if product(n, p) >= c.
Side = tuple[complex, float]


def product(one: complex, other: complex) -> float:
    """Return the scalar product."""
    return one.real * other.real + one.imag * other.imag


class Discs(NamedTuple):
    """The points in both of two discs; there must be at least one."""

    center: complex
    radius: float
    other: complex
    other_radius: float

    def best(self, goal: complex, far: bool = False) -> complex:
        """
        Return the point that is nearest to a place.

        :param far: whether the goal is a direction, not zero; then return the point that is
            farthest in this direction.
        """
        center, radius, other, other_radius = self
        if not far and (abs(goal - center) <= radius + LENGTH_TOLERANCE
                        and abs(goal - other) <= other_radius + LENGTH_TOLERANCE):
            return goal
        towards = goal / abs(goal) if far else goal - center
        for here, here_radius, there, there_radius in (
                (center, radius, other, other_radius), (other, other_radius, center, radius)):
            distance = abs(goal - here)
            if far:
                point = here + here_radius * towards
            else:
                point = goal if distance <= here_radius else (
                    here + (goal - here) * (here_radius / distance))
            if abs(point - there) <= there_radius + LENGTH_TOLERANCE:
                return point
        return self._on_rim(towards)

    def _on_rim(self, towards: complex) -> complex:
        """Return the point where both rims meet that lies farthest in a direction."""
        center, radius, other, other_radius = self
        distance = abs(other - center)
        if distance == 0.0:
            return center
        axis = (other - center) / distance
        along = (distance + (radius - other_radius) * (radius + other_radius) / distance) / 2.0
        along = min(max(along, -radius), radius)
        across = towards - axis * product(axis, towards)
        length = abs(across)
        if length <= LENGTH_TOLERANCE * abs(towards):
            return center + along * axis  # every direction is as good, and this lies inside
        return center + along * axis + across * (
            math.sqrt(max(radius ** 2 - along ** 2, 0.0)) / length)


class _Line(NamedTuple):
    """The points ``foot + y * along`` of a line, and the range of y within two discs."""

    foot: complex
    along: complex
    low: float
    high: float
    """At most ``low`` if the line misses the common part of the discs."""
    gap: float
    """Distance by which the line misses the discs; <= 0 if the line meets them."""

    @classmethod
    def of(cls, normal: complex, level: float, discs: Discs) -> _Line:
        """Return the line of the points p with ``product(normal, p) == level``."""
        center, radius, other, other_radius = discs
        size = abs(normal)
        unit, least = (normal / size, level / size) if size else (normal, level)
        height, other_height = least - product(unit, center), least - product(unit, other)
        cut = math.sqrt(max((radius - height) * (radius + height), 0.0))
        other_cut = math.sqrt(
            max((other_radius - other_height) * (other_radius + other_height), 0.0))
        along = 1j * unit
        between = product(along, other - center)
        low, high = max(-cut, between - other_cut), min(cut, between + other_cut)
        gap = max(abs(height) - radius, abs(other_height) - other_radius,
                  abs(between) - cut - other_cut)
        if low > high:  # by rounding, or because the line misses them
            low = high = (low + high) / 2.0
        return cls(center + height * unit, along, low, high, gap if size else math.inf)

    def best_between(self, goal: complex, far: bool, low: float, high: float) -> complex:
        """Return the best point from ``low`` to ``high``: see ``optimum``."""
        if far:
            best = math.copysign(math.inf, self.slope(goal))
        else:
            best = product(self.along, goal - self.foot)
        return self.foot + min(max(best, low), high) * self.along

    def slope(self, normal: complex) -> float:
        """Return the slope of ``product(normal, p)`` for points p along the line."""
        slope = product(self.along, normal)
        return 0.0 if abs(slope) < PARALLEL else slope

    def room(self, sides: Sequence[Side]) -> tuple[float, float] | None:
        """Return the range of y in which all bounds are kept, or None."""
        low, high = self.low, self.high
        for normal, least in sides:
            slope, value = self.slope(normal), least - product(normal, self.foot) - ROUNDING_ERROR
            if slope > 0.0:
                low = max(low, value / slope)
            elif slope < 0.0:
                high = min(high, value / slope)
            elif value > 0.0:
                return None
            if low > high:
                return None
        return low, high


def optimum(goal: complex, far: bool, sides: Sequence[Side], discs: Discs) -> tuple[complex, int]:
    """
    Return the best point within as many of the first bounds as leave room, and how many.

    :param goal: the point is the nearest to this place; if ``far``, the farthest in this
        direction.
    """
    point = discs.best(goal, far and goal != 0.0)
    for k, (normal, least) in enumerate(sides):
        if normal.real * point.real + normal.imag * point.imag < least - ROUNDING_ERROR:
            line = _Line.of(normal, least, discs)
            if line.gap > ROUNDING_ERROR or (ends := line.room(sides[:k])) is None:
                return point, k
            point = line.best_between(goal, far, *ends)
    return point, len(sides)


def nearest_in_order(goal: complex, sides: Sequence[Side], discs: Discs) -> complex:
    """
    Return the point of the discs that meets the bounds and is nearest to ``goal``.

    The bounds are in order of priority: if the earlier ones leave no room for a bound, it is met
    as nearly as they permit. A bound whose normal is zero is ignored.
    """
    sides = [(normal, math.copysign(_HUGE, least) if abs(least) > _HUGE else least)
             for normal, least in sides if normal]
    point, k = optimum(goal, False, sides, discs)
    if k == len(sides):
        return point
    while True:
        reached, met = optimum(sides[k][0], True, sides[:k], discs)
        if met == k:
            break
        k = met  # only rounding leads here: up to this bound already there is hardly a point
    # All that is left lies on the line that meets the bound as nearly as possible.
    normal, least = sides[k]
    line = _Line.of(normal, min(least, product(normal, reached)), discs)
    low, high = line.low, line.high
    for j, (other, value) in enumerate(sides):
        slope = line.slope(other)
        if j == k or slope == 0.0:
            continue
        there = (value - product(other, line.foot)) / slope
        if slope > 0.0 and there > low:
            low = min(there, high)
        elif slope < 0.0 and there < high:
            high = max(there, low)
    return line.best_between(goal, False, low, high)
