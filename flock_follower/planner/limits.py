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

For any float input each function returns a finite vector within its limit. If no limit acts, the
function returns its input bit for bit. Limits act on the length of the vector, never on single
axes, so a limited command keeps its direction.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array
from flock_follower.messages import FASTEST_OWN, SANE
from flock_follower.planner.projection import Discs

# A vector scaled to its limit ends this fraction inside it, so that rounding, here or in
# a caller's check, cannot exceed it; a limited vector thus passes a second time unchanged.
INSIDE_SHARE = 1.0 - 1e-12
# Accelerations are limited to this share of a_max: rounding to the 24 bits of a MAVLink float must
# not exceed a_max.
SENT_INSIDE = 1.0 - 2e-7


class LimitedCommand(NamedTuple):
    """A limited acceleration, and the limits that changed it."""

    acceleration: Array
    """Acceleration (3,), m/s^2, in the frame of the inputs."""
    reason: str
    """Reason why it differs from the nominal one, or '': 'a_max', 'v_max', 'a_max, v_max',
    reasons of bounds, or the input that is not finite."""
    separation_axis: Array | None = None
    """Unit vector (3,) away from the neighbor of the most important bound, if any."""


def limit_norm(vector: ArrayLike, limit: float) -> Array:
    """Return the vector (n,), shortened to the limit if it is longer; zeros if not finite."""
    v = np.array(vector, dtype=float)
    numbers = v.tolist()
    length = math.hypot(*numbers)
    if length < limit * INSIDE_SHARE:  # most often, and NaN fails
        return v
    if not (length < math.inf or all(map(math.isfinite, numbers))):
        return np.zeros_like(v)
    if length < SANE and math.sqrt(float(v @ v)) <= limit:  # longer ones might overflow
        return v
    direction = v / max(map(abs, numbers))  # likewise
    return direction * (limit * INSIDE_SHARE / math.sqrt(float(direction @ direction)))


def limit_command(acceleration: ArrayLike, velocity: ArrayLike, a_max: float, v_max: float,
                  period: float, axis: Array | None = None) -> LimitedCommand:
    """
    Limit an acceleration, and the speed it leads to when held for one period.

    The acceleration is shortened to ``a_max``. Then the predicted velocity ``v + a T`` is
    projected onto the ball of radius ``v_max``, and the acceleration to the projected velocity is
    again shortened to ``a_max``. Each limit is reduced a little (``SENT_INSIDE``). So ``|a| <=
    a_max`` always holds, also in single precision; ``|v + a T| <= v_max`` holds if ``|v| <=
    v_max``; and a faster vehicle never accelerates further. Flight controllers do not limit the
    speed that results from acceleration setpoints.

    If the acceleration is not finite, the result is braking with the time constant T, within
    ``a_max``. If the velocity is not finite, the result is zero.

    :param acceleration: nominal acceleration (3,), m/s^2.
    :param velocity: present velocity (3,), m/s, in the same frame.
    :param a_max: largest acceleration, m/s^2, above 0.
    :param v_max: largest speed, m/s, at least 0.
    :param period: time T for which the acceleration is held, s, above 0.
    :param axis: unit vector (3,) away from a neighbor: along it, the acceleration is reduced last.
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


def brake(velocity: ArrayLike, a_max: float, time_constant: float = 0.3) -> Array:
    """
    Return the acceleration (3,), m/s^2, that brakes to a hover: ``-v / time_constant``, limited.

    Its length is at most ``a_max``. For an unknown (non-finite) velocity the result is zero,
    because an acceleration in a wrong direction is worse than none.

    :param velocity: present velocity (3,), m/s.
    :param a_max: largest acceleration, m/s^2, above 0.
    :param time_constant: time in which the speed falls to 37 %, s, above 0.
    """
    # Shortened before the division, because it could overflow, and after it, because it rounds.
    strongest = a_max * SENT_INSIDE
    step = limit_norm(0.0 - np.asarray(velocity, dtype=float), strongest * time_constant)
    return limit_norm(step / time_constant, strongest)
