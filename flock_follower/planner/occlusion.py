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
Occlusion: images that should show the faced neighbor's marker do not.

A marker that leaves the image is expected to come back, and the follower coasts. A marker that is
predicted well inside the image and is not found is covered by something that stands on the
follower's way, so the follower brakes. Nothing here reads a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

from flock_follower.planner.inputs import at, NeighborEstimate, OwnState
from flock_follower.planner.sight import FieldOfView

#: Consecutive processed images without the marker that make it occluded, and with it that end it.
IMAGES = 3
#: Distance of the predicted marker to the image's edge, m: two markers of 0.2 m.
INSIDE = 0.4
_SAME = 1e-6  # s: stamps that differ by less are of one image


class Occlusion(NamedTuple):
    """The neighbor is occluded."""

    lost: float
    """Stamp of the last estimate before, s."""
    found: float = math.inf
    """Stamp of the first of the consecutive estimates that may end it, s."""


def occlusion(before: Occlusion | None, n: NeighborEstimate | None, me: OwnState,
              frames: Sequence[float], view: FieldOfView | None,
              forward: float) -> Occlusion | None:
    """
    Return whether a neighbor is occluded, or None.

    :param before: the same in the last step.
    :param n: its newest estimate; None if there is none.
    :param me: own state now.
    :param frames: stamps of the newest processed images, s, in their order.
    :param forward: own acceleration ahead, m/s^2, which tilts the camera.
    """
    if n is None or n.heard or view is None:
        return None if n is None else before
    missed = sum(stamp > n.stamp + _SAME for stamp in frames)
    if before is None:
        offset = at(n, me.stamp).position - me.position
        lost = missed >= IMAGES and view.inside(offset, me.yaw, forward, INSIDE)
        return Occlusion(n.stamp) if lost else None
    if missed >= IMAGES:
        return Occlusion(n.stamp)
    found = min(before.found, n.stamp) if n.stamp > before.lost + _SAME else math.inf
    shown = sum(found - _SAME <= stamp <= n.stamp + _SAME for stamp in frames)
    return None if shown >= IMAGES else before._replace(found=found)
