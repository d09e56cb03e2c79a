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

"""The picture of the page: shapes lie where the camera sees them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flock_follower.geometry import quaternion_from_rpy, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.view.picture import draw_picture, outlines, WIDTH
from flock_follower.view.scene import ARROW, BOX, draw, ELLIPSOID, Shape, TEXT

CAMERA = CameraModel([[400.0, 0, 320.0], [0, 400.0, 240.0], [0, 0, 1]], [0] * 5, '', 640, 480)
WIDE = CameraModel([[800.0, 0, 640.5], [0, 800.0, 480.5], [0, 0, 1]], [0] * 5, '', 1280, 960)
GRAY = np.full((480, 640), 100, np.uint8)
HERE = Transform(np.eye(3), np.zeros(3))


def colored(jpeg: bytes) -> np.ndarray:
    """Return where a picture is not gray, (n, 2) as x, y."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)
    return np.argwhere(np.ptp(image, axis=2) > 60)[:, ::-1]


@pytest.mark.parametrize(('camera', 'image'), [
    (CAMERA, GRAY), (WIDE, np.full((960, 1280), 100, np.uint8))])
def test_box_is_drawn_where_camera_sees_it_at_any_size(
        camera: CameraModel, image: np.ndarray) -> None:
    box = Shape('leader', BOX, 'seen', (0.4, 0.4, 0.4), (0.5, 0.25, 2.0))
    jpeg = draw_picture(image, camera, HERE, [box])
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), 0).shape == (480, WIDTH)
    places = colored(jpeg)
    # Its faces are 1.8 and 2.2 m away.
    assert places.min(axis=0) == pytest.approx([320 + 400 * 0.3 / 2.2,
                                                240 + 400 * 0.05 / 2.2], abs=6)
    assert places.max(axis=0) == pytest.approx([320 + 400 * 0.7 / 1.8,
                                                240 + 400 * 0.45 / 1.8], abs=6)


def test_nothing_is_drawn_without_a_pose_or_behind_the_camera() -> None:
    box = Shape('leader', BOX, 'seen', (0.4, 0.4, 0.4), (0.0, 0.0, -2.0))
    label = Shape('leader name', TEXT, 'seen', (0.0, 0.0, 0.1), (0.0, 0.0, -2.0), text='leader')
    arrow = Shape('v', ARROW, 'seen', (0.1, 0.1, 0.1), points=[(0, 0, 2.0), (0, 0, -2.0)])
    ahead = box._replace(position=(0.0, 0.0, 2.0))
    for camera, pose, shapes in ((CAMERA, HERE, [box, label, arrow]), (None, HERE, [ahead]),
                                 (CAMERA, None, [ahead])):
        assert not len(colored(draw_picture(GRAY, camera, pose, shapes)))


def test_text_from_the_wire_is_drawn_inside_the_image() -> None:
    for text in ('leader', 'ä\n\x00' * 50):
        label = Shape('name', TEXT, 'seen', (0.0, 0.0, 0.1), (-1.6, -1.2, 2.0), text=text)
        jpeg = draw_picture(GRAY, CAMERA, HERE, [label])
        assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), 0).max() > 170  # brighter than GRAY


def test_a_line_of_pixels_keeps_one() -> None:
    jpeg = draw_picture(np.full((1, 4000), 100, np.uint8), None, None, [])
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), 0).shape == (1, WIDTH)


def test_image_of_other_size_than_calibration_is_refused() -> None:
    with pytest.raises(ValueError, match='camera_info is for 640x480'):
        draw_picture(np.zeros((10, 20), np.uint8), CAMERA, HERE, [])


def test_the_ellipses_of_an_ellipsoid_lie_on_it() -> None:
    size, center = np.array([0.2, 0.6, 1.0]), np.array([1.0, 2.0, 3.0])
    quaternion = quaternion_from_rpy(0.3, 0.2, 0.1)
    rings = outlines(Shape('c', ELLIPSOID, 'ellipsoid', tuple(size), center, quaternion))
    turn = Transform.from_quaternion(center, quaternion)
    assert len(rings) == 3
    for ring in rings:
        assert np.linalg.norm(turn.inverse().apply(ring) / (0.5 * size), axis=1) == (
            pytest.approx(np.ones(len(ring))))


def test_without_any_message_the_scene_is_empty() -> None:
    assert draw(None, [], None, {}) == []
