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
The guard of the band: what a command becomes where the law would leave it.

It holds ``sqrt(d0) < r < sqrt(d1)`` where the law alone does not. With p = x_F - x_L from
the neighbour to oneself, w = v_F - v_L, r = |p|, n = p / r and s = n . w, it lets the distance
change no faster than one can still stop the change before the edge, less a margin m:

    h_near = s + S(r - sqrt(d0) - m) >= 0     S(g) = b (sqrt(tau^2 + 2 g / b) - tau)   for g >= 0
    h_far  = S(sqrt(d1) - m - r) - s >= 0     S(g) = max(g / tau, -0.3 m/s)            for g < 0

S(g) is the highest speed that can be stopped within g: a reaction time tau, then a deceleration b.
Both are barrier functions: where dh/dt >= -h / T_g each stays positive once it is, and returns
with the time constant T_g where it is not (Ames et al., "Control Barrier Functions: Theory and
Applications", ECC 2019). As ds/dt = n . (a - a_L) + |w_t|^2 / r, w_t being w across n, that asks

    n . a >= n . a_L - |w_t|^2 / r - (s + S(g_near)) / T_g - S'(g_near) s
    n . a <= n . a_L - |w_t|^2 / r - (s - S(g_far)) / T_g - S'(g_far) s

of the acceleration a. What of a_L is not known costs margin: ``docs/guard.md`` says how much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from operator import mul
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array
from flock_follower.planner.limits import (
    FARTHEST,
    FASTEST,
    INSIDE,
    limit_command,
    limit_norm,
    LimitedCommand,
    SENT_INSIDE,
    vector3,
)
from flock_follower.planner.projection import Discs, lexicographic, product, Side, TOLERANCE
from flock_follower.ranges import Checked, Range

SEPARATION, FENCE, SIGHT, COHESION = REASONS = 'separation', 'fence', 'sight', 'cohesion'
RETURN_SPEED = 0.3  # m/s: beyond the margin of an edge the distance returns no faster than this
WIDEST_MARGIN = 0.24  # share of the band's width
OVERHEAD = 0.1  # horizontal share of a direction below which no horizontal command helps


@dataclass(frozen=True)
class GuardParams(Checked):
    """
    How the guard holds the band.

    :raises ValueError: naming the parameter, its value and the valid range.
    """

    tau: float = 0.5
    """Reaction time, s."""
    b: float = 1.0
    """Deceleration of the distance's change, m/s^2."""
    T_g: float = 0.2
    """Time in which the distance's rate is brought to its bound, s."""
    m: float = 0.25
    """Margin to each edge, m; at most 0.24 of the band's width, 0.12 m for 1 to 1.5 m."""

    RANGES: ClassVar[dict[str, Range]] = {
        'tau': Range(0.05, 5.0, 's'),
        'b': Range(0.1, 10.0, 'm/s^2'),
        'T_g': Range(0.02, 2.0, 's'),
        'm': Range(0.0, 5.0, 'm'),
    }

    def closing_speed(self, gap: float) -> float:
        """Return S, m/s, for a gap, m, to the margin of an edge; negative beyond the margin."""
        if gap < 0.0:
            return max(gap / self.tau, -RETURN_SPEED)
        return self.b * (math.sqrt(self.tau ** 2 + 2.0 * gap / self.b) - self.tau)

    def closing_slope(self, gap: float) -> float:
        """Return S', 1/s, for a gap, m."""
        if gap < 0.0:
            return 1.0 / self.tau if gap > -RETURN_SPEED * self.tau else 0.0
        return 1.0 / math.sqrt(self.tau ** 2 + 2.0 * gap / self.b)


class Edges(NamedTuple):
    """Between which distances, m, from a neighbour to stay, and how sure its place is."""

    near: float
    far: float = math.inf
    margin: float = 0.0
    """Of each edge, m."""
    spread: float = 0.0
    """How far it may be from where it is expected, m ..."""
    spreading: float = 0.0
    """... and how fast that grows, m/s."""

    @classmethod
    def of(cls, law: FlockingParams, params: GuardParams) -> Edges:
        """Return the edges of the law's band."""
        near, far = math.sqrt(law.d0), math.sqrt(law.d1)
        return cls(near, far, min(params.m, WIDEST_MARGIN * (far - near)))


class HalfSpace(NamedTuple):
    """What is asked of the acceleration a (3,), m/s^2: normal . a >= least."""

    normal: Array
    """(3,); it need not be of unit length."""
    least: float
    reason: str


class RadialBounds(NamedTuple):
    """What the guard asks of the acceleration a, for one neighbour: lowest <= n . a <= highest."""

    distance: float
    """r, m."""
    direction: Array
    """n (3,), from the neighbour to oneself."""
    lowest: float
    """m/s^2; below it one would come too near."""
    highest: float
    """m/s^2; above it one would fall too far behind."""
    seen: bool = True
    """Whether it is in sight: bounds of those seen go before bounds of those only predicted."""

    @property
    def separation(self) -> HalfSpace:
        """Return the bound that keeps away."""
        return HalfSpace(self.direction, self.lowest, SEPARATION)

    @property
    def cohesion(self) -> HalfSpace:
        """Return the bound that keeps near."""
        return HalfSpace(-self.direction, -self.highest, COHESION)


def radial_bounds(offset: ArrayLike, relative_velocity: ArrayLike, edges: Edges,
                  params: GuardParams,
                  its_acceleration: ArrayLike = (0.0, 0.0, 0.0)) -> RadialBounds | None:
    """
    Return the guard's bounds for one neighbour; None where there is no direction, or not finite.

    :param offset: own position minus the neighbour's, (3,), m.
    :param relative_velocity: own velocity minus the neighbour's, (3,), m/s.
    :param its_acceleration: a_L, the neighbour's, as far as it is known, (3,), m/s^2.
    """
    p, w = vector3('offset', offset), vector3('relative_velocity', relative_velocity).tolist()
    a = vector3('its_acceleration', its_acceleration).tolist()
    distance = math.hypot(*p.tolist())
    if not (1e-6 < distance < FARTHEST and math.hypot(*w, *a) < FARTHEST):
        return None  # as for NaN, which fails every comparison
    n = p / distance
    unit = n.tolist()
    rate = _product(unit, w)
    common = _product(unit, a) - max(_product(w, w) - rate ** 2, 0.0) / distance
    # Whoever may be anywhere in a sphere that grows comes nearer by that.
    closing = rate - edges.spreading
    gap = distance - edges.near - edges.margin - edges.spread
    lowest = common - (closing + params.closing_speed(gap)) / params.T_g - (
        params.closing_slope(gap) * closing)
    highest = math.inf
    if math.isfinite(edges.far):
        gap = edges.far - edges.margin - distance
        highest = common - (rate - params.closing_speed(gap)) / params.T_g - (
            params.closing_slope(gap) * rate)
    return RadialBounds(distance, n, lowest, highest)


def ordered(neighbors: Sequence[RadialBounds], fences: Sequence[HalfSpace] = (),
            sight: Sequence[HalfSpace] = ()) -> list[HalfSpace]:
    """
    Return all bounds in the order of their importance.

    Not coming too near to anyone in sight comes first, the nearest neighbour before the others;
    then fences, those out of sight, and seeing the neighbour; last not falling behind, the
    farthest first. So falling behind never costs separation or sight.
    """
    near = sorted(neighbors, key=lambda each: each.distance)
    return [*(each.separation for each in near if each.seen), *fences,
            *(each.separation for each in near if not each.seen), *sight,
            *(each.cohesion for each in reversed(near) if math.isfinite(each.highest))]


def guard(command: ArrayLike, velocity: ArrayLike, wanted: Sequence[HalfSpace], a_max: float,
          v_max: float, period: float) -> LimitedCommand:
    """
    Return the command that keeps the bounds and is nearest to the one given.

    Its vertical part stays as it is. Of all horizontal accelerations with ``|a| <= a_max`` and
    ``|v + a T| <= max(v_max, |v|)`` that keep every bound, the nearest to ``command`` is taken.
    With one neighbour: its radial part is clipped to the bounds, or as far towards them as the
    limits let it go, and only the part across is shrunk, of the acceleration to fit ``a_max``, of
    the velocity to fit ``v_max``. A command that keeps all bounds is returned bit for bit.

    Where the bounds leave no room they are met one after the other in their order, each as
    nearly as those before it allow.

    :param command: acceleration (3,), m/s^2, within the limits (see ``limit_command``).
    :param velocity: own velocity (3,), m/s.
    :param wanted: the bounds, the most important first (see ``ordered``).
    """
    a, v = vector3('command', command), vector3('velocity', velocity)
    speed = math.hypot(*v.tolist())
    # Above v_max already: the command may slow down, or keep the speed, but not add to it.
    flyable = speed <= FASTEST
    fastest = max(v_max, speed * INSIDE) if flyable else v_max
    asked = a.tolist()
    if not flyable or not all(map(math.isfinite, asked)) or all(
            _product(each.normal.tolist(), asked) >= each.least for each in wanted):
        return limit_command(a, v, a_max, fastest, period)
    bounds, reasons = _within_reach(wanted, asked[2])
    missed = [product(normal, complex(*asked[:2])) < least for normal, least in bounds]
    if not any(missed):
        return limit_command(a, v, a_max, fastest, period)
    # |v + a T| <= fastest is a ball of accelerations, as |a| <= a_max is: here their cuts.
    vertical, strongest = asked[2], a_max * SENT_INSIDE
    left = float(v[2]) + vertical * period
    discs = Discs(0j, math.sqrt(max(strongest ** 2 - vertical ** 2, 0.0)),
                  complex(*(-v[:2] / period)),
                  math.sqrt(max(fastest ** 2 - left ** 2, 0.0)) / period)
    point = lexicographic(complex(*limit_norm(a, FARTHEST)[:2]), bounds, discs)
    limited = limit_command([point.real, point.imag, vertical], v, a_max, fastest, period)
    # Those that the command did not keep, and those that hold it where it is now.
    acting = [k for k, (normal, least) in enumerate(bounds)
              if missed[k] or product(normal, point) <= least + TOLERANCE]
    away = next((np.array([normal.real, normal.imag, 0.0]) / abs(normal) for normal in (
        bounds[k][0] for k in acting if reasons[k] == SEPARATION)), None)
    said = sorted({reasons[k] for k in acting}, key=REASONS.index)
    return LimitedCommand(limited.acceleration, True, ', '.join(said), away)


def _within_reach(wanted: Sequence[HalfSpace],
                  vertical: float) -> tuple[list[Side], list[str]]:
    """Return the bounds on the horizontal part of a command that this can do anything for."""
    bounds, reasons = list[Side](), list[str]()
    for each in wanted:
        x, y, z = each.normal.tolist()
        if math.hypot(x, y) > OVERHEAD:
            bounds.append((complex(x, y), each.least - z * vertical))
            reasons.append(each.reason)
    return bounds, reasons


def _product(one: list[float], other: list[float]) -> float:
    """Return the scalar product; of three numbers it takes a third of what arrays take."""
    return sum(map(mul, one, other))
