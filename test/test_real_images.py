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

"""The detector on real photographs: ids and corners as their publishers' own tests have them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flock_follower.geometry import Transform
from flock_follower.perception import aruco
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import decode_compressed
from flock_follower.perception.neighbors import Neighbor, NeighborConfig
from flock_follower.perception.pose import measure, Prediction

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data' / 'real'
if not (DATA / 'truth.yaml').exists():
    pytest.skip('the real photographs (../shared/data/real) are not here',
                allow_module_level=True)
TRUTH: dict[str, Any] = yaml.safe_load((DATA / 'truth.yaml').read_text(encoding='utf-8'))
PHOTOGRAPHS = ['ubiq_tag01.png', 'ubiq_tag245.png']
GRID = 'moveit_aruco.png'


def camera_of(name: str) -> CameraModel:
    info = TRUTH[name]['camera']
    info = TRUTH[info] if isinstance(info, str) else info
    return CameraModel.from_calibration(
        info['k'], info['d'], info['distortion_model'], info['width'], info['height'])


def detected(name: str, camera: CameraModel | None) -> aruco.Detections:
    image = decode_compressed((DATA / name).read_bytes())
    return aruco.detect(image, TRUTH[name]['dictionary'], camera=camera)


@pytest.mark.parametrize('with_camera', [True, False])
@pytest.mark.parametrize('name', PHOTOGRAPHS)
def test_ids_and_corners_are_the_published_ones(name: str, with_camera: bool) -> None:
    found = detected(name, camera_of(name) if with_camera else None)
    markers = TRUTH[name]['markers']
    assert sorted(found.ids.tolist()) == sorted(markers)
    for marker_id, corners in zip(found.ids.tolist(), found.corners):
        np.testing.assert_allclose(corners, markers[marker_id], atol=1.5)


def test_a_marker_in_a_photograph_without_calibration_is_read() -> None:
    assert 403 in detected('ubiq_403.jpg', None).ids


def test_every_marker_of_a_real_grid_is_where_the_grid_says() -> None:
    camera, grid = camera_of(GRID), TRUTH[GRID]
    rows, columns = grid['grid']
    side, pitch = grid['marker_length_m'], grid['marker_length_m'] + grid['marker_separation_m']
    config = NeighborConfig(grid['dictionary'], tuple(
        Neighbor(f'marker{i}', i, side, Transform()) for i in range(columns * rows)))
    image = decode_compressed((DATA / GRID).read_bytes())
    found = {m.name: m for m in measure(image, camera, config, Prediction()).measurements}
    assert len(found) == columns * rows
    centres = np.array([found[f'marker{i}'].T_camera_marker.translation
                        for i in range(columns * rows)])
    assert max(m.rms for m in found.values()) < 0.5
    neighbours = np.linalg.norm(centres[1:] - centres[:-1], axis=1)
    in_a_row = np.arange(1, columns * rows) % columns != 0
    np.testing.assert_allclose(neighbours[in_a_row], pitch, rtol=0.1)  # markers of 21 to 30 px
    assert np.mean(neighbours[in_a_row]) == pytest.approx(pitch, rel=0.02)


@pytest.mark.parametrize(('name', 'ids'), [
    ('ubiq_aruco_images.bag', {100, 103, 106, 107, 110, 111, 112}),
    ('ubiq_aruco_marker.bag', {1})])
def test_markers_in_recordings_of_a_real_camera_are_read(name: str, ids: set[int]) -> None:
    pytest.importorskip('rosbags')
    from flock_follower.bags import deserialize, open_bag
    with open_bag(DATA / name) as bag:
        images = [deserialize(m.data, m.msgtype) for m in bag.messages()
                  if m.msgtype.endswith('CompressedImage')]
    assert images
    for image in images:
        found = aruco.detect(decode_compressed(image.data), 'DICT_5X5_1000')
        # A marker cut by the image's edge is read by some versions of OpenCV.
        assert ids <= set(found.ids.tolist()) <= ids | {47}
