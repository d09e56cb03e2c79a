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
What keeps a command safe: limits on acceleration and speed, and braking.

Every function here returns a finite vector inside its limit for any float input whatsoever, and
returns its input bit for bit where no limit binds. Limits act on the length of the vector, never
on its axes one by one, so a limited command still points where it was meant to.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array

# A vector scaled to its limit ends this fraction inside it, so that rounding, here or in the
# norm of whoever checks, cannot carry it over; a limited vector thus passes unchanged a 2nd time.
_INSIDE = 1.0 - 1e-12


class LimitedCommand(NamedTuple):
    """An acceleration made safe, and what was done to it."""

    acceleration: Array
    """Acceleration (3,), m/s^2, in the frame of the inputs."""
    limited: bool
    """Whether it differs from what was asked for."""
    reason: str
    """Why: '' if not limited; else 'a_max', 'v_max', 'a_max, v_max' or a non-finite input."""


def limit_norm(vector: ArrayLike, limit: float) -> Array:
    """Return the vector (n,), shortened to the limit if longer; zeros if not finite."""
    v = np.array(vector, dtype=float)
    if not np.all(np.isfinite(v)):
        return np.zeros_like(v)
    with np.errstate(over='ignore', under='ignore'):
        if np.linalg.norm(v) <= limit:  # an overflow gives inf, which is rightly too long
            return v
        direction = v / np.max(np.abs(v))  # huge components would overflow when squared
        return direction * (limit * _INSIDE / np.linalg.norm(direction))


def limit_command(acceleration: ArrayLike, velocity: ArrayLike, a_max: float, v_max: float,
                  period: float) -> LimitedCommand:
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
    :raises ValueError: where a limit is out of its range or a vector is not of shape (3,).
    """
    _check_limit('a_max', a_max, 100.0, 'm/s^2')
    if not 0.0 <= v_max <= 100.0:
        raise ValueError(f'v_max = {v_max}: must be in [0, 100] m/s')
    _check_limit('period', period, 10.0, 's')
    wanted, v = _vector3('acceleration', acceleration), _vector3('velocity', velocity)
    if not np.all(np.isfinite(v)):
        return LimitedCommand(np.zeros(3), True, 'velocity not finite')
    if not np.all(np.isfinite(wanted)):
        return LimitedCommand(brake(v, a_max, period), True, 'acceleration not finite')

    a = limit_norm(wanted, a_max)
    reasons = [] if np.array_equal(a, wanted) else ['a_max']
    predicted = v + a * period
    target = limit_norm(predicted, v_max)
    if not np.array_equal(target, predicted):
        # v and target both lie in the ball of radius max(v_max, |v|), which is convex: however
        # far the second clip shortens the step from v towards target, it ends in that ball too.
        a = limit_norm(limit_norm(target - v, a_max * period) / period, a_max)
        reasons.append('v_max')
    return LimitedCommand(a, bool(reasons), ', '.join(reasons))


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
    _check_limit('a_max', a_max, 100.0, 'm/s^2')
    _check_limit('time_constant', time_constant, 10.0, 's')
    # Shortened before the division, which could overflow, and after it, which rounds.
    step = limit_norm(0.0 - _vector3('velocity', velocity), a_max * time_constant)
    return limit_norm(step / time_constant, a_max)


def _check_limit(name: str, value: float, highest: float, unit: str) -> None:
    if not 0.0 < value <= highest:  # written so that NaN fails
        raise ValueError(f'{name} = {value}: must be in (0, {highest:g}] {unit}')


def _vector3(name: str, value: ArrayLike) -> Array:
    v = np.asarray(value, dtype=float)
    if v.shape != (3,):
        raise ValueError(f'{name} has shape {v.shape}: must be (3,)')
    return v
