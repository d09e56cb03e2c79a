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
The rule of a jump of a position: farther from its prediction than a tolerance.

Two others predict otherwise: ``odometry.derivation`` has positions alone, because not every source
sends a reliable velocity; ``gate.velocity_check.Path`` allows for motion in a gap.
"""

from __future__ import annotations

import math
from typing import Protocol

from flock_follower.geometry import Array

#: m: odometry farther from its prediction has another frame than before: places in the old frame
#: are lost. Any one such jump counts; ``POSITION_JUMP`` is for evidence about a source.
ODOMETRY_JUMP = 0.25


class Moving(Protocol):
    """A state with a position (3,), m, and a velocity (3,), m/s."""

    @property
    def position(self) -> Array:
        """Return the position."""

    @property
    def velocity(self) -> Array:
        """Return the velocity."""


def jump(before: Moving, after: Moving, elapsed: float, tolerance: float) -> float:
    """
    Return the distance, m, of a position from its prediction if it exceeds a tolerance, else 0.

    The prediction is from ``elapsed`` s before, with the mean of both velocities: exact for a
    constant acceleration.
    """
    half, (x, y, z), (u, v, w), (new_u, new_v, new_w) = (
        0.5 * elapsed, before.position.tolist(), before.velocity.tolist(), after.velocity.tolist())
    distance = math.dist(after.position.tolist(), [
        x + half * (u + new_u), y + half * (v + new_v), z + half * (w + new_w)])
    return distance if distance > tolerance else 0.0
