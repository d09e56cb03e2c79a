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
The flocking law of Liu & Qiu (AAMAS 2020), its two predecessors and its Lyapunov function.

An agent i at x_i with velocity v_i accelerates with (eqs. 4 and 5 of the paper)

    u_i = sum_j a_ij (v_j - v_i)                     alignment
        + L sum_j f0(r^2) (x_i - x_j)                separation
        + L sum_j f1(r^2) (x_j - x_i)                cohesion

    r^2 = |x_i - x_j|^2              a_ij = K / (sigma^2 + r^2)^beta
    f0(r^2) = 1 / (r^2 - d0)^theta   f1(r^2) = 1 / (d1 - r^2)^theta
    L^2 = (1/k) sum_{i>j} |v_i - v_j|^2 = sum_i |v_i - mean(v)|^2

The law keeps ``d0 < r^2 < d1``: d0 and d1 bound the *squared* distance. The paper prints f1 = 1 /
(r^2 - d1)^theta, which is equal for even theta only: for odd theta this f1 repels, and for a theta
that is not an integer it is not a real number. The paper's alpha appears in no formula.

The paper's law has no value outside the band. Here the gaps r^2 - d0 and d1 - r^2 are at least
1e-6 m^2, so below d0 the force always repels, and beyond d1 it always attracts, strongly but
finitely. Separation and cohesion are zero while L = 0, that is, while all velocities are equal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args, Literal

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array
from flock_follower.ranges import Checked, parameter, Range

Model = Literal['flocking', 'cucker_dong', 'cucker_smale']

SMALLEST_GAP = 1e-6  # m^2
_NARROWEST_BAND = 1e-3  # m^2, far above the smallest gap: one side always outweighs the other
_LARGEST_INPUT = 1e100  # m and m/s: up to here nothing below can overflow


@dataclass(frozen=True)
class FlockingParams(Checked):
    """
    The parameters of the law; the defaults are those of the paper's simulations.

    :raises ValueError: naming the parameter, its value and the valid range.
    """

    K: float = parameter(
        1.0, Range(0.001, 100.0), 'gain of the alignment of velocities', live=True)
    sigma: float = parameter(
        1.0, Range(0.001, 100.0, 'm'),
        'Distance within which the alignment is nearly constant, m.')
    beta: float = parameter(
        0.5, Range(0.0, 10.0), 'decay of the alignment with distance', live=True)
    theta: float = parameter(
        2.0, Range(1.0, 10.0),
        "Steepness of separation and cohesion; below 1 the band's edges could be crossed.")
    d0: float = parameter(
        1.0, Range(0.0, 1e4, 'm^2'), 'lower bound of the squared distance; below d1', live=True)
    d1: float = parameter(
        2.25, Range(0.001, 1e4, 'm^2'), 'upper bound of the squared distance; above d0', live=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.d1 - self.d0 < _NARROWEST_BAND:
            raise ValueError(f'd1 = {self.d1!r}: must be a number in [d0 + {_NARROWEST_BAND:g}, '
                             f'10000] m^2, where d0 = {self.d0!r}')

    def command(self, offsets: Array, differences: Array) -> Array:
        """
        Return the acceleration (n,), m/s^2, of an agent that observes m neighbors.

        A subclass may return the acceleration of another controller, for comparisons with the law.

        :param offsets: neighbors' positions minus the ego position, (m, n), m.
        :param differences: neighbors' velocities minus the ego velocity, (m, n), m/s.
        """
        velocities = np.concatenate([np.zeros((1, differences.shape[1])), differences])
        return sum_over_neighbors(offsets, differences, disagreement(velocities), self, 'flocking')


def accelerations(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams,
                  model: Model = 'flocking') -> Array:
    """
    Return the acceleration (k, n), m/s^2, of every agent of a flock; each observes all others.

    The accelerations rotate with the inputs, and do not depend on the origin. Their sum is zero:
    the mean velocity is constant.

    :param positions: (k, n), n = 2 or 3, m.
    :param velocities: (k, n), m/s, in the same frame.
    :param model: 'flocking', the law; 'cucker_dong' (2010), the law without cohesion;
        'cucker_smale' (2007), its alignment alone.
    :raises ValueError: for another model, other shapes, or values that are not finite or beyond
        1e100.
    """
    x, v = checked(positions, velocities)
    return sum_over_neighbors(x[None, :] - x[:, None], v[None, :] - v[:, None],
                              disagreement(v), params, model)


def acceleration(relative_positions: ArrayLike, relative_velocities: ArrayLike,
                 params: FlockingParams) -> Array:
    """
    Return the law's command (n,), m/s^2, for one agent that observes its neighbors.

    L is computed from the agent and the observed neighbors. Without neighbors the command is zero.

    :param relative_positions: neighbors' positions minus the ego position, (m, n), n = 2 or 3, m.
    :param relative_velocities: neighbors' velocities minus the ego velocity, (m, n), m/s.
    :raises ValueError: for other shapes, or values not finite or beyond 1e100.
    """
    return params.command(*checked(relative_positions, relative_velocities,
                                   ('relative_positions', 'relative_velocities')))


def lyapunov(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams) -> float:
    """
    Return W, which strictly decreases along every solution of the law, for any flock.

    W = L + 1/2 sum_{i>j} [F(r^2 - d0) + F(d1 - r^2)], where F(g) is g^(1 - theta) / (theta - 1)
    (1/g for theta = 2), or ln((d1 - d0) / g) for theta = 1. W is positive, and infinite if
    any pair is outside the band; the paper's E tends to minus infinity instead.

    :param positions: (k, n), n = 2 or 3, m.
    :param velocities: (k, n), m/s, in the same frame.
    :raises ValueError: for other shapes, or values not finite or beyond 1e100.
    """
    x, v = checked(positions, velocities)
    i, j = np.triu_indices(len(x), k=1)
    r2 = np.sum((x[j] - x[i]) ** 2, axis=-1)
    gaps = np.stack([r2 - params.d0, params.d1 - r2])
    if np.any(gaps <= 0.0):
        return float('inf')
    if params.theta == 1.0:
        potential = np.log((params.d1 - params.d0) / gaps)
    else:
        potential = gaps ** (1.0 - params.theta) / (params.theta - 1.0)
    return disagreement(v) + 0.5 * float(np.sum(potential))


def alignment(r2: Array, params: FlockingParams) -> Array:
    """Return a_ij, 1/s, at squared distances r2, m^2 (eq. 5 of the paper)."""
    return params.K * (params.sigma ** 2 + r2) ** -params.beta


def separation(r2: Array, params: FlockingParams) -> Array:
    """Return f0 at squared distances r2, m^2 (eq. 5), finite at and below d0."""
    return np.maximum(r2 - params.d0, SMALLEST_GAP) ** -params.theta


def cohesion(r2: Array, params: FlockingParams) -> Array:
    """Return f1 at squared distances r2, m^2 (eq. 5 corrected), finite at and beyond d1."""
    return np.maximum(params.d1 - r2, SMALLEST_GAP) ** -params.theta


def disagreement(velocities: Array) -> float:
    """Return L, m/s: the length of the velocities' (k, n) deviation from their mean."""
    return float(np.linalg.norm(velocities - velocities.sum(axis=0) / max(len(velocities), 1)))


def sum_over_neighbors(offsets: Array, differences: Array, scale: float,
                       params: FlockingParams, model: Model) -> Array:
    """
    Return u, (..., n), of agents from x_j - x_i and v_j - v_i, both (..., m, n), summed over j.

    :param scale: L, m/s.
    :raises ValueError: for another model.
    """
    if model not in get_args(Model):
        raise ValueError(f'model = {model!r}: must be one of {", ".join(get_args(Model))}')
    r2 = (offsets ** 2).sum(axis=-1, keepdims=True)
    u = differences * alignment(r2, params)
    if model != 'cucker_smale':
        pull = -separation(r2, params)
        if model == 'flocking':
            pull += cohesion(r2, params)
        u += scale * pull * offsets
    return u.sum(axis=-2)


def checked(positions: ArrayLike, velocities: ArrayLike,
            names: tuple[str, str] = ('positions', 'velocities')) -> tuple[Array, Array]:
    """
    Return positions and velocities as arrays of floats, both (k, n) with n = 2 or 3.

    :raises ValueError: for other shapes, or values not finite or beyond 1e100, by their names.
    """
    arrays = []
    for name, value in zip(names, (positions, velocities)):
        a = np.asarray(value, dtype=float)
        if a.ndim != 2 or a.shape[1] not in (2, 3):
            raise ValueError(f'{name} has shape {a.shape}: must be (k, 2) or (k, 3)')
        if not np.all(np.abs(a) <= _LARGEST_INPUT):  # written so that NaN fails
            raise ValueError(f'{name} = {a.tolist()}: every value must be a finite number '
                             f'of at most {_LARGEST_INPUT:g}')
        arrays.append(a)
    if arrays[0].shape != arrays[1].shape:
        raise ValueError(f'{names[0]} has shape {arrays[0].shape} and {names[1]} '
                         f'{arrays[1].shape}: they must be the same')
    return arrays[0], arrays[1]
