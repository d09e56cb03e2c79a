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

"""The detector: ids, corners to a few hundredths of a pixel, and the pixel convention."""

from __future__ import annotations

from marker_images import DICTIONARY, facing, make_camera, render, SIDE
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.perception import aruco
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.corners import bloom, moved_outward, refine_corners
from flock_follower.perception.pose import marker_corners


def poses(distance: float, count: int) -> list[Transform]:
    """Return poses of a marker at a distance, m, all over the image and turned by up to 30 deg."""
    rng = np.random.default_rng(round(100 * distance))
    return [facing((distance * rng.uniform(-0.3, 0.3), distance * rng.uniform(-0.22, 0.22),
                    distance), tuple(rng.uniform(-0.5, 0.5, 3))) for _ in range(count)]


def true_corners(camera: CameraModel, pose: Transform) -> Array:
    return camera.project(pose.apply(marker_corners(SIDE)))


def outward(corners: Array) -> Array:
    """Return unit vectors (4, 2) from the middle of a marker to its corners."""
    away = corners - corners.mean(axis=0)
    return away / np.linalg.norm(away, axis=1, keepdims=True)


@pytest.mark.parametrize(('distance', 'rms'), [(1.2, 0.05), (2.0, 0.06), (3.0, 0.08)])
@pytest.mark.parametrize('trouble', [
    {}, {'blur': 1.0, 'noise': 5.0}, {'motion': (3.0, 1.0), 'noise': 3.0},
    {'black': 12.0, 'white': 60.0, 'noise': 3.0}, {'gamma': 2.2, 'black': 8.0, 'blur': 0.8}])
def test_corners_are_unbiased_and_precise(distance: float, rms: float,
                                          trouble: dict[str, float]) -> None:
    camera = make_camera()
    errors, bias = [], []
    for k, pose in enumerate(poses(distance, 4)):
        found = aruco.detect(render(camera, {3: pose}, seed=k, **trouble), DICTIONARY,
                             camera=camera)
        assert found.ids.tolist() == [3]
        assert found.sigma.tolist() == [aruco.SIGMA_EDGES]
        assert found.sigma_bloom[0] < 0.1  # measured, not assumed
        truth = true_corners(camera, pose)
        errors.append(found.corners[0] - truth)
        bias.append(np.sum(errors[-1] * outward(truth)) / 4.0)
    noise = 1.5 if 'white' in trouble else 1.0  # a fifth of the contrast
    assert np.sqrt(np.mean(np.square(errors))) < rms * noise
    # A common shift outwards by 0.07 px of each coordinate is 2 mm in distance at 2 m.
    assert abs(np.mean(bias)) < 0.1 * np.sqrt(distance / 2.0)


def test_swollen_white_is_measured_per_direction() -> None:
    # A drawn marker whose white reaches 1 px further left and right, and nowhere else.
    code = aruco.draw_marker(DICTIONARY, 0, 6) > 127
    drawn = np.kron(np.pad(code, 2, constant_values=True), np.ones((14, 14), dtype=bool))
    swollen = drawn | np.roll(drawn, 1, axis=1) | np.roll(drawn, -1, axis=1)
    image = np.where(swollen, 200, 30).astype(np.uint8)
    edges = np.array([[28.5, 27.5], [110.5, 27.5], [110.5, 111.5], [28.5, 111.5]])
    shifts, sigma = bloom(image, edges, code)
    assert sigma < 0.1
    np.testing.assert_allclose(shifts, [0.0, 1.0, 0.0, 1.0], atol=0.05)
    truth = [[27.5, 27.5], [111.5, 27.5], [111.5, 111.5], [27.5, 111.5]]
    np.testing.assert_allclose(moved_outward(edges, shifts), truth, atol=0.05)


def test_swelling_of_a_marker_without_white_at_its_border_is_unknown() -> None:
    code = np.zeros((6, 6), dtype=bool)
    image = np.full((140, 140), 30, dtype=np.uint8)
    square = np.array([[28.0, 28.0], [112.0, 28.0], [112.0, 112.0], [28.0, 112.0]])
    shifts, sigma = bloom(image, square, code)
    np.testing.assert_array_equal(shifts, 0.0)
    assert sigma >= 0.3


@pytest.mark.parametrize('model', ['rational_polynomial', 'equidistant'])
def test_the_camera_straightens_edges_that_the_lens_bends(model: str) -> None:
    camera = make_camera(model)
    for k, pose in enumerate(poses(0.6, 3)):
        image = render(camera, {3: pose}, seed=k)
        found = aruco.detect(image, DICTIONARY, camera=camera)
        assert np.max(np.abs(found.corners[0] - true_corners(camera, pose))) < 0.15
        without = aruco.detect(image, DICTIONARY)
        assert np.max(np.abs(without.corners[0] - true_corners(camera, pose))) < 1.0


def test_pixel_zero_is_the_centre_of_the_first_pixel() -> None:
    image = np.full((200, 240), 210, dtype=np.uint8)
    image[50:122, 80:152] = np.where(aruco.draw_marker(DICTIONARY, 7, 72) > 127, 210, 25)
    found = aruco.detect(image, DICTIONARY)
    edges = [[79.5, 49.5], [151.5, 49.5], [151.5, 121.5], [79.5, 121.5]]
    np.testing.assert_allclose(found.corners, [edges], atol=0.02)


@pytest.mark.parametrize('turns', range(4))
def test_corners_come_in_the_markers_own_order(turns: int) -> None:
    image = np.full((200, 200), 210, dtype=np.uint8)
    marker = np.where(aruco.draw_marker(DICTIONARY, 0, 72) > 127, 210, 25)
    image[60:132, 60:132] = np.rot90(marker, -turns)  # clockwise
    found = aruco.detect(image, DICTIONARY)
    upright = np.array([[59.5, 59.5], [131.5, 59.5], [131.5, 131.5], [59.5, 131.5]])
    np.testing.assert_allclose(found.corners[0], np.roll(upright, -turns, axis=0), atol=0.02)


@pytest.mark.parametrize('dictionary', [
    'DICT_4X4_50', 'DICT_5X5_1000', 'DICT_6X6_250', 'DICT_7X7_100', 'DICT_ARUCO_ORIGINAL'])
def test_what_is_drawn_is_detected(dictionary: str) -> None:
    cells = aruco.marker_cells(dictionary)
    last = aruco.dictionary_size(dictionary) - 1
    image = np.full((200, 420), 230, dtype=np.uint8)
    for x, marker_id in ((40, 1), (240, last)):
        image[40:40 + 14 * cells, x:x + 14 * cells] = aruco.draw_marker(
            dictionary, marker_id, 14 * cells)
    found = aruco.detect(image, dictionary)
    assert sorted(found.ids.tolist()) == [1, last]
    np.testing.assert_allclose(np.sort(found.corners[:, 0, 0]), [39.5, 239.5], atol=0.02)


def test_search_in_a_region_gives_pixels_of_the_whole_image() -> None:
    camera = make_camera()
    left, right = facing((-0.4, 0.1, 2.0), (0.1, 0.3, 0.0)), facing((0.4, 0.1, 2.0), (0, 0, 0.1))
    image = render(camera, {3: left, 4: right})
    x0, y0 = np.floor(true_corners(camera, left).min(axis=0)).astype(int) - 15
    x1, y1 = np.ceil(true_corners(camera, left).max(axis=0)).astype(int) + 15
    found = aruco.detect(image, DICTIONARY, camera=camera, region=(x0, y0, x1, y1))
    assert found.ids.tolist() == [3]
    np.testing.assert_allclose(found.corners[0], true_corners(camera, left), atol=0.15)


def test_an_image_without_markers_gives_empty_arrays() -> None:
    found = aruco.detect(render(make_camera(), {}), DICTIONARY)
    assert [a.shape for a in found] == [(0,), (0, 4, 2), (0,), (0,)]


def test_edges_that_are_not_there_are_not_refined() -> None:
    square = np.array([[50.0, 50.0], [90.0, 50.0], [90.0, 90.0], [50.0, 90.0]])
    flat = np.full((140, 140), 128, dtype=np.uint8)
    assert refine_corners(flat, square, 6) is None
    inverted = np.full((140, 140), 20, dtype=np.uint8)
    inverted[50:91, 50:91] = 220
    assert refine_corners(inverted, square, 6) is None


def test_corners_without_clean_edges_are_coarser_and_say_so(
        monkeypatch: pytest.MonkeyPatch) -> None:
    camera, pose = make_camera(), facing((0.1, 0.0, 1.5), (0.1, 0.3, 0.0))
    monkeypatch.setattr(aruco, 'refine_corners', lambda *_: None)
    found = aruco.detect(render(camera, {3: pose}), DICTIONARY, camera=camera)
    assert found.sigma.tolist() == [aruco.SIGMA_GRADIENT]
    np.testing.assert_allclose(found.corners[0], true_corners(camera, pose), atol=0.8)


@pytest.mark.parametrize(('arguments', 'message'), [
    (('DICT_9X9', 0, 100), "'DICT_9X9': must be one of .*DICT_4X4_50"),
    ((DICTIONARY, 50, 100), 'marker_id = 50: DICT_4X4_50 has 0 to 49'),
    ((DICTIONARY, -1, 100), 'marker_id = -1'),
    ((DICTIONARY, 0, 5), 'side_px = 5: must be at least 6'),
    ((DICTIONARY, 0, 100, 0), 'border_bits = 0')])
def test_impossible_markers_are_refused_by_name(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        aruco.draw_marker(*arguments)


def test_unknown_dictionary_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="dictionary = 'ARUCO'"):
        aruco.detect(np.zeros((50, 50), dtype=np.uint8), 'ARUCO')


@pytest.mark.parametrize('shift', [-30.5, 605.0])
def test_a_marker_that_reaches_over_the_edge_keeps_its_unrefined_corners(monkeypatch, shift):
    rough = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0]])
    rough += [shift, 100.0]
    monkeypatch.setattr(aruco, '_search', lambda *_: (rough[None, None], np.array([0])))
    found = aruco.detect(np.full((480, 640), 128, np.uint8), DICTIONARY)
    np.testing.assert_array_equal(found.corners[0], rough)
