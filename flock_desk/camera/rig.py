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

"""The camera on the follower and the marker on its leader, as in config/neighbors.yaml."""

from __future__ import annotations

import numpy as np

from flock_desk.camera.scene import leader, marker_surface, Surface
from flock_follower.geometry import Array, R_FLU_OPTICAL, Transform
from flock_follower.perception.markers import draw_marker

#: The camera optical frame on the follower's body (FLU).
T_BODY_OPTICAL = Transform(R_FLU_OPTICAL, np.array([0.10, 0.0, 0.0]))
SIDE_LENGTH = 0.16  # m, of the marker


def marked_leader() -> list[Surface]:
    """Return the leader with marker 0 of DICT_4X4_50 on its tail, in its body frame."""
    return leader(_cells(), SIDE_LENGTH)


def second_print() -> Surface:
    """Return the same marker alone, in the body frame of a leader that would carry it."""
    return marker_surface(_cells(), SIDE_LENGTH)


def _cells() -> Array:
    cells = np.ones((8, 8))  # with one of quiet zone around
    cells[1:7, 1:7] = draw_marker('DICT_4X4_50', 0, 6) > 127
    return cells
