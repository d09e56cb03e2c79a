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

"""The static frames of the vehicle."""

from __future__ import annotations

import numpy as np

from flock_follower.geometry import Transform
from flock_follower.messages import SANE

BASE = 'base_link'


class StaticFrames:
    """The tree of static frames of the vehicle, from ``tf_static``."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Transform]] = {}

    def add(self, parent: str, child: str, T_parent_child: Transform) -> None:
        """
        Set the pose of a frame in its parent.

        :raises ValueError: if its translation is not finite, or beyond ``SANE``.
        """
        if not np.all(np.abs(T_parent_child.translation) <= SANE):  # NaN fails
            raise ValueError(f'{child} in {parent}: {T_parent_child.translation.tolist()}: must '
                             f'be finite, and within {SANE:g} m')
        self._parents[child] = parent, T_parent_child

    def pose(self, frame: str, on: str) -> Transform | None:
        """Return ``T_on_frame``, or None if the two frames are not connected."""
        above, below = self._to_root(frame), self._to_root(on)
        common = next((name for name in above if name in below), None)
        return None if common is None else below[common].inverse() @ above[common]

    def pose_on_base(self, child: str) -> Transform | None:
        """Return ``T_base_child``; None if it is unknown, or base_link itself."""
        return None if child in ('', BASE) else self.pose(child, BASE)

    def _to_root(self, frame: str) -> dict[str, Transform]:
        """Return ``T_ancestor_frame`` of the frame itself and its ancestors, nearest first."""
        chain = {frame: Transform()}
        while frame in self._parents:
            parent, T_parent_frame = self._parents[frame]
            if parent in chain:
                break  # a cycle: an invalid tree
            chain[parent] = T_parent_frame @ chain[frame]
            frame = parent
        return chain
