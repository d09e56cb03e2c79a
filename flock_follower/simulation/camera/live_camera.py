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
A camera rendered while a flight goes on: one image in milliseconds.

The offline renderer's lens, sensor, marker and leader, simplified where nothing is measured from
it: the surroundings are a panorama, sampled at half resolution, as if out of focus; the leader's
body is drawn as plain polygons. The printed marker is not simplified: every pixel of it is the
mean of 8 rays through the distorting lens, spread over the pixel and over the exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, Transform
from flock_follower.simulation.camera.leader_drawing import LiveLeader
from flock_follower.simulation.camera.panorama import Panorama
from flock_follower.simulation.camera.raycast import Camera, Rays
from flock_follower.simulation.camera.renderer import Sensor
from flock_follower.simulation.camera.scene import Image, Scenery, Surface

_CELL = 16  # px between the rays whose directions are computed; between them they are interpolated
_LEVELS, _FULL = 4096, 1.25  # of light, up to this share of the full well, in the noise table
_DRAWS = 128  # different values of noise: quantiles of the normal distribution
_ROAM = 64  # px by which the noise of an image may be shifted against that of another
_LENS = np.array([0.17, 0.66, 0.17])  # the light of a pixel that reaches its neighbours


@dataclass(frozen=True)
class Light:
    """What the weather does to an image: all light times ``gain``, and glare everywhere."""

    gain: float = 1.0
    veil: float = 0.0
    """Share of the full well."""


class LiveCamera:
    """
    Renders one leader before distant surroundings.

    :param leader: surfaces in the leader's body frame, as :func:`scene.leader` gives them.
    :param viewpoint: the place (3,), m, from which the surroundings are as they appear.
    """

    def __init__(self, camera: Camera, sensor: Sensor, world: Scenery, leader: Sequence[Surface],
                 viewpoint: Array, seed: int = 1) -> None:
        self.camera, self.sensor = camera, sensor
        self._seed = seed
        rays = Rays(camera)
        self._panorama = Panorama.build(world, viewpoint)
        self._leader = LiveLeader(camera, rays, world, leader)
        columns, rows = (_CELL * (np.arange(-(-size // _CELL) + 2) - 0.5) - 0.5
                         for size in (camera.width, camera.height))
        self._coarse = camera.rays(*np.meshgrid(columns, rows))
        fall = 1 + np.float32(sensor.vignetting) * (rays.x**2 + rays.y**2)
        self._levels = np.float32(sensor.gain * (_LEVELS - 1) / _FULL) / (fall * fall)
        self._table = _noise_table(sensor)
        rng = np.random.default_rng([seed, 1])
        self._noise = rng.integers(
            0, _DRAWS, (camera.height + _ROAM, camera.width + _ROAM), dtype=np.int32)

    def image(self, index: int, cameras: Sequence[Transform], leaders: Sequence[Transform],
              light: Light | None = None) -> NDArray[np.uint8]:
        """
        Return what the sensor gives: mono8, (height, width).

        :param index: number of the image: its noise depends on it and the seed alone.
        :param cameras: poses of the optical frame in the world, spread over the exposure.
        :param leaders: poses of the leader's body in the world at the same times; none at all
            leave it out.
        """
        radiance = self._backdrop(cameras[len(cameras) // 2])
        seen = self._leader.seen(cameras, leaders) if leaders else None
        if seen is not None:
            value = seen.value + (1 - seen.cover) * radiance[seen.window]
            radiance[seen.window] = cv2.sepFilter2D(
                value, -1, _LENS, _LENS, borderType=cv2.BORDER_REPLICATE)
        return self._develop(index, radiance, light or Light())

    def _backdrop(self, camera: Transform) -> Image:
        columns, rows = self._panorama.places(*self._coarse, camera.rotation)
        height, width = columns.shape
        half = _CELL // 2
        size = width * half, height * half
        inner = slice(half, -half), slice(half, -half)
        columns, rows = (cv2.resize(m, size, interpolation=cv2.INTER_LINEAR)[inner]
                         for m in (columns, rows))
        seen = cv2.remap(self._panorama.values, columns, rows, cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_REPLICATE)
        full = cv2.resize(seen, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        return full[:self.camera.height, :self.camera.width]  # type: ignore[return-value]

    def _develop(self, index: int, radiance: Image, light: Light) -> NDArray[np.uint8]:
        """Return the image, mono8: vignetting, noise, gamma."""
        levels = radiance * self._levels
        if light != Light():
            levels *= np.float32(light.gain)
            levels += np.float32(light.veil * (_LEVELS - 1) / _FULL)
        np.minimum(levels, np.float32(_LEVELS - 1), out=levels)
        code = levels.astype(np.int32)
        code *= _DRAWS
        down, right = np.random.default_rng([self._seed, 2, index]).integers(0, _ROAM, 2)
        code += self._noise[down:down + code.shape[0], right:right + code.shape[1]]
        return self._table.take(code, mode='clip')


def _noise_table(sensor: Sensor) -> NDArray[np.uint8]:
    """Return the pixel value (_LEVELS * _DRAWS,) of every level of light with every noise."""
    draws = np.array([NormalDist().inv_cdf((k + 0.5) / _DRAWS) for k in range(_DRAWS)])
    draws /= draws.std()
    light = ((np.arange(_LEVELS) + 0.5) * _FULL / (_LEVELS - 1))[:, None]
    read = sensor.read_noise / sensor.full_well
    noisy = light + draws * np.sqrt(light / sensor.full_well + read * read)
    return np.rint(255.0 * np.clip(noisy, 0.0, 1.0) ** (1.0 / sensor.gamma)).astype(
        np.uint8).ravel()
