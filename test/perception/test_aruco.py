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
from marker_images import DICTIONARY
import numpy as np
import pytest

from flock_follower.parameters.neighbors_file import DICTIONARY_SIZES
from flock_follower.perception import markers as aruco


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


def test_each_opencv_dictionary_is_known_by_size_without_opencv():
    for dictionary in aruco.dictionary_names():
        assert DICTIONARY_SIZES[dictionary] == aruco.dictionary_size(dictionary)


@pytest.mark.parametrize(('name', 'cells'), [
    ('DICT_4X4_50', 1), ('DICT_5X5_100', 3), ('DICT_6X6_250', 5), ('DICT_APRILTAG_16h5', 2),
    ('DICT_APRILTAG_25h9', 4), ('DICT_APRILTAG_36h11', 5), ('DICT_ARUCO_ORIGINAL', 0),
    *([('DICT_ARUCO_MIP_36h12', 5)] if hasattr(cv2.aruco, 'DICT_ARUCO_MIP_36h12') else [])])
def test_correctable_cells_follow_from_codes_in_any_opencv(name: str, cells: int) -> None:
    """OpenCV before 5 has 0 for AprilTags, and 12 for the last."""
    assert aruco.correctable_cells(name) == cells
