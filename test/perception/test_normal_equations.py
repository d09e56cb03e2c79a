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

"""Normal equations: solved where every unknown is determined, refused where one is not."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.perception.edges import MAX_INFLATION, normal_covariance, solve_normal

UNITS = np.array([1.0, 1e-3, 1e4, 1.0, 1e2, 1e-4])


def equations(seed: int, rows: int = 40) -> Array:
    """Return the matrix (6, 6) of random equations, its unknowns in units far apart."""
    design = np.random.default_rng(seed).normal(0.0, 1.0, (rows, 6)) * UNITS
    matrix: Array = design.T @ design
    return matrix


def nearly_dependent(away: float) -> Array:
    """Return equations (6, 6) of which two unknowns act alike but for a share ``away``."""
    design = np.random.default_rng(5).normal(0.0, 1.0, (40, 6))
    design[:, 1] = design[:, 0] + away * design[:, 1]
    design *= UNITS
    matrix: Array = design.T @ design
    return matrix


@pytest.mark.parametrize('seed', range(5))
def test_definite_equations_have_their_solution_and_covariance(seed: int) -> None:
    matrix, x = equations(seed), np.arange(1.0, 7.0) / UNITS
    found, inverse = solve_normal(matrix, matrix @ x), normal_covariance(matrix)
    assert found is not None
    assert inverse is not None
    np.testing.assert_allclose(found * UNITS, np.arange(1.0, 7.0), rtol=1e-9)
    np.testing.assert_allclose(inverse @ matrix * UNITS[:, None] / UNITS, np.eye(6), atol=1e-9)
    np.testing.assert_array_equal(inverse, inverse.T)


def test_what_is_nearly_dependent_is_refused_before_its_variances_are_rounding() -> None:
    for away in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 0.0):
        inverse = normal_covariance(nearly_dependent(away))
        # The variance of either unknown is that of one alone over away^2.
        assert (inverse is None) == (2.0 / away**2 > MAX_INFLATION if away else True), away
        if inverse is not None:
            assert np.linalg.eigvalsh(inverse * UNITS * UNITS[:, None]).min() > 0.0
            np.linalg.cholesky(inverse)


