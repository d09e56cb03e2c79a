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
Which camera sees whom, and whom to look for in an image, where there are several cameras.

A neighbour that one camera has seen a moment ago is looked for in another one's image only where
it is expected inside, and not at length. One that no camera sees is searched for in all of them,
one camera after the other, so that more of them cost no more. One camera looks for everybody.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Transform
from flock_follower.perception.attitudes import PosePrior
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.mounted_camera import MountedCamera
from flock_follower.perception.neighbors import Neighbor

#: Whole images are searched this often at most, s.
SEARCH_PERIOD = 0.1
#: Who was measured in an image not older than this, s, is well tracked by its camera.
FRESH = 0.25
#: Images not further apart than this, s, were taken at once.
TOGETHER = 1e-4
#: A camera without images for so long, s, is waited for no longer.
SILENT = 0.5


class Sought(NamedTuple):
    """Names: who may be ``near`` the expected place, and ``anywhere`` in the image."""

    near: Sequence[str]
    anywhere: Sequence[str]


class _SeenBy(NamedTuple):
    camera: MountedCamera
    time: float


class Attention:
    """
    Shares out who is looked for where.

    Every neighbour's filter has a clock: that of the camera that saw it first. Other cameras'
    stamps are off it by what is applied of their time offsets.
    """

    def __init__(self, neighbors: Sequence[Neighbor], cameras: Sequence[MountedCamera]) -> None:
        self._neighbors = {n.name: n for n in neighbors}
        self._cameras = cameras
        self._all = Sought(tuple(self._neighbors), tuple(self._neighbors))
        self.restart()

    def restart(self) -> None:
        """Forget who saw whom."""
        self._seen: dict[str, _SeenBy] = {}
        self._bases: dict[str, float] = {}

    def time(self, name: str, camera: MountedCamera, moment: float) -> float:
        """Return a moment, s, by a camera's clock as that of a neighbour's filter."""
        base = self._bases.get(name)
        time = moment if base is None else moment + (camera.time_offset.applied - base)
        seen = self._seen.get(name)
        if seen is not None and seen.camera is not camera and abs(time - seen.time) < TOGETHER:
            return seen.time + 1e-9  # taken at once: one after the other for the filter
        return time

    def by_odometry(self, name: str, stamp: float) -> float:
        """Return a stamp, s, by the clock of the odometry as that of a neighbour's filter."""
        return stamp - self._bases.get(name, 0.0)

    def saw(self, name: str, camera: MountedCamera, time: float) -> None:
        """Take that a neighbour was measured at a time by the clock of its filter, s."""
        self._bases.setdefault(name, camera.time_offset.applied)
        self._seen[name] = _SeenBy(camera, time)

    def changed(self, camera: MountedCamera, before: float) -> None:
        """Take that a camera's time offset was ``before``, s: what it saw stays in its clock."""
        for name, seen in self._seen.items():
            if seen.camera is camera:
                self._bases[name] = camera.time_offset.applied - (before - self._bases[name])

    def sought(self, camera: MountedCamera, stamp: float, model: CameraModel,
               expected: Mapping[str, PosePrior], times: Mapping[str, float]) -> Sought:
        """
        Return whom to look for in an image of a stamp, s.

        :param times: of the image by the clocks of the filters, s.
        """
        if len(self._cameras) == 1:
            return self._all
        near, anywhere = [], []
        for name, neighbor in self._neighbors.items():
            seen = self._seen.get(name)
            age = np.inf if seen is None or seen.camera is camera else times[name] - seen.time
            if -SILENT < age < 0.0:
                continue  # the other one's image is newer
            tracked = 0.0 <= age <= FRESH
            again = not 0.0 <= stamp - camera.vain.get(name, -np.inf) < SEARCH_PERIOD - 1e-3
            pose = expected[name].pose
            if pose is not None and (again or not tracked) and in_view(model, neighbor, pose):
                near.append(name)
            if not tracked:
                anywhere.append(name)
        return Sought(near, anywhere)

    def search_due(self, camera: MountedCamera, stamp: float) -> bool:
        """Return whether to search the whole image of a stamp, s, for somebody who is missing."""
        camera.wanting = stamp
        others = [c for c in self._cameras if c is not camera and c.wanting is not None
                  and abs(stamp - c.wanting) < SILENT]
        waited = [_waited(c, stamp) for c in (camera, *others)]
        return min(waited) >= SEARCH_PERIOD - 1e-3 and max(waited) == waited[0]


def _waited(camera: MountedCamera, stamp: float) -> float:
    """Return since when a camera's images were not searched, s; infinite where never."""
    if camera.searched is None or stamp < camera.searched:
        return np.inf
    return stamp - camera.searched


def in_view(camera: CameraModel, neighbor: Neighbor, T_camera_body: Transform) -> bool:
    """Return whether the middle of one of a neighbour's markers is in the image, facing it."""
    markers = [T_camera_body @ marker.T_body_marker for marker in neighbor.markers]
    places = [m.translation for m in markers if m.rotation[:, 2] @ m.translation < 0.0]
    if not places:
        return False
    pixels = camera.project(np.array(places))
    inside = (pixels >= -0.5) & (pixels < (camera.width - 0.5, camera.height - 0.5))
    return bool(inside.all(axis=1).any())
