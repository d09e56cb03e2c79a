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

"""The limits of an acceleration whose vertical part has priority."""

from __future__ import annotations

from collections.abc import Sequence
import math

from flock_follower.geometry import Array
from flock_follower.planner.limits import INSIDE_SHARE, limit_command, SENT_INSIDE
from flock_follower.planner.projection import Discs, nearest_in_order, Side


def limit_level(a: Array, up: float, sides: Sequence[Side], v: Array, a_max: float, v_max: float,
                period: float) -> Array:
    """
    Return the acceleration (3,) within the limits; its vertical part has priority.

    The vertical part is ``up``, m/s^2, or as near to it as both limits allow. With this vertical
    part, each limit is a disc of horizontal accelerations. The horizontal part is the point of the
    discs that is nearest to the horizontal part of ``a``, within the bounds in their order.
    """
    fastest = max(v_max, math.hypot(*v.tolist()) * INSIDE_SHARE)
    strongest, reach, center = a_max * SENT_INSIDE, fastest / period, (-v / period).tolist()
    side = Discs(0j, strongest, complex(center[2], math.hypot(*center[:2])), reach)
    up = min(max(up, side.best(-1 + 0j, far=True).real), side.best(1 + 0j, far=True).real)
    level = Discs(0j, math.sqrt(max(strongest ** 2 - up ** 2, 0.0)), complex(*center[:2]),
                  math.sqrt(max(reach ** 2 - (up - center[2]) ** 2, 0.0)))
    point = nearest_in_order(complex(*a[:2].tolist()), sides, level)
    return limit_command([point.real, point.imag, up], v, a_max, fastest, period).acceleration
