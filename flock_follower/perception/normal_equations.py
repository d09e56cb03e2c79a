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
The normal equations of least squares, solved only where they determine every unknown.

Gauss's elimination finds an answer to equations that rounding alone keeps from being singular, and
their inverse is then no covariance: its variances may be negative. Cholesky's needs a positive
definite matrix, and how far from singular it is tells its condition.
"""

from __future__ import annotations

import cv2

from flock_follower.geometry import Array

#: How much more uncertain, in variance, all unknowns together may be than each would be alone.
#: For good fits of rendered markers it is at most 5e3; at 1e16 nothing is left but rounding.
MAX_INFLATION = 1e8

_CHOLESKY = cv2.DECOMP_CHOLESKY


def solve(information: Array, moment: Array) -> Array | None:
    """
    Return x (n,) of ``information`` (n, n) x = ``moment`` (n,), None where that is not definite.

    What is not a number in either is not in x.
    """
    solved, x = cv2.solve(information, moment[:, None], flags=_CHOLESKY)
    return x[:, 0] if solved else None


def covariance(information: Array) -> Array | None:
    """
    Return the inverse (n, n), symmetric and positive definite, of a symmetric matrix (n, n).

    None where that is not positive definite, or worse conditioned than :data:`MAX_INFLATION`.
    """
    solved, inverse = cv2.invert(information, flags=_CHOLESKY)
    # In units in which each unknown alone has variance 1, the trace of the inverse bounds the
    # condition; Cholesky's elimination minds no units.
    if not (solved and 0.0 < inverse.diagonal().dot(information.diagonal()) < MAX_INFLATION):
        return None
    symmetric: Array = 0.5 * (inverse + inverse.T)
    return symmetric
