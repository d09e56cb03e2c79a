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
Decides which neighbour to look for in which camera's image, and at which time each was exposed.

With one camera, every neighbour is looked for in every image. With several, a neighbour that one
camera has just seen is looked for in another camera's image only if it is expected inside, and
without a search. A neighbour that no camera sees is searched for in one camera after the other, so
that more cameras cost no more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
import math

import numpy as np

from flock_follower.geometry import Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.look import Sought
from flock_follower.perception.markers import MarkedNeighbor
from flock_follower.perception.time_offset import MountedCamera

#: Whole images are searched this often at most, s.
SEARCH_PERIOD = 0.1
#: Period of searches although no neighbour is missing, s: for further markers with a known id.
SWEEP_PERIOD = 1.0
#: Who was measured in an image not older than this, s, is well tracked by its camera.
FRESH = 0.25
#: Images not further apart than this, s, were taken at once.
TOGETHER = 1e-4
#: And so far, s, are they apart for the filter, to which time does not stand still.
STEP = 1e-9
#: A marker is further off than this, m.
NEAREST = 0.05
#: A camera without images for so long, s, is waited for no longer.
SILENT = 0.5


class CameraSchedule:
    """
    Assigns the neighbours to the cameras that search for them.

    Every neighbour's filter uses the clock of the camera that saw it first. Stamps of other
    cameras differ from it by the applied time offsets.
    """

    def __init__(self, neighbors: Sequence[MarkedNeighbor],
                 cameras: Sequence[MountedCamera]) -> None:
        self._cameras = cameras
        self.shared = len(cameras) > 1
        """Whether there are several cameras."""
        names = tuple(n.name for n in neighbors)
        self.everybody = Sought(names, names, len(names))
        """All are looked for everywhere."""
        # Middles and normals on the body, (n, 3).
        self._markers = {n.name: (np.array([m.T_body_marker.translation for m in n.markers]),
                                  np.array([m.T_body_marker.rotation[:, 2] for m in n.markers]))
                         for n in neighbors}
        self.restart()

    def restart(self) -> None:
        """Forget which camera saw which neighbour."""
        self._seen: dict[str, tuple[MountedCamera, float]] = {}
        self._bases: dict[str, float] = {}

    def time(self, name: str, camera: MountedCamera, stamp: float) -> float:
        """Return the time of a neighbour's filter, s, for a stamp of a camera, s."""
        if not self.shared:
            return stamp
        base = self._bases.get(name)
        time = stamp if base is None else stamp + (camera.time_offset.applied - base)
        last, seen = self._seen.get(name, (camera, time))
        if last is not camera and abs(time - seen) < TOGETHER:
            return seen + STEP  # taken at once: one after the other for the filter
        return time

    def by_odometry(self, name: str, stamp: float) -> float:
        """Return a stamp, s, by the clock of the odometry as that of a neighbour's filter."""
        time = stamp - self._bases.get(name, self._cameras[0].time_offset.applied)
        _, seen = self._seen.get(name, (None, time))
        return time if abs(time - seen) > 2.0 * STEP else seen

    def saw(self, name: str, camera: MountedCamera, time: float) -> None:
        """Take that a neighbour was measured at a time by the clock of its filter, s."""
        if not self.shared:
            return
        self._bases.setdefault(name, camera.time_offset.applied)
        self._seen[name] = camera, time
        camera.measured[name] = time

    def seen_last_by(self, name: str, camera: MountedCamera) -> bool:
        """Return whether no other camera saw a neighbour since this one did."""
        return self._seen.get(name, (camera, 0.0))[0] is camera

    def changed(self, camera: MountedCamera) -> None:
        """Note a change of a camera's time offset: its earlier stamps keep their times."""
        offset = camera.time_offset
        for name, (last, _) in self._seen.items():
            if last is camera:
                self._bases[name] = offset.applied - (offset.before - self._bases[name])

    def sought(self, camera: MountedCamera, stamp: float, model: CameraModel,
               times: Mapping[str, float],
               place: Callable[[str], Transform | None]) -> Sought:
        """
        Return the neighbours to search for in an image of a stamp, s.

        :param times: of the image by the clocks of the filters, s.
        :param place: returns the approximate ``T_camera_body`` of a neighbour, or None.
        """
        near, anywhere = [], []
        for name, time in times.items():
            last, seen = self._seen.get(name, (camera, time))
            age = math.inf if last is camera else time - seen
            if -SILENT < age < 0.0:
                continue  # the other one's image is newer
            tracked = 0.0 <= age <= FRESH
            again = not 0.0 <= stamp - camera.vain.get(name, -math.inf) < SEARCH_PERIOD - 1e-3
            if (again or not tracked) and (
                    0.0 <= time - camera.measured.get(name, -math.inf) <= FRESH
                    or self.in_view(name, model, place(name))):
                near.append(name)
            if not tracked:
                anywhere.append(name)
        return Sought(near, anywhere, len({*near, *anywhere}))

    def in_view(self, name: str, model: CameraModel, T_camera_body: Transform | None) -> bool:
        """Return whether the middle of a marker is in the image, or nearly, and faces it."""
        if T_camera_body is None:
            return False
        to_camera, (left, top, right, bottom) = T_camera_body.rotation.T, _edges(model)
        places, normals = self._markers[name]
        # In plain numbers: for every image, and so small.
        for (x, y, z), (u, v, w) in zip((places.dot(to_camera) + T_camera_body.translation)
                                        .tolist(), normals.dot(to_camera).tolist()):
            if z > NEAREST and x * u + y * v + z * w < 0.0 and (
                    left * z <= x <= right * z and top * z <= y <= bottom * z):
                return True
        return False

    def search_due(self, camera: MountedCamera, stamp: float) -> bool:
        """Return whether to search the whole image of a stamp, s, for a missing neighbour."""
        camera.wanting = stamp
        others = [c for c in self._cameras if c is not camera and c.wanting is not None
                  and abs(stamp - c.wanting) < SILENT]
        waited = [_waited(c.searched, stamp) for c in (camera, *others)]
        return min(waited) >= SEARCH_PERIOD - 1e-3 and max(waited) == waited[0]

    def sweep_due(self, camera: MountedCamera, stamp: float) -> bool:
        """
        Return whether to search the whole image of a stamp, s, although none is missing.

        Several cameras take turns: more of them cost no more.
        """
        count = len(self._cameras)
        if camera.swept is None or stamp < camera.swept:
            camera.swept = stamp - SWEEP_PERIOD * (count - 1 - self._cameras.index(camera))
        waited = min(_waited(camera.searched, stamp), stamp - camera.swept)
        return waited >= SWEEP_PERIOD * count - 1e-3


def _waited(searched: float | None, stamp: float) -> float:
    """Return since when images were not searched, s; infinite if never."""
    return math.inf if searched is None or stamp < searched else stamp - searched


@lru_cache(maxsize=16)
def _edges(camera: CameraModel) -> tuple[float, float, float, float]:
    """Return the least and greatest (X/Z, Y/Z) in an image: left, top, right, bottom."""
    along = np.linspace(0.0, 1.0, 9)
    ends = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
    border = np.concatenate([a + along[:, None] * (b - a) for a, b in pairwise(ends)])
    xy = camera.undistort(border * (camera.width - 1.0, camera.height - 1.0))
    xy = np.where(np.isfinite(xy), xy, camera.radius * np.sign(border - 0.5))  # beyond the lens
    (left, top), (right, bottom) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    return left, top, right, bottom
