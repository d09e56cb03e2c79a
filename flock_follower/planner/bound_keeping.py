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
Finds the command that keeps the bounds and limits, and is nearest to the wanted command.

The vertical part of a command has priority: only the horizontal part changes.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.messages import FASTEST_OWN, SANE
from flock_follower.planner.limits import (
    INSIDE_SHARE,
    limit_command,
    limit_norm,
    LimitedCommand,
    SENT_INSIDE,
)
from flock_follower.planner.projection import (
    Discs,
    LENGTH_TOLERANCE,
    nearest_in_order,
    product,
    Side,
)
from flock_follower.planner.vectors import scalar_product, ZERO_VECTOR

# Reasons of bounds. Separation and cohesion are the guard's edges of the band; the law's terms of
# the same names are in ``flocking``.
SEPARATION, FENCE, SIGHT, COHESION = REASONS = 'separation', 'fence', 'sight', 'cohesion'
#: Factor by which the correction for cohesion beyond ``v_max`` counts: see ``keep_bounds``.
COHESION_INSISTENCE = 5.0
#: Horizontal share of a bound's normal, below which no horizontal command helps.
MIN_HORIZONTAL_SHARE = 0.1
#: Time in which law and cohesion approach v_max, s: within one period, the noise of the velocity
#: would be a command.
SPEED_TIME = 0.4


class Bound(NamedTuple):
    """A bound on the acceleration a (3,), m/s^2: normal . a >= least."""

    normal: Sequence[float]
    """Normal (3,), of any length."""
    least: float
    reason: str
    distance: float = 0.0
    """Distance of the neighbor that causes the bound, m."""
    seen: bool = True
    """Whether that neighbor is in sight."""


def limit_horizontal(nominal: ArrayLike, vertical: float, velocity: ArrayLike, a_max: float,
                     v_max: float, period: float, climb: float = 0.0,
                     drag: ArrayLike | None = None) -> LimitedCommand:
    """
    Limit an acceleration whose vertical part has priority over the horizontal one.

    As :func:`limit_command`, but the horizontal part only gets what the vertical part leaves of
    ``a_max`` and ``v_max``: the law may command far more than both, and would leave nothing for
    the climb.

    :param nominal: acceleration (3,), m/s^2; its vertical part is not used.
    :param vertical: acceleration, m/s^2, at most ``a_max``.
    :param climb: vertical velocity, m/s, that the vertical part will reach; it is reserved in
        ``v_max``.
    :param drag: acceleration (3,), m/s^2, that drag takes. With it, ``v_max`` is approached within
        ``SPEED_TIME``; if None, within one period.
    """
    v, requested = np.asarray(velocity, dtype=float), np.asarray(nominal, dtype=float).tolist()
    vx, vy, vz = v.tolist()
    speed = math.hypot(vx, vy, vz)
    if not speed < SANE:  # NaN fails
        return limit_command([*requested[:2], vertical], v, a_max, v_max, period)
    strongest = math.sqrt(max((a_max * SENT_INSIDE) ** 2 - vertical ** 2, 0.0))
    ax, ay = limit_norm(requested[:2], strongest).tolist()
    reasons = [] if [ax, ay] == requested[:2] else ['a_max']
    rising = max(abs(vz + vertical * period), abs(climb))
    fastest = math.sqrt(max(v_max ** 2 - rising ** 2, 0.0))
    # Above v_max already: the speed falls within SPEED_TIME, and does not grow in this period.
    most = v_max if drag is None else max(v_max, speed * INSIDE_SHARE)
    left = math.sqrt(max(most ** 2 - (vz + vertical * period) ** 2, 0.0))
    for limit, time, (lost_x, lost_y, _) in [(fastest, period, ZERO_VECTOR)] if drag is None else [
            (fastest, max(SPEED_TIME, period), np.asarray(drag).tolist()),
            (left, period, ZERO_VECTOR)]:
        reached = [vx + (ax - lost_x) * time, vy + (ay - lost_y) * time]
        target = limit_norm(reached, limit).tolist()
        if target != reached:
            ax, ay = limit_norm([(target[0] - vx) / time + lost_x,
                                 (target[1] - vy) / time + lost_y], strongest).tolist()
            reasons.append('v_max')
    command = limit_command([ax, ay, vertical], v, a_max, most, period)
    binding = [each for each in ('a_max', 'v_max') if each in reasons or each in command.reason]
    reason = ', '.join(binding) if 'finite' not in command.reason else command.reason
    return LimitedCommand(command.acceleration, reason)


def keep_bounds(command: ArrayLike, velocity: ArrayLike, required: Sequence[Bound], a_max: float,
                v_max: float, period: float, drag: ArrayLike = (0.0, 0.0, 0.0)) -> LimitedCommand:
    """
    Return the command that keeps the bounds and is nearest to the given one.

    The vertical part is not changed. Of all horizontal accelerations with ``|a| <= a_max`` and
    ``|v + a T| <= max(v_max, |v|)`` that keep every bound, the result is the nearest to
    ``command``. With one neighbor this means: the radial part is clipped to the bounds, as far as
    the limits permit. The part across is shortened until the acceleration is within ``a_max`` and
    the velocity within ``v_max``. A command that keeps all bounds is returned bit for bit.

    If not all bounds can be kept, they are met in their order, each as nearly as the bounds before
    it permit. There is one exception: cohesion that needs more than ``v_max`` is met only as
    nearly as the velocity nearest to ``COHESION_INSISTENCE`` times the correction meets it. To
    meet it exactly would use all speed across the line of sight for a very small gain, and the
    command would alternate from tick to tick.

    :param command: acceleration (3,), m/s^2, within the limits (see ``limit_command``).
    :param velocity: ego velocity (3,), m/s.
    :param required: the bounds, the most important first (see ``sort_bounds``).
    :param drag: acceleration (3,), m/s^2, that drag takes: to keep the speed, it is commanded.
    """
    a, v = np.asarray(command, dtype=float), np.asarray(velocity, dtype=float)
    (vx, vy, vz), requested = v.tolist(), a.tolist()
    speed = math.hypot(vx, vy, vz)
    # Above v_max already: the command may slow down, or keep the speed, but not add to it.
    flyable = speed <= FASTEST_OWN
    fastest = max(v_max, speed * INSIDE_SHARE) if flyable else v_max
    if not flyable or not all(map(math.isfinite, requested)) or all(
            scalar_product(each.normal, requested) >= each.least for each in required):
        return limit_command(a, v, a_max, fastest, period)
    # The bounds on which the horizontal part has an influence.
    ax, ay, vertical = requested
    sides = [(complex(x, y), least - z * vertical, reason)
             for (x, y, z), least, reason, _, _ in required
             if math.hypot(x, y) > MIN_HORIZONTAL_SHARE]
    bounds = [(normal, least) for normal, least, _ in sides]
    missed = [normal.real * ax + normal.imag * ay < least for normal, least in bounds]
    if not any(missed):
        return limit_command(a, v, a_max, fastest, period)
    (discs, by_speed), goal = _limit_discs(
        (vx, vy, vz), vertical, fastest, a_max, np.asarray(drag).tolist(), period), complex(
        *limit_norm(a, SANE)[:2].tolist())
    # Cohesion comes last in the order: the other bounds are firm.
    firm = [bound for bound, side in zip(bounds, sides) if side[2] != COHESION]
    point = nearest_in_order(goal, firm, discs)
    if len(firm) < len(bounds):
        reduced = [_reduce_cohesion(*bound, goal, point, firm, by_speed)
                   for bound in bounds[len(firm):]]
        bounds = [*firm, *reduced]
        if any(product(normal, point) < least for normal, least in reduced):
            point = nearest_in_order(goal, bounds, discs)
    limited = limit_command([point.real, point.imag, vertical], v, a_max, fastest, period)
    # The bounds that the command did not keep, and those that are active at the result.
    acting = [k for k, (normal, least) in enumerate(bounds)
              if missed[k] or product(normal, point) <= least + LENGTH_TOLERANCE]
    axis = next((np.array([normal.real, normal.imag, 0.0]) / abs(normal) for normal in (
        bounds[k][0] for k in acting if sides[k][2] == SEPARATION)), None)
    binding = sorted({sides[k][2] for k in acting}, key=REASONS.index)
    return LimitedCommand(limited.acceleration, ', '.join(binding), axis)


def _limit_discs(velocity: Sequence[float], vertical: float, fastest: float, a_max: float,
                 drag: Sequence[float], period: float) -> tuple[Discs, Discs]:
    """Return the limits of the horizontal acceleration: all of them, and by the speed alone."""
    (vx, vy, vz), (lost_x, lost_y, _) = velocity, drag
    # |v + a T| <= fastest is a ball of accelerations, as |a| <= a_max is: here their cuts.
    left, slowly = math.sqrt(max(fastest ** 2 - (vz + vertical * period) ** 2, 0.0)), max(
        SPEED_TIME, period)
    within = complex(0.0 - vx / period, 0.0 - vy / period), left / period
    smooth = complex(lost_x - vx / slowly, lost_y - vy / slowly), left / slowly
    return Discs(0j, math.sqrt(max((a_max * SENT_INSIDE) ** 2 - vertical ** 2, 0.0)),
                 *within), Discs(*smooth, *smooth)


def _reduce_cohesion(normal: complex, least: float, goal: complex, start: complex,
              firm: Sequence[Side], by_speed: Discs) -> Side:
    """
    Return a cohesion bound, reduced first by ``COHESION_INSISTENCE``: see ``keep_bounds``.

    Then to the motion towards the neighbor that firm bounds leave: against an opposite firm bound
    only a motion across would still bring the vehicle a little nearer, as hard as it can.

    :param start: the nearest command to ``goal`` that keeps the firm bounds.
    :param by_speed: limits by the speed alone.
    """
    correction = COHESION_INSISTENCE * (least - product(normal, goal))
    if correction > 0.0:
        step = min(correction, SANE) / abs(normal) ** 2
        least = min(least, product(normal, by_speed.best(goal + step * normal)))
    if product(normal, start) < least:
        room = min((max(product(other, start) - bound, 0.0) / -product(other, normal)
                    for other, bound in firm if product(other, normal) < 0.0),
                   default=math.inf)
        least = min(least, product(normal, start) + room * abs(normal) ** 2)
    return normal, least
