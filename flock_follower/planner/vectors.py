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
Vectors (3,) as plain numbers, which take a tenth of the time of arrays.

Arrays over all neighbors pay late, too: to predict n neighbors and to compute their bounds takes
about 7.5 n us in numbers, and 100 + 2.5 n us in arrays.
"""

from __future__ import annotations

from collections.abc import Sequence

ZERO_VECTOR = 0.0, 0.0, 0.0


def scalar_product(one: Sequence[float], other: Sequence[float]) -> float:
    """Return the scalar product of two vectors (3,)."""
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
