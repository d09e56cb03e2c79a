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
A rendered camera: rays through a distorting lens, exposure time, sensor noise.

Every pixel is the mean of many rays. Poses spread over the exposure time give motion blur, each
with its own offset of the rays within the pixel; of the leader each is seen with 16 rays per
pixel. Pixel coordinates are OpenCV's: (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, Transform
from flock_follower.simulation.camera.raycast import Camera, Canvas, Rays, rounded, Sheet, Window
from flock_follower.simulation.camera.scene import Image, Scenery, Surface

#: Columns and rows within a pixel of the rays to the leader: 16 in 16 of each.
_ROOKS = np.array([[(5 * k + 3) % 16 for k in range(16)], range(16)])
_SPREAD = 0.17  # share of a pixel's light that the lens throws on the pixel to either side


@dataclass(frozen=True)
class Sensor:
    """How light becomes numbers: exposure, noise, gamma."""

    exposure: float = 0.005
    """s."""
    sub_poses: int = 4
    """Poses within the exposure that are rendered and averaged."""
    full_well: float = 12000.0
    """Photo-electrons at the largest value: fewer make more shot noise."""
    read_noise: float = 12.0
    """Standard deviation, electrons."""
    gain: float = 1.5
    """Share of the full well that a radiance of 1 fills, in the image's centre."""
    gamma: float = 2.2
    vignetting: float = 0.35
    """Relative light 1 / (1 + this r^2)^2, r the tangent of the angle off axis; 1 is cos^4."""

    def times(self, stamp: float) -> Array:
        """Return the times of the sub-poses about the middle of the exposure, s."""
        return stamp + self.exposure * ((np.arange(self.sub_poses) + 0.5) / self.sub_poses - 0.5)


class Renderer:
    """
    Renders one leader in a world.

    :param leader: surfaces in the leader's body frame; none for an empty world.
    """

    def __init__(self, camera: Camera, sensor: Sensor, world: Scenery,
                 leader: Sequence[Surface] = (), seed: int = 1) -> None:
        self.camera, self.sensor = camera, sensor
        self._world, self._seed = world, seed
        self._background, self._leader = Sheet(world.surfaces), Sheet(leader)
        self._rays = Rays(camera)
        fall = 1 + np.float32(sensor.vignetting) * (self._rays.x**2 + self._rays.y**2)
        self._light = np.float32(sensor.gain) / (fall * fall)
        self._codes = np.rint(
            255.0 * (np.arange(4096) / 4095.0)**(1.0 / sensor.gamma)).astype(np.uint8)

    def image(self, index: int, cameras: Sequence[Transform],
              leaders: Sequence[Transform]) -> NDArray[np.uint8]:
        """
        Return what the sensor gives: mono8, (height, width).

        :param index: number of the image: its noise depends on it and the seed alone.
        :param cameras: poses of the optical frame in the world, spread over the exposure.
        :param leaders: poses of the leader's body in the world at the same times.
        """
        return self.develop(index, self.radiance(cameras, leaders))

    def radiance(self, cameras: Sequence[Transform], leaders: Sequence[Transform]) -> Image:
        """Return the light on the sensor (height, width) behind an ideal lens, without noise."""
        total = np.zeros(self._rays.shape, dtype=np.float32)
        shuffled = _shuffled(len(cameras))
        for k, (camera, leader) in enumerate(zip(cameras, leaders)):
            image = self._see_world(rounded(camera), *self._jitter(k, len(cameras)))
            self._see_leader(image, rounded(camera), rounded(leader), shuffled[k])
            total += image
        return total / np.float32(len(cameras))

    def develop(self, index: int, radiance: Image) -> NDArray[np.uint8]:
        """Return the image (height, width), mono8: lens blur, vignetting, noise, gamma."""
        rng = np.random.default_rng([self._seed, index])
        signal = _blurred(radiance) * self._light
        shot = np.float32(1.0 / self.sensor.full_well)
        read = np.float32(self.sensor.read_noise / self.sensor.full_well)
        noise = rng.standard_normal(signal.shape, dtype=np.float32)
        noisy = signal + noise * np.sqrt(signal * shot + read * read)
        return self._codes[np.rint(np.clip(noisy, 0, 1) * 4095).astype(np.int32)]

    def _jitter(self, k: int, count: int) -> tuple[Image, Image]:
        """
        Return where in each pixel (1, height, width) the world's one ray of sub-pose k passes.

        In every pixel the rays of all sub-poses are spread evenly, in another order than in its
        neighbours: else a place in the pixel would go with a time, and blur be too long or short.
        """
        rows, columns = np.ogrid[:self._rays.shape[0], :self._rays.shape[1]]
        order = (k + columns + 2 * rows) % count
        across, down = (np.arange(count) + 0.5) / count, _shuffled(count)
        du, dv = ((m - 0.5).astype(np.float32)[order][None] for m in (across, down))
        return du, dv

    def _see_world(self, camera: Transform, du: Image, dv: Image) -> Image:
        full = slice(0, self._rays.shape[0]), slice(0, self._rays.shape[1])
        canvas = self._painted(full, du, dv, self._background, camera, Transform())
        air = np.float32(self._world.haze)
        value = canvas.value[0] + (1 - canvas.cover[0]) * air
        clear = 1 - 1 / (1 + canvas.nearness[0] * np.float32(self._world.visibility))
        return air + (value - air) * clear

    def _see_leader(self, image: Image, camera: Transform, leader: Transform,
                    shift: float) -> None:
        """Put the leader over the background, the rays shifted by a share of their spacing."""
        seen = rounded(camera.inverse() @ leader)
        windows = np.array([f.window for f in self._leader.seen(self._rays, seen)])
        if not len(windows):
            return
        first, last = windows.min(axis=0), windows.max(axis=0)
        window = slice(first[0], last[1]), slice(first[2], last[3])
        du, dv = ((_ROOKS + shift) / 16 - 0.5).astype(np.float32)[:, :, None, None]
        canvas = self._painted(window, du, dv, self._leader, camera, leader)
        value, cover = (_mean(m) for m in (canvas.value, canvas.cover))
        image[window] = value + (1 - cover) * image[window]

    def _painted(self, window: Window, du: Image, dv: Image, sheet: Sheet, camera: Transform,
                 pose: Transform) -> Canvas:
        """Paint a sheet at a pose in the world on a window, with rays at offsets in pixels."""
        canvas = Canvas(self._rays, window, du, dv)
        light = self._world.brightness(sheet.normals(pose))
        for facet in sheet.seen(self._rays, rounded(camera.inverse() @ pose)):
            canvas.paint(facet, sheet.surfaces[facet.surface], light[facet.surface])
        return canvas


def _shuffled(count: int) -> Array:
    """Return the middles of so many equal parts of [0, 1], in an order far from their own."""
    ranks = np.argsort(np.argsort((np.arange(1, count + 1) * 0.618) % 1.0))
    return (ranks + 0.5) / count


def _mean(samples: Image) -> Image:
    total = samples[0].copy()
    for sample in samples[1:]:  # one by one: the order of a library's sum may vary
        total += sample
    return total / np.float32(len(samples))


def _blurred(image: Image) -> Image:
    """Spread every pixel's light on its neighbours, as a real lens does (sigma 0.58 px)."""
    side = np.float32(_SPREAD)
    for _ in range(2):  # up and down, then, transposed, left and right
        padded = np.pad(image, ((1, 1), (0, 0)), mode='edge')
        image = (image + side * (padded[:-2] - image) + side * (padded[2:] - image)).T
    return image
