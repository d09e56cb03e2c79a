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

"""The detector: ids, corners to a pixel, and the pixel convention, whatever the OpenCV."""

from __future__ import annotations

import cv2
from marker_images import DICTIONARY, facing, make_camera, render, SIDE
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.perception import markers as aruco
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edge_fit import marker_corners

THREE_WINDOWS = aruco.DetectionParams(windows=(3, 23, 10), min_perimeter=0.03)


def poses(distance: float, count: int) -> list[Transform]:
    """Return poses of a marker at a distance, m, all over the image and turned by up to 30 deg."""
    rng = np.random.default_rng(round(100 * distance))
    return [facing((distance * rng.uniform(-0.3, 0.3), distance * rng.uniform(-0.22, 0.22),
                    distance), tuple(rng.uniform(-0.5, 0.5, 3))) for _ in range(count)]


def true_corners(camera: CameraModel, pose: Transform) -> Array:
    return camera.project(pose.apply(marker_corners(SIDE)))


@pytest.mark.slow
@pytest.mark.parametrize('distance', [1.2, 2.0, 3.0])
@pytest.mark.parametrize('trouble', [
    {}, {'blur': 1.0, 'noise': 5.0}, {'motion': (3.0, 1.0), 'noise': 3.0},
    {'black': 12.0, 'white': 60.0, 'noise': 3.0}, {'gamma': 2.2, 'black': 8.0, 'blur': 0.8}],
    ids=str)
def test_corners_are_good_enough_for_the_edges_to_be_found_from_them(
        distance: float, trouble: dict[str, float]) -> None:
    camera = make_camera()
    for k, pose in enumerate(poses(distance, 4)):
        found = aruco.detect(render(camera, {3: pose}, rays=3, seed=k, **trouble), DICTIONARY,
                             THREE_WINDOWS)
        assert found.ids.tolist() == [3]
        assert np.abs(found.corners[0] - true_corners(camera, pose)).max() < 2.0


def test_pixel_zero_is_the_centre_of_the_first_pixel() -> None:
    image = np.full((200, 240), 210, dtype=np.uint8)
    image[50:122, 80:152] = np.where(aruco.draw_marker(DICTIONARY, 7, 72) > 127, 210, 25)
    found = aruco.detect(image, DICTIONARY)
    # The outline goes through the centres of the outermost black pixels.
    np.testing.assert_allclose(
        found.corners, [[[80, 50], [151, 50], [151, 121], [80, 121]]], atol=0.5)


@pytest.mark.parametrize('turns', range(4))
def test_corners_come_in_the_markers_own_order(turns: int) -> None:
    image = np.full((200, 200), 210, dtype=np.uint8)
    marker = np.where(aruco.draw_marker(DICTIONARY, 0, 72) > 127, 210, 25)
    image[60:132, 60:132] = np.rot90(marker, -turns)  # clockwise
    found = aruco.detect(image, DICTIONARY)
    upright = np.array([[60.0, 60.0], [131.0, 60.0], [131.0, 131.0], [60.0, 131.0]])
    np.testing.assert_allclose(found.corners[0], np.roll(upright, -turns, axis=0), atol=0.5)


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
    np.testing.assert_allclose(np.sort(found.corners[:, 0, 0]), [40.0, 240.0], atol=0.5)


def test_what_is_blurred_takes_a_wide_window() -> None:
    image = render(make_camera(), {3: facing((0.0, 0.0, 0.5), (0.0, 0.2, 0.0))}, blur=3.0)
    for windows, ids in (((3, 3, 10), []), ((15, 15, 10), [3]), ((3, 23, 10), [3])):
        params = aruco.DetectionParams(windows=windows)
        assert aruco.detect(image, DICTIONARY, params).ids.tolist() == ids


def test_an_outline_shorter_than_asked_for_is_not_looked_at() -> None:
    image = render(make_camera(), {3: facing((0.0, 0.0, 3.0), (0.0, 0.2, 0.0))})  # 33 px a side
    for perimeter, ids in ((0.1, [3]), (0.3, [])):
        params = aruco.DetectionParams((3, 23, 10), perimeter)
        assert aruco.detect(image, DICTIONARY, params).ids.tolist() == ids


def test_an_image_without_markers_gives_empty_arrays() -> None:
    found = aruco.detect(render(make_camera(), {}), DICTIONARY)
    assert [a.shape for a in found[:2]] == [(0,), (0, 4, 2)]
    assert found.ids.dtype == np.int64


@pytest.mark.parametrize('dictionary', ['DICT_4X4_50', 'DICT_6X6_250', 'DICT_ARUCO_ORIGINAL'])
def test_words_are_the_inner_cells_of_the_codes_and_of_the_drawings(dictionary: str) -> None:
    words, cells = aruco.dictionary_words(dictionary), aruco.marker_cells(dictionary)
    assert words.shape == (aruco.dictionary_size(dictionary), cells - 2, cells - 2)
    assert len({word.tobytes() for word in words}) == len(words)
    for marker_id in (0, 7, len(words) - 1):
        code = aruco.marker_code(dictionary, marker_id)
        np.testing.assert_array_equal(code[1:-1, 1:-1], words[marker_id])
        assert not np.concatenate([code[0], code[-1], code[:, 0], code[:, -1]]).any()
        drawn = aruco.draw_marker(dictionary, marker_id, 10 * cells)[5::10, 5::10] > 127
        np.testing.assert_array_equal(code, drawn)


@pytest.mark.parametrize(('dictionary', 'cells'), [
    ('DICT_4X4_50', 1), ('DICT_5X5_100', 3), ('DICT_6X6_50', 6)])
def test_correctable_cells_are_opencvs(dictionary: str, cells: int) -> None:
    assert aruco.correctable_cells(dictionary) == cells


@pytest.mark.parametrize(('arguments', 'message'), [
    (('DICT_9X9', 0, 100), "'DICT_9X9': must be one of .*DICT_4X4_50"),
    ((DICTIONARY, 50, 100), 'marker_id = 50: DICT_4X4_50 has 0 to 49'),
    ((DICTIONARY, -1, 100), 'marker_id = -1'),
    ((DICTIONARY, 0, 5), 'side_px = 5: must be at least 6'),
    ((DICTIONARY, 0, 100, 0), 'border_bits = 0')])
def test_impossible_markers_are_refused_by_name(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        aruco.draw_marker(*arguments)


@pytest.mark.parametrize('turn', [0.0, 0.2, 0.6])
def test_detected_corners_have_no_bias_inwards(turn: float) -> None:
    # Drawn eight times as large, so that a pixel holds what it sees of the marker.
    outside = []
    for side in (41.0, 57.3, 80.6):
        middle, cosine, sine = 100.0, np.cos(turn), np.sin(turn)
        true = middle + 0.5 * side * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ np.array(
            [[cosine, sine], [-sine, cosine]])
        large = np.full((1600, 1600), 220, dtype=np.uint8)
        drawn = aruco.draw_marker(DICTIONARY, 3, 600)
        warp = cv2.getPerspectiveTransform(
            np.array([[-0.5, -0.5], [599.5, -0.5], [599.5, 599.5], [-0.5, 599.5]], np.float32),
            (8.0 * (true + 0.5) - 0.5).astype(np.float32))
        cv2.warpPerspective(drawn, warp, (1600, 1600), dst=large,
                            borderMode=cv2.BORDER_TRANSPARENT)
        found = aruco.detect(cv2.resize(large, (200, 200), interpolation=cv2.INTER_AREA),
                             DICTIONARY)
        assert found.ids.tolist() == [3]
        # Half the diagonal, over the root of 2, is half the side.
        outside.append(np.linalg.norm(found.corners[0] - middle, axis=1).mean() / 2**0.5
                       - 0.5 * side)
    assert abs(np.mean(outside)) < 0.2


def test_outwards_is_along_the_sides_of_any_quadrilateral() -> None:
    slanted = np.array([[0.0, 0.0], [10.0, 2.0], [9.0, 12.0], [-1.0, 9.0]])
    moved = aruco.outwards(slanted[None], 0.7)[0]
    for k in range(4):
        a, b = slanted[k], slanted[(k + 1) % 4]
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        for corner in (moved[k], moved[(k + 1) % 4]):
            assert (corner - a) @ normal == pytest.approx(0.7)


def test_unknown_dictionary_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="dictionary = 'ARUCO'"):
        aruco.detect(np.zeros((50, 50), dtype=np.uint8), 'ARUCO')
