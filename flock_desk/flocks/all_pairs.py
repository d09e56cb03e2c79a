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
The accelerations of large flocks in which every agent sees every other, in O(k) memory.

The same sums as :func:`flock_follower.flocking.accelerations`, whose (k, k) matrices leave the
processor's cache, and the machine's memory, as the flock grows.
"""

from __future__ import annotations

from typing import get_args, Literal

import numpy as np
from numpy.typing import ArrayLike

from flock_follower import flocking
from flock_follower.flocking import checked, disagreement, FlockingParams, Model, SMALLEST_GAP
from flock_follower.geometry import Array

Method = Literal['auto', 'whole', 'blocked', 'compiled']

_ROWS, _COLUMNS = 16, 1024  # of a tile, whose few arrays of 128 kB stay in cache
_FEW = 128  # agents up to which whole matrices are the fastest


def accelerations(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams,
                  model: Model = 'flocking', method: Method = 'auto') -> Array:
    """
    Return the acceleration (k, n), m/s^2, of every agent, each seeing all others.

    :param positions: (k, n), n = 2 or 3, m.
    :param velocities: (k, n), m/s, in the same frame.
    :param method: 'whole' matrices; 'blocked', tile by tile; 'compiled' by numba, on all cores;
        'auto', the first of them for a few agents and blocked for more.
    :raises ValueError: for another method or model, other shapes, or values not finite.
    :raises ImportError: for 'compiled' without numba.
    """
    x, v = checked(positions, velocities)
    for name, value, known in (('method', method, Method), ('model', model, Model)):
        if value not in get_args(known):
            raise ValueError(f'{name} = {value!r}: must be one of {", ".join(get_args(known))}')
    if method == 'whole' or (method == 'auto' and len(x) <= _FEW):
        return flocking.accelerations(x, v, params, model)
    if method == 'compiled':
        from flock_desk.flocks.all_pairs_compiled import kernel
        return kernel(params, model, x.shape[1])(x, v, disagreement(v))
    return _blocked(x, v, params, model)


def _blocked(x: Array, v: Array, params: FlockingParams, model: Model) -> Array:
    """Sum tile by tile, each a few rows of agents by many columns of neighbours."""
    k, n = x.shape
    scale = disagreement(v)
    u = np.zeros((n, k))
    xs, vs = np.ascontiguousarray(x.T), np.ascontiguousarray(v.T)
    buffers = np.empty((n + 4, _ROWS, _COLUMNS))
    for first in range(0, k, _ROWS):
        rows = slice(first, min(first + _ROWS, k))
        for left in range(0, k, _COLUMNS):
            columns = slice(left, min(left + _COLUMNS, k))
            tile = buffers[:, :rows.stop - rows.start, :columns.stop - columns.start]
            offsets, (r2, weight, gap, pull) = tile[:n], tile[n:]
            for axis in range(n):
                np.subtract(xs[axis, columns], xs[axis, rows, None], out=offsets[axis])
            np.multiply(offsets[0], offsets[0], out=r2)
            for axis in range(1, n):
                np.multiply(offsets[axis], offsets[axis], out=gap)
                r2 += gap
            if model != 'cucker_smale':
                np.subtract(r2, params.d0, out=gap)
                np.maximum(gap, SMALLEST_GAP, out=gap)
                _raise_to_minus(params.theta, gap, pull)
                if model == 'flocking':
                    np.subtract(params.d1, r2, out=gap)
                    np.maximum(gap, SMALLEST_GAP, out=gap)
                    _raise_to_minus(params.theta, gap, weight)
                    np.subtract(pull, weight, out=pull)
                for axis in range(n):
                    u[axis, rows] -= scale * np.einsum('ij,ij->i', pull, offsets[axis])
            r2 += params.sigma ** 2
            _raise_to_minus(params.beta, r2, weight)
            for axis in range(n):
                np.subtract(vs[axis, columns], vs[axis, rows, None], out=gap)
                u[axis, rows] += params.K * np.einsum('ij,ij->i', weight, gap)
    return np.ascontiguousarray(u.T)


def _raise_to_minus(power: float, base: Array, out: Array) -> None:
    """Write base ** -power; by multiplications and roots where it can, ten times as fast."""
    if power == 0.0:
        out.fill(1.0)
        return
    raised = out
    if power in (1.0, 2.0, 3.0):
        raised = base
        for _ in range(int(power) - 1):
            raised = np.multiply(raised, base, out=out)
    elif power in (0.25, 0.5):
        np.sqrt(base, out=out)
        if power == 0.25:
            np.sqrt(out, out=out)
    else:
        np.power(base, power, out=out)
    np.reciprocal(raised, out=out)
