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
Detector and tracker on real photographs.

Ids and corners are as their publishers' own tests have them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flock_follower.geometry import Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception import markers as aruco
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import decode_compressed, GrayImage
from flock_follower.perception.markers import marker_corners, parse
from flock_follower.perception.tracker import camera_mounting, Sighting, Tracker

DATA = Path(__file__).resolve().parents[3] / 'shared' / 'data' / 'real'
if not (DATA / 'truth.yaml').exists():
    pytest.skip('the real photographs (../shared/data/real) are not here',
                allow_module_level=True)
TRUTH: dict[str, Any] = yaml.safe_load((DATA / 'truth.yaml').read_text(encoding='utf-8'))
PHOTOGRAPHS = ['ubiq_tag01.png', 'ubiq_tag245.png']
GRID = 'moveit_aruco.png'
T_BODY_CAMERA = camera_mounting([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
T_BODY_MARKER = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))


def camera_of(name: str) -> CameraModel:
    info = TRUTH[name]['camera']
    info = TRUTH[info] if isinstance(info, str) else info
    return CameraModel.from_calibration(
        info['k'], info['d'], info['distortion_model'], info['width'], info['height'])


class Scene:
    """A photograph, looked at again and again by a camera that says it has moved in between."""

    def __init__(self, name: str) -> None:
        truth = TRUTH[name]
        rows, columns = truth.get('grid', (0, 0))
        self.ids = sorted(truth.get('markers', range(rows * columns)))
        self.image: GrayImage = decode_compressed((DATA / name).read_bytes())
        self.camera = camera_of(name)
        # Each marker is the tail of a neighbor of its own; the camera looks ahead, level.
        config = parse({'dictionary': truth['dictionary'], 'neighbors': [
            {'name': f'marker{i}', 'marker_id': i, 'side_length': truth['marker_length_m'],
             'position': [0.0, 0.0, 0.0], 'rpy': [np.pi / 2, 0.0, -np.pi / 2]}
            for i in self.ids]})
        self.tracker = Tracker(config, T_BODY_CAMERA)
        self.stamp, self.position = 0.0, np.zeros(3)

    def look(self, T_odom_camera: Transform = T_BODY_CAMERA) -> Sighting:
        """Return what is seen from a pose of the camera, reached within 0.1 s."""
        pose = T_odom_camera @ T_BODY_CAMERA.inverse()
        self.stamp += 0.1
        velocity = 2.0 * (pose.translation - self.position) / 0.1
        self.tracker.feed_odometry(OdometrySample(
            self.stamp, pose.translation, pose.quaternion, velocity, np.zeros(3)))
        self.position = pose.translation
        return self.tracker.process_image(self.stamp, self.image, self.camera)


def places(sighting: Sighting) -> dict[str, Transform]:
    """Return T_camera_marker of every marker measured."""
    return {name: m.T_camera_body @ T_BODY_MARKER for name, m in sighting.measurements.items()}


@pytest.mark.parametrize('name', [*PHOTOGRAPHS, GRID])
def test_every_marker_is_found_where_the_photograph_shows_it(name: str) -> None:
    scene = Scene(name)
    found = places(scene.look())
    assert sorted(found) == sorted(f'marker{i}' for i in scene.ids)
    for marker_id, corners in TRUTH[name].get('markers', {}).items():
        seen = found[f'marker{marker_id}'].apply(marker_corners(TRUTH[name]['marker_length_m']))
        np.testing.assert_allclose(scene.camera.project(seen), corners, atol=1.5)


def test_every_marker_of_a_real_grid_is_where_the_grid_says() -> None:
    found, grid = places(Scene(GRID).look()), TRUTH[GRID]
    rows, columns = grid['grid']
    pitch = grid['marker_length_m'] + grid['marker_separation_m']
    centers = np.array([found[f'marker{i}'].translation for i in range(columns * rows)])
    neighbors = np.linalg.norm(centers[1:] - centers[:-1], axis=1)
    in_a_row = np.arange(1, columns * rows) % columns != 0
    np.testing.assert_allclose(neighbors[in_a_row], pitch, rtol=0.1)  # markers of 21 to 30 px
    assert np.mean(neighbors[in_a_row]) == pytest.approx(pitch, rel=0.02)


#: How far the expected place is off: across the line of sight (2,), in cells of the marker, along
#: it, as a share of the range, and how far it is turned (3,), rad.
ELSEWHERE = [
    # A little: it is tracked.
    ([0.0, 0.0], 0.03, [0.0, 0.0, 0.0], True), ([0.0, 0.0], -0.03, [0.0, 0.0, 0.0], True),
    ([0.25, 0.2], 0.0, [0.0, 0.0, 0.0], True), ([-0.2, 0.25], 0.02, [0.0, 0.0, 0.0], True),
    ([0.0, 0.0], 0.0, [0.06, 0.0, 0.0], True), ([0.0, 0.0], 0.0, [0.0, -0.06, 0.0], True),
    ([0.0, 0.0], 0.0, [0.0, 0.0, 0.04], True), ([0.1, -0.2], 0.02, [0.03, 0.04, -0.02], True),
    # Cells away: it is found again and not mistaken.
    ([1.0, 0.0], 0.0, [0.0, 0.0, 0.0], False), ([-1.3, 2.0], 0.05, [0.1, 0.0, 0.05], False),
    ([0.0, -3.0], -0.08, [0.0, 0.15, 0.0], False)]


@pytest.mark.parametrize(('across', 'along', 'turn', 'tracked'), ELSEWHERE)
@pytest.mark.parametrize('name', [*PHOTOGRAPHS, pytest.param(GRID, marks=pytest.mark.sweep)])
def test_a_marker_expected_elsewhere_is_found_at_its_pose(
        name: str, across: list[float], along: float, turn: list[float], tracked: bool) -> None:
    scene = Scene(name)
    scene.look()
    before = places(scene.look())
    cell = TRUTH[name]['marker_length_m'] / aruco.marker_cells(TRUTH[name]['dictionary'])
    for marker_id in scene.ids:
        key = f'marker{marker_id}'
        pose = before[key]
        shift = np.array([cell * across[0], cell * across[1], along * pose.translation[2]])
        expected = Transform(rotation_vector_to_matrix(turn) @ pose.rotation,
                             pose.translation + shift)
        scene = Scene(name)
        scene.look()  # one sighting: the filter does not know the marker's speed, nor rejects one
        sighting = scene.look(T_BODY_CAMERA @ pose @ expected.inverse())
        assert not tracked or sighting.stages.get(key) == 'track', f'{key}: {sighting.rejections}'
        assert_same(name, places(sighting)[key], pose)


def assert_same(name: str, pose: Transform, other: Transform) -> None:
    """Check that two poses show the marker in the same place: that is all a photograph tells."""
    corners = marker_corners(TRUTH[name]['marker_length_m'])
    shown = [camera_of(name).project(p.apply(corners)) for p in (pose, other)]
    assert np.abs(shown[0] - shown[1]).max() < 0.5  # px
    turned = matrix_to_rotation_vector(pose.rotation @ other.rotation.T)
    assert np.linalg.norm(turned) < np.deg2rad(5.0)


@pytest.mark.parametrize('name', PHOTOGRAPHS)
@pytest.mark.parametrize(('across', 'down'), [(30, 0), (0, 30), (30, 30), (45, -10)])
def test_photograph_smeared_by_a_cell_shows_markers_in_place(
        name: str, across: int, down: int) -> None:
    scene = Scene(name)
    scene.look()
    before = places(scene.look())
    light = (scene.image / 255.0)**2.2  # cells of 29 to 33 px
    steps = np.linspace(-0.5, 0.5, 31)
    smeared = np.mean([np.roll(light, (round(t * down), round(t * across)), axis=(0, 1))
                       for t in steps], axis=0)
    scene.image = np.rint(255.0 * smeared**(1.0 / 2.2)).astype(np.uint8)
    after = places(scene.look())
    assert sorted(after) == sorted(before)
    for key, pose in before.items():
        assert after[key].translation[2] == pytest.approx(pose.translation[2], rel=0.025)


@pytest.mark.parametrize('name', PHOTOGRAPHS)
@pytest.mark.parametrize('direction', [0.3, 1.5, 2.5, 4.0])
def test_a_shadow_across_a_photograph_changes_nothing(name: str, direction: float) -> None:
    scene = Scene(name)
    scene.look()
    before, light = places(scene.look()), (scene.image / 255.0)**2.2
    rows, columns = np.indices(light.shape)
    for key, pose in before.items():
        u, v = scene.camera.project(pose.translation[None])[0]
        dark = (columns - u) * np.cos(direction) + (rows - v) * np.sin(direction) > 20.0
        scene.image = np.rint(255.0 * (np.where(dark, 0.1, 1.0) * light)**(1.0 / 2.2)).astype(
            np.uint8)
        sighting = scene.look()
        assert_same(name, places(sighting)[key], pose)
        assert sighting.stages[key] == 'track'
