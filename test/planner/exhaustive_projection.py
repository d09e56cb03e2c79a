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
Projection by trying all active sets: slow, but plainly right. The planner's is held to it.

The best point within some bounds is the best of the points that meet some of them with equality,
at most n of them, among those that keep the others. All such choices are tried, for every search
anew; the number of choices grows with the n-th power of the number of bounds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner import projection
from flock_follower.planner.projection import Discs, Side

TOLERANCE = 1e-9


class Ball(NamedTuple):
    """All points at most ``radius`` from ``centre`` (n,)."""

    centre: Array
    radius: float

    def holds(self, point: Array) -> bool:
        """Return whether the point is inside, but for rounding."""
        return length(point - self.centre) <= self.radius + TOLERANCE


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
            distance = length(away)
            point = wanted if distance <= ball.radius else (
                ball.centre + away * (ball.radius / distance))
            if rest.holds(point):
                return point
        return self._on_rim(wanted - one.centre)

    def farthest(self, direction: Array) -> Array:
        """Return the point of the lens that is farthest in a direction, which is not zero."""
        unit = direction / length(direction)
        for ball, rest in (self, self[::-1]):
            point = ball.centre + ball.radius * unit
            if rest.holds(point):
                return point
        return self._on_rim(unit)

    def _on_rim(self, towards: Array) -> Array:
        """Return the point where both surfaces meet that lies farthest in a direction."""
        (centre, radius), (other, other_radius) = self
        axis = other - centre
        distance = length(axis)
        if distance == 0.0:
            return centre
        axis = axis / distance
        along = (distance + (radius - other_radius) * (radius + other_radius) / distance) / 2.0
        along = min(max(along, -radius), radius)
        across = towards - axis * float(axis @ towards)
        middle = centre + along * axis
        wide = length(across)
        if wide <= TOLERANCE * length(towards):
            return middle  # every direction is as good, and the middle lies inside
        return middle + across * (math.sqrt(max(radius ** 2 - along ** 2, 0.0)) / wide)


def planners(wanted: Array, bounds: Sequence[Bound], lens: Lens) -> Array:
    """Return what the planner's own search finds; in two dimensions."""
    return as_array(projection.lexicographic(as_number(wanted), sides(bounds), discs(lens)))


def planners_best(goal: Array, far: bool, bounds: Sequence[Bound], lens: Lens) -> Array | None:
    """Return the planner's own nearest or farthest point within all bounds, or None."""
    point, met = projection.optimum(as_number(goal), far, sides(bounds), discs(lens))
    return as_array(point) if met == len(bounds) else None


def sides(bounds: Sequence[Bound]) -> list[Side]:
    return [(as_number(bound.normal), bound.least) for bound in bounds]


def discs(lens: Lens) -> Discs:
    (centre, radius), (other, other_radius) = lens
    return Discs(as_number(centre), radius, as_number(other), other_radius)


def as_number(vector: Array) -> complex:
    return complex(*vector.tolist())


def as_array(number: complex) -> Array:
    return np.array([number.real, number.imag])



def nearest(wanted: Array, bounds: Sequence[Bound], lens: Lens) -> Array | None:
    """Return the point of the lens within all bounds that is nearest to ``wanted``, or None."""
    best, least = None, math.inf
    for flat in flats(bounds, lens):
        point = flat.nearest(wanted)
        if all(bound.holds(point) for bound in bounds):
            distance = length(point - wanted)
            if distance < least:
                best, least = point, distance
    return best


def farthest(direction: Array, bounds: Sequence[Bound], lens: Lens) -> Array | None:
    """Return a point of the lens within all bounds farthest in a direction, or None."""
    best, most = None, -math.inf
    for flat in flats(bounds, lens):
        point = flat.farthest(direction)
        if all(bound.holds(point) for bound in bounds):
            reach = float(direction @ point)
            if reach > most:
                best, most = point, reach
    return best


def lexicographic(wanted: Array, bounds: Sequence[Bound], lens: Lens) -> Array:
    """Return the point of the lens nearest to ``wanted`` that meets the first bounds first."""
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


class Flat(NamedTuple):
    """A lens cut by the flat ``foot + basis y``; in the coordinates y it is a lens again."""

    foot: Array
    basis: Array
    lens: Lens

    def nearest(self, wanted: Array) -> Array:
        return self.foot + self.basis @ self.lens.nearest(self.basis.T @ (wanted - self.foot))

    def farthest(self, direction: Array) -> Array:
        inside = self.basis.T @ direction
        if length(inside) <= TOLERANCE * length(direction):
            return self.nearest(self.foot)
        return self.foot + self.basis @ self.lens.farthest(inside)


def flats(bounds: Sequence[Bound], lens: Lens) -> Iterator[Flat]:
    """Yield the lens itself, and its cuts by every choice of at most n planes."""
    n = len(lens.first.centre)
    for count in range(min(n, len(bounds)) + 1):
        for chosen in combinations(bounds, count):
            if not chosen:
                yield Flat(np.zeros(n), np.eye(n), lens)
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
                left = radius ** 2 - length(offset - basis @ inside) ** 2
                if left < -TOLERANCE * max(radius, 1.0):
                    break
                balls.append(Ball(inside, math.sqrt(max(left, 0.0))))
            # A flat may cut both balls and yet miss what they have in common.
            if len(balls) == 2 and (length(balls[0].centre - balls[1].centre)
                                    <= balls[0].radius + balls[1].radius + TOLERANCE):
                yield Flat(foot, basis, Lens(*balls))


def length(vector: Array) -> float:
    return math.sqrt(float(vector @ vector))
