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

"""The debug image: outlines and axes are where the lens puts them, and nothing breaks it."""

from __future__ import annotations

from marker_images import CONFIG, DICTIONARY, facing, make_camera, SIDE, TAIL
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker, NeighborConfig
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.overlay import (
    annotate,
    AXIS_COLORS,
    Color,
    ColorImage,
    STAGE_COLORS,
    WHITE,
)
from flock_follower.perception.tracker import Sighting

BOTH = NeighborConfig(DICTIONARY, (
    *CONFIG.neighbors, MarkedNeighbor('other', (Marker(1, 0.1, TAIL),))))


def drawn(T_camera_marker: Transform, stage: str, model: str,
          shape: tuple[int, int] = (480, 640)) -> ColorImage:
    """Return a dark image over which a leader with its marker at a pose is drawn."""
    image = np.zeros(shape, dtype=np.uint8)
    image.flags.writeable = False  # as images of messages are
    measurement = Measurement('leader', T_camera_marker @ TAIL.inverse(), TAIL.translation,
                              1e-4 * np.eye(6), 0.1, None, stage)
    canvas = annotate(image, make_camera(model), Sighting(
        measurements={'leader': measurement}, rejections=[('late', '')], other_ids=[7]), BOTH)
    assert canvas.shape == (*shape, 3) and canvas.dtype == np.uint8 and not image.any()
    return canvas


def near(canvas: ColorImage, pixel: Array, color: Color) -> bool:
    """Return whether a color shows within two pixels of a place."""
    x, y = np.rint(pixel).astype(int)
    patch = canvas[max(y - 2, 0):y + 3, max(x - 2, 0):x + 3].astype(int)
    return bool((np.abs(patch - np.array(color)).max(axis=2) < 60).any())


@pytest.mark.parametrize(('model', 'stage'), [
    ('plumb_bob', 'track'), ('rational_polynomial', 'roi'), ('equidistant', 'full')])
def test_outline_and_axes_are_where_the_lens_puts_them(model: str, stage: str) -> None:
    camera, pose = make_camera(model), facing((-0.15, 0.1, 0.5), (0.5, -0.4, 0.2))
    canvas = drawn(pose, stage, model)
    for corner in camera.project(pose.apply(marker_corners(SIDE))):
        assert near(canvas, corner, STAGE_COLORS[stage])
    for axis, color in zip(np.eye(3), AXIS_COLORS):
        (pixel,) = camera.project((pose @ TAIL.inverse()).apply(0.45 * SIDE * axis))
        assert near(canvas, pixel, color)
    for deviations in (0.02, 0.0, 0.0), (0.0, -0.02, 0.0):
        assert near(canvas, camera.project(pose.translation + deviations)[0], WHITE)


@pytest.mark.parametrize('position', [
    (0.0, 0.0, -1.0), (0.0, 0.0, 1e-7), (-0.6, 0.4, 0.7), (40.0, 0.0, 0.3), (np.nan, 0.0, 1.0),
    (1e200, 1e200, 1e200)])
@pytest.mark.parametrize('shape', [(3, 200), (480, 640)])
def test_nothing_breaks_where_the_marker_is_not_in_view(
        position: tuple[float, float, float], shape: tuple[int, int]) -> None:
    with np.errstate(all='ignore'):
        canvas = drawn(facing(position, (0.0, 0.0, 0.0)), 'track', 'plumb_bob', shape)
    assert canvas.any() == (shape[0] > 20)  # the text
