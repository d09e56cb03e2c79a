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
Limits of acceleration and speed, and braking.

Every function here returns a finite vector inside its limit for any float input, and its input
bit for bit if no limit binds. Limits act on the length of the vector, never
on its axes one by one, so a limited command keeps its direction.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array
from flock_follower.messages import FASTEST_OWN, SANE
from flock_follower.planner.projection import Discs, LENGTH_TOLERANCE, nearest_in_order, product

# A vector scaled to its limit ends this fraction inside it, so that rounding, here or in
# a caller's check, cannot exceed it; a limited vector thus passes a second time unchanged.
INSIDE_SHARE = 1.0 - 1e-12
# Accelerations are limited to this share of a_max: rounding to the 24 bits of a MAVLink float must
# not exceed a_max.
SENT_INSIDE = 1.0 - 2e-7

# Reasons of bounds.
SEPARATION, FENCE, SIGHT, COHESION = REASONS = 'separation', 'fence', 'sight', 'cohesion'
INSISTENCE = 10.0  # of cohesion beyond ``v_max``: see ``keep_bounds``
STEEP = 0.1  # horizontal share of a direction below which no horizontal command helps


class LimitedCommand(NamedTuple):
    """A limited acceleration, and the limits that changed it."""

    acceleration: Array
    """Acceleration (3,), m/s^2, in the frame of the inputs."""
    reason: str
    """Reason why it differs from the nominal one, or '': 'a_max', 'v_max', 'a_max, v_max',
    reasons of bounds, or the input that is not finite."""
    separation_axis: Array | None = None
    """Unit vector (3,) away from the neighbor that the guard keeps clear of first, if any."""


class Bound(NamedTuple):
    """A bound on the acceleration a (3,), m/s^2: normal . a >= least."""

    normal: Sequence[float]
    """(3,); it need not be of unit length."""
    least: float
    reason: str
    distance: float = 0.0
    """Distance of the neighbor that causes the bound, m."""
    seen: bool = True
    """Whether that neighbor is in sight."""


def limit_norm(vector: ArrayLike, limit: float) -> Array:
    """Return the vector (n,), shortened to the limit if longer; zeros if not finite."""
    v = np.array(vector, dtype=float)
    numbers = v.tolist()
    length = math.hypot(*numbers)
    if length < limit * INSIDE_SHARE:  # most often, and NaN fails
        return v
    if not all(map(math.isfinite, numbers)):
        return np.zeros_like(v)
    if length < SANE and math.sqrt(float(v @ v)) <= limit:  # longer ones might overflow
        return v
    direction = v / max(map(abs, numbers))  # likewise
    return direction * (limit * INSIDE_SHARE / math.sqrt(float(direction @ direction)))


def limit_command(acceleration: ArrayLike, velocity: ArrayLike, a_max: float, v_max: float,
                  period: float, axis: Array | None = None) -> LimitedCommand:
    """
    Limit an acceleration, and the speed it leads to when held for one period.

    The acceleration is shortened to ``a_max``, the velocity ``v + a T`` it predicts is projected
    onto the ball of radius ``v_max``, and the acceleration leading there is shortened to ``a_max``
    again, each time a little more (``SENT_INSIDE``). So ``|a| <= a_max`` always, in single
    precision too; ``|v + a T| <= v_max`` whenever ``|v| <= v_max``; and a
    vehicle faster than that never speeds up. Flight controllers apply no speed limit of their own
    to acceleration setpoints.

    A non-finite acceleration becomes braking with the time constant T, within ``a_max``. With a
    non-finite velocity no acceleration can be judged: the result is zero.

    :param acceleration: nominal acceleration (3,), m/s^2.
    :param velocity: present velocity (3,), m/s, in the same frame.
    :param a_max: largest acceleration, m/s^2, above 0.
    :param v_max: largest speed, m/s, at least 0.
    :param period: time T for which the acceleration is held, s, above 0.
    :param axis: unit vector (3,) along which the acceleration is cut last, because it keeps clear
        of a neighbor: as much of it is left as the limits allow.
    """
    nominal, v = np.asarray(acceleration, dtype=float), np.asarray(velocity, dtype=float)
    requested, flown, strongest = nominal.tolist(), v.tolist(), a_max * SENT_INSIDE
    reached = [x + u * period for x, u in zip(flown, requested)]
    if (math.hypot(*requested) < strongest * INSIDE_SHARE
            and math.hypot(*reached) < v_max * INSIDE_SHARE):  # most often; NaN fails
        return LimitedCommand(nominal.copy(), '')
    if not all(map(math.isfinite, flown)):
        return LimitedCommand(np.zeros(3), 'velocity not finite')
    if not all(map(math.isfinite, requested)):
        return LimitedCommand(brake(v, a_max, period), 'acceleration not finite')

    a = limit_norm(nominal, strongest)
    reasons = [] if a.tolist() == requested else ['a_max']
    predicted = v + a * period
    target = limit_norm(predicted, v_max)
    if target.tolist() != predicted.tolist():
        # v and target both lie in the ball of radius max(v_max, |v|), which is convex: however
        # far the second clip shortens the step from v towards target, it ends in that ball too.
        a = limit_norm(limit_norm(target - v, strongest * period) / period, strongest)
        reasons.append('v_max')
    if reasons and axis is not None and math.hypot(*flown) <= FASTEST_OWN:
        nominal = limit_norm(nominal, SANE)
        if axis @ nominal > 0.0:
            clear = _separation_first(nominal, v, axis, a_max, v_max, period)
            a = clear if axis @ clear > axis @ a else a
    return LimitedCommand(a, ', '.join(reasons))


def limit_horizontal(nominal: ArrayLike, vertical: float, velocity: ArrayLike, a_max: float,
                     v_max: float, period: float, climb: float = 0.0) -> LimitedCommand:
    """
    Limit an acceleration whose vertical part has priority over the horizontal one.

    As :func:`limit_command`, but the horizontal part gets the rest of ``a_max`` and ``v_max``: the
    law's pull may be far beyond both and would leave no climb.

    :param nominal: acceleration (3,), m/s^2; its vertical part is not used.
    :param vertical: acceleration, m/s^2, at most ``a_max``.
    :param climb: vertical velocity, m/s, to which it finally leads: room is left for that.
    """
    v, nominal = np.asarray(velocity, dtype=float), np.asarray(nominal, dtype=float)
    if not math.hypot(*v.tolist()) < SANE:  # NaN fails
        return limit_command([*nominal[:2], vertical], v, a_max, v_max, period)
    strongest = math.sqrt(max((a_max * SENT_INSIDE) ** 2 - vertical ** 2, 0.0))
    horizontal = limit_norm(nominal[:2], strongest)
    reasons = [] if horizontal.tolist() == nominal[:2].tolist() else ['a_max']
    rising = max(abs(float(v[2]) + vertical * period), abs(climb))
    fastest = math.sqrt(max(v_max ** 2 - rising ** 2, 0.0))
    reached = v[:2] + horizontal * period
    target = limit_norm(reached, fastest)
    if target.tolist() != reached.tolist():
        horizontal = limit_norm((target - v[:2]) / period, strongest)
        reasons.append('v_max')
    command = limit_command([*horizontal.tolist(), vertical], v, a_max, v_max, period)
    binding = [each for each in ('a_max', 'v_max') if each in reasons or each in command.reason]
    reason = ', '.join(binding) if 'finite' not in command.reason else command.reason
    return LimitedCommand(command.acceleration, reason)


def _separation_first(a: Array, v: Array, axis: Array, a_max: float, v_max: float,
                      period: float) -> Array:
    """
    Return the acceleration within the limits that loses least along ``axis``, and then across.

    ``|a| <= a_max`` is a ball around zero, ``|v + a T| <= v_max`` one around ``-v / T``. The point
    of both that lies farthest along ``axis`` is in the plane of ``axis`` and ``v``. If that is
    farther than ``a``, the part along ``axis`` stays as it is. The part across is the nearest one
    in both discs that the plane across ``axis`` cuts out of the balls.
    """
    fastest = max(v_max, math.hypot(*v.tolist()) * INSIDE_SHARE)
    strongest, reach, center = a_max * SENT_INSIDE, fastest / period, -v / period
    along = float(axis @ center)
    side = center - along * axis
    beside = math.hypot(*side.tolist())
    highest = Discs(0j, strongest, complex(along, beside), reach).best(1 + 0j, far=True).real
    level = min(float(axis @ a), highest)
    # If v lies along ``axis`` but for rounding, any direction across will do.
    x = side if beside > 1e-9 * reach else np.cross(axis, np.eye(3)[int(abs(axis).argmin())])
    x = x / math.hypot(*x.tolist())
    y = np.cross(axis, x)
    cut = Discs(0j, math.sqrt(max(strongest ** 2 - level ** 2, 0.0)), complex(beside, 0.0),
                math.sqrt(max(reach ** 2 - (level - along) ** 2, 0.0)))
    point = cut.best(complex(float(x @ a), float(y @ a)))
    found = level * axis + point.real * x + point.imag * y
    return limit_command(found, v, a_max, fastest, period).acceleration


def keep_bounds(command: ArrayLike, velocity: ArrayLike, required: Sequence[Bound], a_max: float,
                v_max: float, period: float) -> LimitedCommand:
    """
    Return the command that keeps the bounds and is nearest to the given one.

    Its vertical part stays as it is. Of all horizontal accelerations with ``|a| <= a_max`` and
    ``|v + a T| <= max(v_max, |v|)`` that keep every bound, the nearest to ``command`` is taken.
    With one neighbor: its radial part is clipped to the bounds, or as far towards them as the
    limits let it go, and only the part across is shrunk, of the acceleration to fit ``a_max``, of
    the velocity to fit ``v_max``. A command that keeps all bounds is returned bit for bit.

    If the bounds leave no room they are met one after the other in their order, each as nearly as
    those before it allow. Cohesion beyond ``v_max`` is met less: only as nearly as by the velocity
    nearest to ``INSISTENCE`` times the correction. Met to the last bit, it would take all speed
    across for very little, and the command would switch from tick to tick.

    :param command: acceleration (3,), m/s^2, within the limits (see ``limit_command``).
    :param velocity: own velocity (3,), m/s.
    :param required: the bounds, the most important first (see ``sort_bounds``).
    """
    a, v = np.asarray(command, dtype=float), np.asarray(velocity, dtype=float)
    speed = math.hypot(*v.tolist())
    # Above v_max already: the command may slow down, or keep the speed, but not add to it.
    flyable = speed <= FASTEST_OWN
    fastest = max(v_max, speed * INSIDE_SHARE) if flyable else v_max
    requested = a.tolist()
    if not flyable or not all(map(math.isfinite, requested)) or all(
            scalar_product(each.normal, requested) >= each.least for each in required):
        return limit_command(a, v, a_max, fastest, period)
    # The bounds on which the horizontal part has an influence.
    sides = [(complex(x, y), each.least - z * requested[2], each.reason)
             for each in required for x, y, z in [each.normal]
             if math.hypot(x, y) > STEEP]
    bounds = [side[:2] for side in sides]
    missed = [product(normal, complex(*requested[:2])) < least for normal, least in bounds]
    if not any(missed):
        return limit_command(a, v, a_max, fastest, period)
    # |v + a T| <= fastest is a ball of accelerations, as |a| <= a_max is: here their cuts.
    vertical, strongest = requested[2], a_max * SENT_INSIDE
    left = float(v[2]) + vertical * period
    within = complex(*(-v[:2] / period)), math.sqrt(max(fastest ** 2 - left ** 2, 0.0)) / period
    goal = complex(*limit_norm(a, SANE)[:2])
    for k, (normal, least) in enumerate(bounds):
        if missed[k] and sides[k][2] == COHESION:
            step = min(INSISTENCE * (least - product(normal, goal)), SANE) / abs(normal) ** 2
            reached = Discs(*within, *within).best(goal + step * normal)
            bounds[k] = normal, min(least, product(normal, reached))
    discs = Discs(0j, math.sqrt(max(strongest ** 2 - vertical ** 2, 0.0)), *within)
    firm = [bounds[k] for k in range(len(bounds)) if sides[k][2] != COHESION]
    if len(firm) < len(bounds) and any(missed):
        _yield_cohesion(goal, bounds, firm, sides, discs)
    point = nearest_in_order(goal, bounds, discs)
    limited = limit_command([point.real, point.imag, vertical], v, a_max, fastest, period)
    # The bounds that the command did not keep, and those that are active at the result.
    acting = [k for k, (normal, least) in enumerate(bounds)
              if missed[k] or product(normal, point) <= least + LENGTH_TOLERANCE]
    axis = next((np.array([normal.real, normal.imag, 0.0]) / abs(normal) for normal in (
        bounds[k][0] for k in acting if sides[k][2] == SEPARATION)), None)
    binding = sorted({sides[k][2] for k in acting}, key=REASONS.index)
    return LimitedCommand(limited.acceleration, ', '.join(binding), axis)


def _yield_cohesion(goal: complex, bounds: list[tuple[complex, float]],
                    firm: Sequence[tuple[complex, float]],
                    sides: Sequence[tuple[complex, float, str]], discs: Discs) -> None:
    """
    Reduce the cohesion bounds to the motion towards the neighbor that firm bounds leave.

    Against an opposite firm bound only a motion across would still bring it a little nearer, and
    that would be as hard as the vehicle can.
    """
    start = nearest_in_order(goal, firm, discs)
    for k, (normal, least) in enumerate(bounds):
        if sides[k][2] == COHESION and product(normal, start) < least:
            room = min((max(product(other, start) - bound, 0.0) / -product(other, normal)
                        for other, bound in firm if product(other, normal) < 0.0),
                       default=math.inf)
            bounds[k] = normal, min(least, product(normal, start) + room * abs(normal) ** 2)


def brake(velocity: ArrayLike, a_max: float, time_constant: float = 0.3) -> Array:
    """
    Return the acceleration (3,), m/s^2, that brakes to a hover: ``-v / time_constant``, limited.

    Its length is at most ``a_max``. An unknown (non-finite) velocity gives zeros: an acceleration
    in a direction that may be wrong is worse than none.

    :param velocity: present velocity (3,), m/s.
    :param a_max: largest acceleration, m/s^2, above 0.
    :param time_constant: time in which the speed falls to 37 %, s, above 0.
    """
    # Shortened before the division, because it could overflow, and after it, because it rounds.
    strongest = a_max * SENT_INSIDE
    step = limit_norm(0.0 - np.asarray(velocity, dtype=float), strongest * time_constant)
    return limit_norm(step / time_constant, strongest)


def scalar_product(one: Sequence[float], other: Sequence[float]) -> float:
    """Return the scalar product of two vectors (3,), in a tenth of the time of arrays."""
    x, y, z = one
    u, v, w = other
    return x * u + y * v + z * w


def difference(one: Sequence[float], other: Sequence[float]) -> list[float]:
    """Return one vector (3,) minus another."""
    x, y, z = one
    u, v, w = other
    return [x - u, y - v, z - w]


def opposite(vector: Sequence[float]) -> list[float]:
    """Return a vector (3,) with the other sign."""
    x, y, z = vector
    return [-x, -y, -z]


def horizontal(vector: Sequence[float]) -> list[float]:
    """Return a vector (3,) without its vertical part."""
    x, y, _ = vector
    return [x, y, 0.0]
