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

"""What is drawn over an image: where it should be, whatever the lens and wherever the marker."""

from __future__ import annotations

from marker_images import facing, make_camera, SIDE
import numpy as np
import pytest

from flock_follower.geometry import Array, rotation_vector_to_matrix, Transform
from flock_follower.perception import overlay
from flock_follower.perception.edge_fit import marker_corners
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import MarkedNeighbor, Marker, NeighborConfig
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.overlay import (
    annotate,
    AXIS_COLORS,
    body_covariance,
    Color,
    ColorImage,
    ellipse,
    STAGE_COLORS,
)
from flock_follower.perception.tracker import Sighting

MODELS = ('plumb_bob', 'rational_polynomial', 'equidistant')
TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))
CONFIG = NeighborConfig('DICT_4X4_50', (
    MarkedNeighbor('leader', (Marker(0, SIDE, TAIL),)),
    MarkedNeighbor('other', (Marker(1, 0.1, TAIL),))))


def drawn(image: GrayImage, T_camera_marker: Transform, stage: str = 'track',
          covariance: Array | None = None, model: str = 'plumb_bob') -> ColorImage:
    """Return an image over which a leader with its marker at a pose is drawn."""
    measurement = Measurement(
        'leader', T_camera_marker @ TAIL.inverse(), TAIL.translation,
        1e-8 * np.eye(6) if covariance is None else covariance, 0.1, None, stage)
    return annotate(image, make_camera(model), Sighting(
        measurements={'leader': measurement}), CONFIG)


def near(canvas: ColorImage, pixel: Array, color: Color, tolerance: int = 60) -> bool:
    """Return whether a colour shows within a pixel of a place."""
    x, y = np.rint(pixel).astype(int)
    patch = canvas[max(y - 1, 0):y + 2, max(x - 1, 0):x + 2].astype(int)
    return bool((np.abs(patch - np.array(color)).max(axis=2) < tolerance).any())


@pytest.mark.parametrize(('model', 'stage', 'brightness'), [
    ('plumb_bob', 'track', 0), ('rational_polynomial', 'roi', 255), ('equidistant', 'full', 0)])
def test_outline_and_axes_are_where_the_lens_puts_them(model: str, stage: str,
                                                       brightness: int) -> None:
    camera = make_camera(model)
    pose = facing((-0.15, 0.1, 0.5), (0.5, -0.4, 0.2))
    canvas = drawn(np.full((480, 640), brightness, dtype=np.uint8), pose, stage, model=model)
    corners = pose.apply(marker_corners(SIDE))
    for start, end in zip(corners, np.roll(corners, -1, axis=0)):
        for fraction in (0.2, 0.5, 0.8):  # a straight line in space is none in the image
            (pixel,) = camera.project(start + fraction * (end - start))
            assert near(canvas, pixel, STAGE_COLORS[stage])
    for axis, color in zip(np.eye(3), AXIS_COLORS):
        (pixel,) = camera.project((pose @ TAIL.inverse()).apply(0.35 * SIDE * axis))
        assert near(canvas, pixel, color)


@pytest.mark.parametrize('model', MODELS)
def test_the_ellipse_holds_what_two_deviations_hold(model: str) -> None:
    camera = make_camera(model)
    rng = np.random.default_rng(3)
    position = np.array([0.3, -0.2, 1.5])
    root = 0.01 * rng.normal(size=(3, 3))
    samples = position + rng.normal(size=(4000, 3)) @ root.T
    rim = ellipse(camera, position, root @ root.T)
    centre = rim[:-1].mean(axis=0)
    np.testing.assert_allclose(centre, camera.project(position)[0], atol=1e-6)
    spread = np.cov(camera.project(samples).T)
    distance = np.sqrt(np.einsum('ni,ij,nj->n', rim - centre, np.linalg.inv(spread), rim - centre))
    np.testing.assert_allclose(distance, 2.0, rtol=0.06)


@pytest.mark.parametrize('position', [
    (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.05), (-0.6, 0.4, 0.7), (40.0, 0.0, 0.3),
    (0.0, 0.0, 1e-7), (np.nan, 0.0, 1.0), (1e200, 1e200, 1e200)])
@pytest.mark.parametrize('turn', [(0.0, 0.0, 0.0), (2.0, 2.0, 0.0)])
def test_nothing_breaks_where_the_marker_is_not_in_view(
        position: tuple[float, float, float], turn: tuple[float, float, float]) -> None:
    image = np.full((480, 640), 100, dtype=np.uint8)
    for model, covariance in zip(MODELS, (None, np.eye(6), np.full((6, 6), np.nan))):
        with np.errstate(all='ignore'):
            canvas = drawn(image, facing(position, turn), 'track', covariance, model)
        assert canvas.shape == (480, 640, 3) and canvas.dtype == np.uint8
        assert canvas[:30, :200].max() > 200  # a line of text: the other is not seen


def test_the_covariance_of_the_body_is_that_of_what_was_measured_and_its_leverage() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(6, 6)) * np.array([[0.01]] * 3 + [[0.05]] * 3)
    measurement = Measurement('leader', facing((0.1, 0.2, 2.0), (0.3, 0.2, 0.1)),
                              np.array([-0.2, 0.1, 0.05]), root @ root.T, 0.1, None)
    rotation, reference = measurement.T_camera_body.rotation, measurement.reference
    measured = measurement.T_camera_body.apply(reference)

    def body(error: Array) -> Array:
        turned = rotation_vector_to_matrix(error[3:]) @ rotation
        return np.asarray(measured + error[:3] - turned @ reference)

    slope = np.stack([body(1e-5 * e) - body(-1e-5 * e) for e in np.eye(6)], axis=1) / 2e-5
    np.testing.assert_allclose(body_covariance(measurement),
                               slope @ measurement.covariance @ slope.T, atol=1e-8)


@pytest.mark.parametrize('shape', [(1, 1), (3, 200), (200, 3), (480, 640)])
def test_an_image_of_any_size_is_copied_and_says_what_is_seen_and_what_is_not(
        monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]) -> None:
    image = np.full(shape, 128, dtype=np.uint8)
    image.flags.writeable = False  # as images of messages are
    pose = facing((0.1, 0.2, 2.0), (0.3, 0.2, 0.1)) @ TAIL.inverse()
    sighting = Sighting(
        measurements={'leader': Measurement('leader', pose, np.zeros(3), 1e-4 * np.eye(6), 0.1,
                                            None, stage='full')},
        rejections=[('outlier', 'other'), ('late', '')], other_ids=[7, 9])
    canvas = annotate(image, make_camera(), sighting, CONFIG)
    assert canvas.shape == (*shape, 3)
    assert (image == 128).all() and (canvas != 128).any()
    texts: list[str] = []
    monkeypatch.setattr(overlay, '_write', lambda _, __, text, ___: texts.append(text))
    annotate(np.zeros((480, 640), dtype=np.uint8), make_camera(), sighting, CONFIG)
    assert texts == ['leader full', '2.20 m +- 0.010', 'outlier: other', 'late',
                     'other: not seen', 'other markers: 7, 9']
