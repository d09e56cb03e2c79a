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
Decides which neighbors each camera's image is searched for, and how often whole images are.

With one camera, every neighbor is searched in every image. With several cameras, a neighbor that
another camera has just seen is expected only at its predicted place in the image, without a
search, and less often if it was not found there. Each of n cameras searches whole images n times
less often, so the total cost does not grow.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Transform
from flock_follower.messages import MAX_JUMP
from flock_follower.parameters.neighbors_file import MarkedNeighbor
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.neighbor_filter import NeighborFilter
from flock_follower.perception.search import N_PORTIONS
from flock_follower.perception.time_offset import MountedCamera

#: Shortest time between two attempts to find a neighbor that another camera sees, s.
SEARCH_PERIOD = 0.1
#: A whole image is searched for a missing neighbor in portions, one for so much time, s.
PORTION_PERIOD = 1.0 / 30.0
#: Period of searches although no neighbor is missing, s: for further markers with a known id.
SWEEP_PERIOD = 1.0
#: A neighbor that a camera measured at most this time ago, s, is tracked by that camera.
FRESH = 0.25
#: Images of two cameras not farther apart than this, s, were taken at once.
TOGETHER = 1e-4
#: For a filter, measurements of one time are this far apart, s.
STEP = 1e-9
#: A marker is farther away than this, m.
NEAREST = 0.05


class Sought(NamedTuple):
    """Names of neighbors: those expected in the image, and those to search in the whole image."""

    near: list[str]
    anywhere: list[str]


class CameraSchedule:
    """Assigns the neighbors to the cameras that look for them; times are the odometry's, s."""

    def __init__(self, neighbors: Iterable[MarkedNeighbor], cameras: int) -> None:
        self._cameras = cameras
        # Middles and normals on the body, (n, 3).
        self._markers = {n.name: (np.array([m.T_body_marker.translation for m in n.markers]),
                                  np.array([m.T_body_marker.rotation[:, 2] for m in n.markers]))
                         for n in neighbors}
        self.restart()

    def restart(self) -> None:
        """Forget which camera saw which neighbor."""
        self._seen: dict[str, tuple[MountedCamera, float]] = {}

    def saw(self, name: str, camera: MountedCamera, time: float) -> None:
        """Record that a camera measured a neighbor."""
        self._seen[name] = camera, time

    def seen_last_by(self, name: str, camera: MountedCamera) -> bool:
        """Return whether no other camera has seen a neighbor since this camera saw it."""
        return self._seen.get(name, (camera, 0.0))[0] is camera

    def time(self, name: str, camera: MountedCamera, time: float) -> float:
        """Return a time for a neighbor's filter; the times of simultaneous images differ."""
        last, seen = self._seen.get(name, (camera, time))
        return seen + STEP if last is not camera and abs(time - seen) < TOGETHER else time

    def sought(self, camera: MountedCamera, time: float, model: CameraModel,
               T_camera_odom: Transform, filters: Mapping[str, NeighborFilter]) -> Sought:
        """Return the neighbors to look for in an image of one of several cameras."""
        sought = Sought([], [])
        for name, track in filters.items():
            last, seen = self._seen.get(name, (camera, -math.inf))
            age = time - seen if last is not camera else math.inf
            if -MAX_JUMP < age < 0.0:
                continue  # another camera's image is newer; beyond, time jumped back
            expected, tracked = track.place(time), 0.0 <= age <= FRESH
            covered = tracked and abs(time - camera.vain.get(name, -math.inf)) < SEARCH_PERIOD
            if not covered and expected is not None and self.in_view(
                    name, model, T_camera_odom @ expected):
                sought.near.append(name)
            if not tracked:
                sought.anywhere.append(name)
        return sought

    def in_view(self, name: str, model: CameraModel, T_camera_body: Transform) -> bool:
        """Return whether the middle of a marker is in or near the image, and faces the camera."""
        to_camera, (left, top, right, bottom) = T_camera_body.rotation.T, _view_limits(model)
        places, normals = self._markers[name]
        # In plain numbers: for every image, and so small.
        for (x, y, z), (u, v, w) in zip((places.dot(to_camera) + T_camera_body.translation)
                                        .tolist(), normals.dot(to_camera).tolist()):
            if z > NEAREST and x * u + y * v + z * w < 0.0 and (
                    left * z <= x <= right * z and top * z <= y <= bottom * z):
                return True
        return False

    def search_due(self, camera: MountedCamera, stamp: float) -> bool:
        """Return whether to search the whole image of a stamp, s, for a missing neighbor."""
        return self.portions(camera, stamp) > 0

    def portions(self, camera: MountedCamera, stamp: float) -> int:
        """Return how many portions of the image of a stamp, s, to search."""
        period = self._cameras * PORTION_PERIOD
        if abs(stamp - camera.searched) + 1e-3 < period:
            return 0
        # Time before the last image is gone: what it did not search, this one does not make up.
        fitting = 1.0 if camera.searched == -math.inf else (camera.interval + 1e-3) / period
        return max(math.floor(min(fitting, N_PORTIONS)), 1)

    def has_time_for_all(self, camera: MountedCamera) -> bool:
        """Return whether the image rate is so low that one image has time for all portions."""
        return camera.interval >= N_PORTIONS * PORTION_PERIOD

    def sweep_due(self, camera: MountedCamera, stamp: float) -> bool:
        """Return whether to search the whole image of a stamp, s, with no neighbor missing."""
        if camera.swept == -math.inf:
            camera.swept = stamp
        waited = min(abs(stamp - camera.searched), abs(stamp - camera.swept))
        return waited >= self._cameras * SWEEP_PERIOD - 1e-3


@lru_cache(maxsize=16)
def _view_limits(camera: CameraModel) -> tuple[float, float, float, float]:
    """Return the least and greatest (X/Z, Y/Z) in an image: left, top, right, bottom."""
    along = np.linspace(0.0, 1.0, 9)
    ends = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
    border = np.concatenate([a + along[:, None] * (b - a) for a, b in pairwise(ends)])
    xy = camera.undistort(border * (camera.width - 1.0, camera.height - 1.0))
    xy = np.where(np.isfinite(xy), xy, camera.radius * np.sign(border - 0.5))  # beyond the lens
    (left, top), (right, bottom) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    return left, top, right, bottom
