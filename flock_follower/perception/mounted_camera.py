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

"""One camera on the body: where it is, its clock, what was learnt of it and what it did last."""

from __future__ import annotations

from collections.abc import Iterable

from flock_follower.geometry import Transform
from flock_follower.perception import rolling_shutter
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.learnt_noise import LearntNoise
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.neighbor_motion import FilterParams
from flock_follower.perception.time_offset import TimeOffset


class MountedCamera:
    """
    A camera mounted at ``T_body_camera`` (optical), with what lasts from image to image.

    :param time_offset: finds out by how much its images' stamps are off.
    :param readout_time: from an image's first row to its last, s; the stamp is that of the first.
    :param attitude_noise: of the own attitude as its images show it, at least, rad.
    :param rectified: whether its images are undistorted already.
    """

    def __init__(self, T_body_camera: Transform, time_offset: TimeOffset | None = None,
                 readout_time: float = 0.0,
                 attitude_noise: float = FilterParams.attitude_noise,
                 rectified: bool = False) -> None:
        self.T_body_camera = T_body_camera
        self.time_offset = time_offset or TimeOffset()
        self.readout_time = readout_time
        self.noise = LearntNoise(attitude_noise)
        self.rectified = rectified
        self.restart(())

    def restart(self, names: Iterable[str]) -> None:
        """Forget what was learnt and done, and begin anew with neighbours of these names."""
        self.noise.restart()
        self.searched: float | None = None
        """Stamp of the newest image that was searched as a whole, s."""
        self.swept: float | None = None
        """Stamp of the newest one, or the first, searched although nobody was missing, s."""
        self.wanting: float | None = None
        """Stamp of the newest image that somebody was missing in, s."""
        self.thorough = False
        """How a whole image is searched the next time."""
        self.unchecked = dict.fromkeys(names, 0)
        """Images for which a neighbour's mirrored attitude need not be looked at."""
        self.spacings: dict[str, tuple[float, float] | None] = dict.fromkeys(names)
        self.delays = dict.fromkeys(names, 0.5 * self.readout_time)
        """How long after an image's stamp a neighbour is exposed, s."""
        self.measured: dict[str, float] = {}
        """When it saw a neighbour last, by the clock of that one's filter, s."""
        self.vain: dict[str, float] = {}
        """Stamp of the image in which one whom another camera sees was not found, s."""

    def exposed(self, model: CameraModel, measurement: Measurement) -> float:
        """Return how long after the image's stamp a neighbour was exposed, s, and remember it."""
        if self.readout_time:
            self.delays[measurement.name] = rolling_shutter.delay(
                model, self.readout_time,
                measurement.T_camera_body.apply(measurement.reference))
        return self.delays[measurement.name]
