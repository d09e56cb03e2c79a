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

"""The sums of ``flocks.all_pairs`` compiled by numba, on all cores."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from flock_follower.flocking import FlockingParams, Model, SMALLEST_GAP
from flock_follower.geometry import Array

try:
    from numba import njit, prange
except ImportError as missing:
    raise ImportError("method = 'compiled' needs numba: pip install numba, or choose "
                      "'blocked'") from missing

# Sums may be reordered, which is what lets them be vectorised; nothing here is NaN or infinite.
_FAST = {'fastmath': True, 'error_model': 'numpy'}


@lru_cache
def kernel(params: FlockingParams, model: Model, n: int) -> Callable[[Array, Array, float], Array]:
    """
    Return a function of positions (k, n), velocities (k, n) and L that gives accelerations.

    Compiled at its first call, for a few seconds, with the parameters as constants.
    """
    K, variance, d0, d1 = params.K, params.sigma ** 2, params.d0, params.d1
    separates, coheres = model != 'cucker_smale', model == 'flocking'
    alignment, gap_law = _inverse_power(params.beta), _inverse_power(params.theta)

    @njit(**_FAST)
    def agent(i, xs, vs, scale):  # type: ignore[no-untyped-def]
        ux = uy = uz = 0.0
        for j in range(xs.shape[1]):
            dx, dy, dz = xs[0, j] - xs[0, i], xs[1, j] - xs[1, i], 0.0
            if n == 3:
                dz = xs[2, j] - xs[2, i]
            r2 = dx * dx + dy * dy + dz * dz
            pull = 0.0
            if separates:
                pull -= scale * gap_law(max(r2 - d0, SMALLEST_GAP))
            if coheres:
                pull += scale * gap_law(max(d1 - r2, SMALLEST_GAP))
            a = K * alignment(variance + r2)
            ux += a * (vs[0, j] - vs[0, i]) + pull * dx
            uy += a * (vs[1, j] - vs[1, i]) + pull * dy
            if n == 3:
                uz += a * (vs[2, j] - vs[2, i]) + pull * dz
        return ux, uy, uz

    @njit(parallel=True, **_FAST)
    def all_agents(xs, vs, scale):  # type: ignore[no-untyped-def]
        u = np.empty((xs.shape[1], n))
        for i in prange(xs.shape[1]):
            ux, uy, uz = agent(i, xs, vs, scale)
            u[i, 0], u[i, 1] = ux, uy
            if n == 3:
                u[i, 2] = uz
        return u

    def call(positions: Array, velocities: Array, scale: float) -> Array:
        return all_agents(np.ascontiguousarray(positions.T), np.ascontiguousarray(velocities.T),
                          scale)

    return call


def _inverse_power(power: float) -> Callable[[float], float]:
    """Return base ** -power as a compiled function; without pow, which no compiler vectorises."""
    if power == 0.25:
        return njit(lambda base: 1.0 / np.sqrt(np.sqrt(base)), **_FAST)
    if power == 0.5:
        return njit(lambda base: 1.0 / np.sqrt(base), **_FAST)
    if power in (0.0, 1.0, 2.0, 3.0):
        whole = int(power)
        return njit(lambda base: 1.0 / base ** whole, **_FAST)
    return njit(lambda base: base ** -power, **_FAST)
