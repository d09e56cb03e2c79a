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
Projection by trying all candidates: slow, but plainly right: the reference for the planner's.

The best point within some bounds is a corner, or the best point of one boundary alone, or the
goal itself. All of them are tried, for every search anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
import math

from flock_follower.planner.projection import Discs, product, Side

TOLERANCE = 1e-9


def holds(point: complex, sides: Sequence[Side], discs: Discs) -> bool:
    """Return whether a point is within all bounds and both discs, but for rounding."""
    return all(product(normal, point) >= least - TOLERANCE for normal, least in sides) and all(
        abs(point - center) <= radius + TOLERANCE for center, radius in (discs[:2], discs[2:]))


def corners(sides: Sequence[Side], discs: Discs) -> Iterator[complex]:
    """Yield the points that two boundaries share."""
    for (one, level), (other, other_level) in combinations(sides, 2):
        cross = (one.conjugate() * other).imag
        if abs(cross) > 1e-6 * abs(one) * abs(other):
            yield -1j * (level * other - other_level * one) / cross
    for center, radius in (discs[:2], discs[2:]):
        for normal, least in sides:
            offset = (least - product(normal, center)) / abs(normal)
            yield from chord(center, normal / abs(normal), offset, radius)
    (center, radius), (other, other_radius) = discs[:2], discs[2:]
    if distance := abs(other - center):
        along = (distance + (radius - other_radius) * (radius + other_radius) / distance) / 2.0
        yield from chord(center, (other - center) / distance, along, radius)


def chord(center: complex, axis: complex, along: float, radius: float) -> Iterator[complex]:
    """Yield the points of a circle at a distance from its center along an axis, if any."""
    square = radius ** 2 - along ** 2
    if square > -TOLERANCE * max(radius, 1.0):
        for side in (1j, -1j):
            yield center + axis * (along + side * math.sqrt(max(square, 0.0)))


def nearest(goal: complex, sides: Sequence[Side], discs: Discs) -> complex | None:
    """Return the point within all bounds that is nearest to a goal, or None."""
    feet = [goal + (least - product(normal, goal)) / abs(normal) ** 2 * normal
            for normal, least in sides]
    rims = [center + radius * (goal - center) / (abs(goal - center) or 1.0)
            for center, radius in (discs[:2], discs[2:])]
    return min((point for point in (goal, *feet, *rims, *corners(sides, discs))
                if holds(point, sides, discs)), key=lambda point: abs(point - goal), default=None)


def farthest(direction: complex, sides: Sequence[Side], discs: Discs) -> complex | None:
    """Return a point within all bounds that is farthest in a direction, or None."""
    unit = direction / abs(direction)
    rims = [center + radius * unit for center, radius in (discs[:2], discs[2:])]
    return max((point for point in (*rims, *corners(sides, discs)) if holds(point, sides, discs)),
               key=lambda point: product(direction, point), default=None)


def nearest_in_order(wanted: complex, sides: Sequence[Side], discs: Discs) -> complex:
    """Return the point of the discs nearest to ``wanted`` that meets the first bounds first."""
    met, best = list[Side](), None
    for normal, least in sides:
        if (best := farthest(normal, met, discs)) is not None:
            met.append((normal, min(least, product(normal, best))))
    # Only rounding leaves nothing: then the bounds leave one point, and the last search found it.
    found = nearest(wanted, met, discs)
    found = best if found is None else found
    return discs.best(wanted) if found is None else found
