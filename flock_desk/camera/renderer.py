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
A rendered camera: a leader before its surroundings, through a distorting lens, onto a sensor.

Poses spread over the exposure time give motion blur. Of the leader each is seen with several
samples per pixel. The surroundings are cast for every image, which takes a tenth of a second, or,
for flights in real time, seen as from one viewpoint: see ``panorama``. Everything else is the same
for both. Pixel coordinates are OpenCV's: (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_desk.camera.leader_drawing import LeaderDrawing
from flock_desk.camera.lens import Camera, Rays, Window
from flock_desk.camera.panorama import PanoramaView
from flock_desk.camera.scene import Image, Scenery, Surface
from flock_desk.camera.surroundings import Surroundings
from flock_follower.geometry import Array, Transform

_FULL = 1.25  # share of the full well: the most light that is told apart from more
_SCALE = 65535 / _FULL  # of light in 16 bits
_LEVEL_BITS, _DRAW_BITS = 11, 8  # levels of light, and quantiles of noise, in the table of both
_SPREAD = 0.607  # px: of the lens's blur, 17 % of a pixel's light on either side


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


@dataclass(frozen=True)
class Light:
    """What the weather does to an image: all light times ``gain``, and glare everywhere."""

    gain: float = 1.0
    veil: float = 0.0
    """Share of the full well."""


class Renderer:
    """
    Renders one leader before its surroundings.

    :param leader: surfaces in the leader's body frame; none for an empty world.
    :param fineness: its square is the number of samples of the leader per pixel and sub-pose.
    :param prints: surfaces in the world that are drawn as the leader is.
    :param viewpoint: a place (3,), m, from which the surroundings are taken to be seen always;
        None: from where the camera is.
    """

    def __init__(self, camera: Camera, sensor: Sensor, scenery: Scenery,
                 leader: Sequence[Surface] = (), seed: int = 1, *, fineness: int = 4,
                 viewpoint: Array | None = None, prints: Sequence[Surface] = ()) -> None:
        self.camera, self.sensor = camera, sensor
        self._seed = seed
        rays = Rays(camera)
        self._surroundings = (Surroundings(rays, scenery) if viewpoint is None
                              else PanoramaView(camera, scenery, viewpoint))
        self._sharp = viewpoint is None  # a panorama is out of focus as it is
        self._leader = LeaderDrawing(rays, scenery, leader, fineness)
        self._prints = [(each.pose.translation, LeaderDrawing(rays, scenery, [each], fineness))
                        for each in prints]
        fall = 1 + np.float32(sensor.vignetting) * (rays.x * rays.x + rays.y * rays.y)
        self._exposed = np.float32(_SCALE * sensor.gain) / (fall * fall)
        self._table = _noise_table(sensor)

    def image(self, index: int, cameras: Sequence[Transform], leaders: Sequence[Transform],
              light: Light | None = None) -> NDArray[np.uint8]:
        """
        Return what the sensor gives: mono8, (height, width).

        :param index: number of the image: its noise depends on it and the seed alone.
        :param cameras: poses of the optical frame in the world, spread over the exposure.
        :param leaders: poses of the leader's body in the world at the same times; none at all
            leave it out.
        """
        radiance, leader = self._radiance(cameras, leaders)
        return self.develop(index, radiance, light, np.s_[:, :] if self._sharp else leader)

    def radiance(self, cameras: Sequence[Transform], leaders: Sequence[Transform]) -> Image:
        """Return the light on the sensor (height, width) behind an ideal lens, without noise."""
        return self._radiance(cameras, leaders)[0]

    def _radiance(self, cameras: Sequence[Transform],
                  leaders: Sequence[Transform]) -> tuple[Image, Window]:
        """Return the light, and the part of it that shows leader and prints."""
        image = self._surroundings.seen(cameras)
        drawings = [(place, drawing, [Transform()] * len(cameras))
                    for place, drawing in self._prints]
        if leaders:
            drawings.append((leaders[0].translation, self._leader, [*leaders]))
        eye, window = cameras[0].translation, np.s_[:0, :0]
        for _, drawing, poses in sorted(
                drawings, key=lambda each: -float(np.linalg.norm(each[0] - eye))):
            seen = drawing.seen(cameras, poses)
            if seen is not None:
                image[seen.window] = seen.value + (1 - seen.cover) * image[seen.window]
                window = _around(window, seen.window)
        return image, window

    def develop(self, index: int, radiance: Image, light: Light | None = None,
                sharp: Window = np.s_[:, :]) -> NDArray[np.uint8]:
        """
        Return the image (height, width), mono8: vignetting, lens blur, noise, gamma.

        :param sharp: the part that the lens has not blurred yet.
        """
        exposed = radiance * self._exposed
        if light is not None:
            exposed *= np.float32(light.gain)
            exposed += np.float32(_SCALE * light.veil)
        np.minimum(exposed, np.float32(65535), out=exposed)
        code = exposed.astype(np.uint16)
        if code[sharp].size:  # in integers OpenCV's blur is the same on every processor
            code[sharp] = cv2.GaussianBlur(code[sharp], (3, 3), _SPREAD,
                                           borderType=cv2.BORDER_REPLICATE)
        code = code.astype(np.int32)
        code >>= 16 - _LEVEL_BITS
        code <<= _DRAW_BITS
        noise = np.random.default_rng([self._seed, index]).bytes(code.size)
        code |= np.frombuffer(noise, np.uint8).reshape(code.shape)
        return self._table.take(code, mode='clip')


def _around(a: Window, b: Window) -> Window:
    """Return the window around two, the first of which may be empty."""
    if a[0].stop == 0:
        return b
    rows, columns = (slice(min(i.start, j.start), max(i.stop, j.stop)) for i, j in zip(a, b))
    return rows, columns


def _noise_table(sensor: Sensor) -> NDArray[np.uint8]:
    """Return the pixel values (levels * draws,): of every level of light with every noise."""
    count, levels = 2 ** _DRAW_BITS, 2 ** _LEVEL_BITS
    draws = np.array([NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)])
    draws = (draws / np.sqrt(np.mean(draws * draws))).round(9)
    light = ((np.arange(levels) + 0.5) * _FULL / levels)[:, None]
    read = sensor.read_noise / sensor.full_well
    noisy = light + draws * np.sqrt(light / sensor.full_well + read * read)
    return np.rint(255.0 * np.clip(noisy, 0.0, 1.0) ** (1.0 / sensor.gamma)).astype(
        np.uint8).ravel()


def render_in_one_thread() -> None:
    """Keep OpenCV from sharing an image's work out: its threads take twice the time, waiting."""
    cv2.setNumThreads(1)
