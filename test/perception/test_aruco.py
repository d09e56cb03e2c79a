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
from flock_follower.perception.corners import marker_corners


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
        found = aruco.detect(render(camera, {3: pose}, rays=3, seed=k, **trouble), DICTIONARY)
        assert found.ids.tolist() == [3]
        assert np.abs(found.corners[0] - true_corners(camera, pose)).max() < 2.0


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


@pytest.mark.parametrize(('arguments', 'message'), [
    (('DICT_9X9', 0, 100), "'DICT_9X9': must be one of .*DICT_4X4_50"),
    ((DICTIONARY, 50, 100), 'marker_id = 50: DICT_4X4_50 has 0 to 49'),
    ((DICTIONARY, -1, 100), 'marker_id = -1'),
    ((DICTIONARY, 0, 5), 'side_px = 5: must be at least 6')])
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
