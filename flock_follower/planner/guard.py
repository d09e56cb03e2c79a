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
What keeps a command safe: limits on acceleration and speed, braking, and the guard of the band.

Every function here returns a finite vector inside its limit for any float input whatsoever, and
returns its input bit for bit where no limit binds. Limits act on the length of the vector, never
on its axes one by one, so a limited command still points where it was meant to.

The guard holds ``sqrt(d0) < r < sqrt(d1)`` where the law alone does not. With p = x_F - x_L from
the neighbour to oneself, w = v_F - v_L, r = |p|, n = p / r and s = n . w, it lets the distance
change no faster than one can still stop the change before the edge, less a margin m:

    s_lo = -S(r - sqrt(d0) - m)      S(g) = b (sqrt(tau^2 + 2 g / b) - tau)    for g >= 0
    s_hi =  S(sqrt(d1) - m - r)      S(g) = max(g / tau, -0.3 m/s)             for g < 0

S(g) is the highest speed that can be stopped within g: a reaction time tau, then a deceleration b.
As ds/dt = n . (a - a_L) + |w_t|^2 / r, w_t being w across n, the acceleration a must obey

    (s_lo - s) / T_g - |w_t|^2 / r + n . a_L  <=  n . a  <=  (s_hi - s) / T_g - ... + n . a_L

The margin covers what is not known of a_L, up to about 1 m/s^2 of the leader.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array
from flock_follower.planner.projection import Ball, Bound, Lens, lexicographic
from flock_follower.ranges import Checked, Range

# A vector scaled to its limit ends this fraction inside it, so that rounding, here or in the
# norm of whoever checks, cannot carry it over; a limited vector thus passes unchanged a 2nd time.
_INSIDE = 1.0 - 1e-12
_SENT_INSIDE = 1.0 - 2e-7  # likewise where what is sent has the 24 bits of a MAVLink float

SEPARATION, COHESION = 'separation', 'cohesion'
RETURN_SPEED = 0.3  # m/s: beyond the margin of an edge the distance returns no faster than this
WIDEST_MARGIN = 0.24  # share of the band's width
FARTHEST = 1e6  # m, m/s: of a neighbour; beyond, nothing is computed that could overflow
FASTEST = 100.0  # m/s: oneself, and the highest v_max
_A_MAX = Range(0.0, 100.0, 'm/s^2', above=True)
_V_MAX = Range(0.0, FASTEST, 'm/s')
_TIME = Range(0.0, 10.0, 's', above=True)
OVERHEAD = 0.1  # horizontal share of a direction below which no horizontal command helps


class LimitedCommand(NamedTuple):
    """An acceleration made safe, and what was done to it."""

    acceleration: Array
    """Acceleration (3,), m/s^2, in the frame of the inputs."""
    limited: bool
    """Whether it differs from what was asked for."""
    reason: str
    """Why: '' if not limited; else 'a_max', 'v_max', 'a_max, v_max' or a non-finite input."""
    away: Array | None = None
    """Unit vector (3,) away from the neighbour that the guard keeps clear of first, if any."""


def limit_norm(vector: ArrayLike, limit: float, inside: float = _INSIDE) -> Array:
    """Return the vector (n,), shortened to the limit if longer; zeros if not finite."""
    v = np.array(vector, dtype=float)
    if math.hypot(*v.tolist()) < limit * _INSIDE:  # most often, and NaN fails
        return v
    if not np.all(np.isfinite(v)):
        return np.zeros_like(v)
    with np.errstate(over='ignore', under='ignore'):
        if np.linalg.norm(v) <= limit:  # an overflow gives inf, which is rightly too long
            return v
        direction = v / np.max(np.abs(v))  # huge components would overflow when squared
        return direction * (limit * inside / np.linalg.norm(direction))


def limit_command(acceleration: ArrayLike, velocity: ArrayLike, a_max: float, v_max: float,
                  period: float, away: Array | None = None) -> LimitedCommand:
    """
    Limit an acceleration, and the speed it leads to when held for one period.

    The acceleration is shortened to ``a_max``, the velocity ``v + a T`` it predicts is projected
    onto the ball of radius ``v_max``, and the acceleration leading there is shortened to ``a_max``
    again. So ``|a| <= a_max`` always; ``|v + a T| <= v_max`` whenever ``|v| <= v_max``; and a
    vehicle faster than that never speeds up. Flight controllers apply no speed limit of their own
    to acceleration setpoints.

    A non-finite acceleration becomes braking, ``-v / T`` within ``a_max``; a non-finite velocity,
    against which no acceleration can be judged, gives zeros.

    :param acceleration: wanted acceleration (3,), m/s^2.
    :param velocity: present velocity (3,), m/s, in the same frame.
    :param a_max: largest acceleration, m/s^2, in (0, 100].
    :param v_max: largest speed, m/s, in [0, 100].
    :param period: time T the acceleration will be held for, s, in (0, 10].
    :param away: unit vector (3,) along which the acceleration is cut last, because it keeps clear
        of a neighbour: within the limits, as much of it is left as there can be.
    :raises ValueError: where a limit is out of its range or a vector is not of shape (3,).
    """
    _A_MAX.check('a_max', a_max)
    _V_MAX.check('v_max', v_max)
    _TIME.check('period', period)
    wanted, v = _vector3('acceleration', acceleration), _vector3('velocity', velocity)
    reached = [x + u * period for x, u in zip(v.tolist(), wanted.tolist())]
    if (math.hypot(*wanted.tolist()) < a_max * _INSIDE
            and math.hypot(*reached) < v_max * _INSIDE):  # most often; NaN fails
        return LimitedCommand(wanted.copy(), False, '')
    if not np.all(np.isfinite(v)):
        return LimitedCommand(np.zeros(3), True, 'velocity not finite')
    if not np.all(np.isfinite(wanted)):
        return LimitedCommand(brake(v, a_max, period), True, 'acceleration not finite')

    a = limit_norm(wanted, a_max, _SENT_INSIDE)
    reasons = [] if np.array_equal(a, wanted) else ['a_max']
    predicted = v + a * period
    target = limit_norm(predicted, v_max)
    if not np.array_equal(target, predicted):
        # v and target both lie in the ball of radius max(v_max, |v|), which is convex: however
        # far the second clip shortens the step from v towards target, it ends in that ball too.
        a = limit_norm(limit_norm(target - v, a_max * period, _SENT_INSIDE) / period, a_max)
        reasons.append('v_max')
    if reasons and away is not None and math.hypot(*v.tolist()) <= FASTEST:
        wanted = limit_norm(wanted, FARTHEST)
        if away @ wanted > 0.0:
            clear = _away_first(wanted, v, away, a_max, v_max, period)
            a = clear if away @ clear > away @ a else a
    return LimitedCommand(a, bool(reasons), ', '.join(reasons))


def _away_first(a: Array, v: Array, away: Array, a_max: float, v_max: float,
                period: float) -> Array:
    """Return the acceleration within the limits that keeps clear best, and is nearest to ``a``."""
    fastest = max(v_max, math.hypot(*v.tolist()) * _INSIDE)
    lens = Lens(Ball(np.zeros(3), a_max * _SENT_INSIDE), Ball(-v / period, fastest / period))
    point = lexicographic(a, [Bound(away, float(away @ a))], lens)
    return limit_command(point, v, a_max, fastest, period).acceleration


def brake(velocity: ArrayLike, a_max: float, time_constant: float = 0.3) -> Array:
    """
    Return the acceleration (3,), m/s^2, that brakes to a hover: ``-v / time_constant``, limited.

    Its length is at most ``a_max``. An unknown (non-finite) velocity gives zeros: an acceleration
    in a direction that may be wrong is worse than none.

    :param velocity: present velocity (3,), m/s.
    :param a_max: largest acceleration, m/s^2, in (0, 100].
    :param time_constant: time over which the speed falls to 37 %, s, in (0, 10].
    :raises ValueError: where a parameter is out of its range or the shape is not (3,).
    """
    _A_MAX.check('a_max', a_max)
    _TIME.check('time_constant', time_constant)
    # Shortened before the division, which could overflow, and after it, which rounds.
    step = limit_norm(0.0 - _vector3('velocity', velocity), a_max * time_constant, _SENT_INSIDE)
    return limit_norm(step / time_constant, a_max)


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
    T_g: float = 0.1
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

    def range_rates(self, distance: float, law: FlockingParams) -> tuple[float, float]:
        """Return the least and the greatest rate of change of a distance, m: s_lo, s_hi, m/s."""
        near, far = math.sqrt(law.d0), math.sqrt(law.d1)
        margin = min(self.m, WIDEST_MARGIN * (far - near))
        return (-self.closing_speed(distance - near - margin),
                self.closing_speed(far - margin - distance))


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


def radial_bounds(offset: ArrayLike, relative_velocity: ArrayLike, law: FlockingParams,
                  params: GuardParams,
                  its_acceleration: ArrayLike = (0.0, 0.0, 0.0)) -> RadialBounds | None:
    """
    Return the guard's bounds for one neighbour; None where there is no direction, or not finite.

    :param offset: own position minus the neighbour's, (3,), m.
    :param relative_velocity: own velocity minus the neighbour's, (3,), m/s.
    :param its_acceleration: a_L, the neighbour's, as far as it is known, (3,), m/s^2.
    """
    p, w = _vector3('offset', offset), _vector3('relative_velocity', relative_velocity)
    a = _vector3('its_acceleration', its_acceleration)
    distance = math.hypot(*p.tolist())
    if not (1e-6 < distance < FARTHEST and math.hypot(*w.tolist(), *a.tolist()) < FARTHEST):
        return None  # as for NaN, which fails every comparison
    n = p / distance
    rate = float(n @ w)
    slowest, fastest = params.range_rates(distance, law)
    common = float(n @ a) - max(float(w @ w) - rate ** 2, 0.0) / distance
    return RadialBounds(distance, n, (slowest - rate) / params.T_g + common,
                        (fastest - rate) / params.T_g + common)


def guard(command: ArrayLike, velocity: ArrayLike, neighbors: list[RadialBounds], a_max: float,
          v_max: float, period: float, keep_vertical: bool = False) -> LimitedCommand:
    """
    Return the command that the neighbours' bounds allow and that is nearest to the one given.

    Of all accelerations with ``|a| <= a_max`` and ``|v + a T| <= max(v_max, |v|)`` that keep
    every neighbour's bounds, the nearest to ``command`` is taken. With one neighbour: its radial
    part is clipped to the bounds, or as far towards them as the limits let it go, and only the
    part across is shrunk, of the acceleration to fit ``a_max``, of the velocity to fit ``v_max``.
    A command that keeps all bounds is returned bit for bit.

    Where several neighbours' bounds leave no room they are met one after the other, each as
    nearly as those before it allow: not coming too near to anyone comes first, the nearest
    neighbour before the others; then not falling behind, the farthest neighbour first. So falling
    behind never costs separation.

    :param command: acceleration (3,), m/s^2, within the limits (see ``limit_command``).
    :param velocity: own velocity (3,), m/s.
    :param keep_vertical: leave the vertical part as it is, and hold the bounds horizontally.
    """
    a, v = _vector3('command', command), _vector3('velocity', velocity)
    speed = math.hypot(*v.tolist())
    # Above v_max already: the command may slow down, or keep the speed, but not add to it.
    flyable = speed <= FASTEST
    fastest = max(v_max, speed * _INSIDE) if flyable else v_max
    kept = [each.lowest <= each.direction @ a <= each.highest for each in neighbors]
    if all(kept) or not flyable or not np.all(np.isfinite(a)):
        return limit_command(a, v, a_max, fastest, period)
    n = 2 if keep_vertical else 3
    vertical = float(a[2]) if keep_vertical else 0.0
    bounds = list(_ordered(neighbors, n, vertical))
    violated = [k for k, (bound, _) in enumerate(bounds) if bound.normal @ a[:n] < bound.least]
    if not violated:
        return limit_command(a, v, a_max, fastest, period)
    # |v + a T| <= fastest is a ball of accelerations, as |a| <= a_max is.
    left = v[2] + vertical * period if keep_vertical else 0.0
    strongest = a_max * _SENT_INSIDE
    lens = Lens(Ball(np.zeros(n), math.sqrt(max(strongest ** 2 - vertical ** 2, 0.0))),
                Ball(-v[:n] / period, math.sqrt(max(fastest ** 2 - left ** 2, 0.0)) / period))
    considered: set[int] = set()
    point = a[:n]
    while not considered.issuperset(violated):
        # Bounds that are kept anyway change nothing, so only those that are not are solved for.
        considered.update(violated)
        point = lexicographic(a[:n], [bounds[k][0] for k in sorted(considered)], lens)
        violated = [k for k, (bound, _) in enumerate(bounds) if not bound.holds(point)]
    result = np.concatenate([point, a[n:]])
    reasons = {bounds[k][1] for k in considered}
    limited = limit_command(result, v, a_max, fastest, period)
    clear_of = [bounds[k][0].normal for k in sorted(considered) if bounds[k][1] == SEPARATION]
    away = None
    if clear_of:
        away = np.concatenate([clear_of[0], np.zeros(3 - n)])
        away = away / math.hypot(*away.tolist())
    return LimitedCommand(limited.acceleration, True, ', '.join(sorted(reasons, reverse=True)),
                          away)


def _ordered(neighbors: list[RadialBounds], n: int,
             vertical: float) -> Iterator[tuple[Bound, str]]:
    """Yield the bounds in n dimensions in the order of their importance, and what each is for."""
    by_distance = sorted(neighbors, key=lambda each: (not each.seen, each.distance))
    for each in by_distance:
        if math.hypot(*each.direction[:n]) > OVERHEAD:
            yield Bound(each.direction[:n],
                        each.lowest - each.direction[2] * vertical), SEPARATION
    for each in reversed(by_distance):
        if math.hypot(*each.direction[:n]) > OVERHEAD:
            yield Bound(-each.direction[:n],
                        each.direction[2] * vertical - each.highest), COHESION


def _vector3(name: str, value: ArrayLike) -> Array:
    v = np.asarray(value, dtype=float)
    if v.shape != (3,):
        raise ValueError(f'{name} has shape {v.shape}: must be (3,)')
    return v
