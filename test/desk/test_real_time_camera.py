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

"""The camera that renders in real time: against projection, cast rays, and perception."""

import cv2
from marker_images import seen_corners
import numpy as np
import pytest
from test_renderer import corners_from_edges, located_edges

from flock_desk.camera.lens import Camera, Rays
from flock_desk.camera.panorama import Panorama
from flock_desk.camera.renderer import Light, Renderer, Sensor
from flock_desk.camera.rig import second_print
from flock_desk.camera.scene import (
    field_with_buildings,
    leader,
    Scenery,
    T_BODY_MARKER,
)
from flock_follower.geometry import R_FLU_OPTICAL, rotation_vector_to_matrix, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.markers import detect, draw_marker

pytestmark = pytest.mark.slow
FISHEYE = Camera(focal_x=372.4, focal_y=372.1, centre_x=318.8, centre_y=241.7,
                 model='equidistant', distortion=(-0.018, 0.012, -0.009, 0.002))
SIDE = 0.16
BLACK = np.pad(np.zeros((6, 6)), 1, constant_values=1.0)  # a marker without code, quiet zone
T_WORLD_OPTICAL = Transform(R_FLU_OPTICAL)
# Poses of a leader that is seen from the origin, looking along +x.
POSES = {
    'ahead': Transform(np.eye(3), np.array([1.4, 0.0, 0.0])),
    'turned': Transform(rotation_vector_to_matrix([0.1, -0.15, 0.6]),
                        np.array([1.7, 0.25, -0.12])),
    'in the corner': Transform(rotation_vector_to_matrix([0.0, 0.1, 0.3]),
                               np.array([1.6, 0.5, 0.32])),
    'far': Transform(np.eye(3), np.array([2.4, -0.5, 0.25])),
}
# Nothing saturates, and there is next to no noise.
CLEAN = Sensor(gain=1.0, full_well=1e7, read_noise=1.0, sub_poses=2, vignetting=0.0)


def light_in(image):
    """Return the light (height, width) that an image's pixels stand for."""
    return ((image / 255.0) ** 2.2).astype(np.float32)


def quick(camera, sensor, scenery, surfaces, viewpoint):
    return Renderer(camera, sensor, scenery, surfaces, fineness=2, viewpoint=viewpoint)


def printed():
    cells = np.ones((8, 8))
    cells[1:7, 1:7] = draw_marker('DICT_4X4_50', 0, 6) > 127
    return leader(cells, SIDE)


@pytest.fixture(scope='module')
def outside():
    """Give a camera in the field, behind its leader."""
    return quick(Camera(), Sensor(sub_poses=2), field_with_buildings(), printed(),
                 np.array([0.0, 0.0, 1.5]))


def above_ground(pose):
    return Transform(pose.rotation, pose.translation + np.array([0.0, 0.0, 1.5]))


@pytest.mark.parametrize('pose', POSES.values(), ids=POSES)
@pytest.mark.parametrize('camera', [Camera(), FISHEYE], ids=['plumb_bob', 'equidistant'])
def test_the_markers_corners_are_where_the_camera_model_projects_them(camera, pose):
    live = quick(camera, CLEAN, Scenery([]), leader(BLACK, SIDE), np.zeros(3))
    image = light_in(live.image(0, [T_WORLD_OPTICAL] * 2, [pose] * 2))
    T_optical_marker = T_WORLD_OPTICAL.inverse() @ pose @ T_BODY_MARKER
    seen, true = located_edges(image, camera, T_optical_marker)
    assert np.abs(np.linalg.norm(seen - true, axis=2)).mean() < 0.03  # px

    h = SIDE / 2
    corners = T_optical_marker.apply([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    matrix = np.array([[camera.focal_x, 0, camera.centre_x],
                       [0, camera.focal_y, camera.centre_y], [0, 0, 1]])
    model = CameraModel(matrix, camera.distortion, camera.model, camera.width, camera.height)
    rays = np.append(corners_from_edges(seen, camera), np.ones((4, 1)), axis=1)
    error = np.linalg.norm(model.project(rays) - model.project(corners), axis=1)
    assert error.max() < 0.1  # px


def test_a_turn_during_the_exposure_smears_edges_about_the_stamp():
    pose, length = POSES['ahead'], 6.0  # px
    camera = Camera(distortion=(0.0,) * 5)
    live = quick(camera, CLEAN, Scenery([]), leader(BLACK, SIDE), np.zeros(3))
    angles = length / camera.focal_x * np.array([-0.25, 0.25])
    turning = [Transform(rotation_vector_to_matrix([0.0, 0.0, a])) @ T_WORLD_OPTICAL
               for a in angles]
    profiles = []
    for cameras in ([T_WORLD_OPTICAL] * 2, turning):
        row = light_in(live.image(0, cameras, [pose] * 2))[200:274].mean(axis=0)
        # From the black border to the quiet zone on the marker's right.
        change = np.clip(np.diff(row[350:372]), 0.0, None)
        change /= change.sum()
        centre = change @ np.arange(len(change))
        profiles.append((centre, change @ (np.arange(len(change)) - centre) ** 2))
    (still, sharp), (moving, smeared) = profiles
    assert moving == pytest.approx(still, abs=0.1)
    assert smeared - sharp == pytest.approx((length / 4) ** 2, rel=0.15)  # two poses, 3 px apart


def test_the_surroundings_are_those_that_rays_show_from_the_same_place(outside):
    world, camera = field_with_buildings(), Camera()
    cast = Renderer(camera, Sensor(), world)
    for heading, pitch in ((0.3, 0.0), (3.0, 0.2), (-3.0, -0.2)):
        pose = Transform(rotation_vector_to_matrix([0.0, 0.0, heading])
                         @ rotation_vector_to_matrix([0.0, pitch, 0.0]) @ R_FLU_OPTICAL,
                         np.array([0.0, 0.0, 1.5]))
        live = outside.image(0, [pose] * 2, []).astype(float)
        true = cast.image(0, [pose] * 4, [Transform()] * 4).astype(float)
        # It is out of focus: compared are means of 8 x 8 px.
        blocks = [m.reshape(60, 8, 80, 8).mean(axis=(1, 3)) for m in (live, true)]
        assert np.abs(blocks[0] - blocks[1]).mean() < 2.5
        assert np.corrcoef(blocks[0].ravel(), blocks[1].ravel())[0, 1] > 0.99


def test_the_panorama_has_no_seam():
    panorama = Panorama.build(field_with_buildings(), np.array([0.0, 0.0, 1.5]), focal=100.0)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.4, 0.4, 17))
    for heading in (0.0, np.pi, -np.pi / 2, np.pi / 4):
        views = []
        for angle in (heading - 1e-6, heading + 1e-6):
            rotation = rotation_vector_to_matrix([0.0, 0.0, angle]) @ R_FLU_OPTICAL
            columns, rows = panorama.places(x, y, rotation)
            assert columns.min() >= 0 and columns.max() < panorama.values.shape[1]
            views.append(cv2.remap(panorama.values, columns, rows, cv2.INTER_LINEAR))
        assert np.abs(views[0] - views[1]).mean() < 0.01


@pytest.mark.parametrize('pose', POSES.values(), ids=POSES)
def test_perception_finds_the_marker_where_it_is(outside, pose):
    image = outside.image(3, [above_ground(T_WORLD_OPTICAL)] * 2, [above_ground(pose)] * 2)
    h = SIDE / 2
    corners = (T_WORLD_OPTICAL.inverse() @ pose @ T_BODY_MARKER).apply(
        [[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    camera = outside.camera
    model = CameraModel(np.array([[camera.focal_x, 0, camera.centre_x],
                                  [0, camera.focal_y, camera.centre_y], [0, 0, 1]]),
                        camera.distortion, camera.model, camera.width, camera.height)
    off = seen_corners(image, model, SIDE) - model.project(corners)
    assert np.linalg.norm(off, axis=1).max() < 0.3


def test_there_is_no_marker_without_the_leader_nor_in_glare_or_shadow(outside):
    camera = [above_ground(T_WORLD_OPTICAL)] * 2
    body = [above_ground(POSES['ahead'])] * 2
    for leaders, light in (([], None), (body, Light(veil=1.2)), (body, Light(gain=0.002))):
        assert not len(detect(outside.image(0, camera, leaders, light), 'DICT_4X4_50').ids)
    for gain in (0.6, 1.4):  # clouds
        assert len(detect(outside.image(0, camera, body, Light(gain)), 'DICT_4X4_50').ids)


def test_a_leader_behind_or_beside_the_view_changes_nothing(outside):
    camera = [above_ground(T_WORLD_OPTICAL)] * 2
    empty = outside.image(0, camera, [])
    for x, y in ((-1.5, 0.0), (0.5, 2.5), (0.5, -2.5)):
        there = Transform(translation=np.array([x, y, 1.5]))
        np.testing.assert_array_equal(outside.image(0, camera, [there] * 2), empty)


def test_a_leader_half_out_of_the_view_is_drawn_up_to_the_edge(outside):
    camera = [above_ground(T_WORLD_OPTICAL)] * 2
    empty = outside.image(0, camera, []).astype(int)
    for y, z in ((0.75, 1.5), (-0.75, 1.5), (0.0, 2.05), (0.0, 0.95)):
        there = Transform(translation=np.array([1.6, y, z]))
        changed = np.abs(outside.image(0, camera, [there] * 2) - empty) > 20
        edges = changed[:, 0], changed[:, -1], changed[0], changed[-1]
        assert any(edge.any() for edge in edges)


def test_the_noise_is_the_sensors_and_repeats_with_the_index():
    sensor = Sensor(sub_poses=1)
    live = quick(Camera(), sensor, Scenery([], haze=0.3), [], np.zeros(3))
    images = [live.image(k, [T_WORLD_OPTICAL], []) for k in range(12)]
    np.testing.assert_array_equal(live.image(3, [T_WORLD_OPTICAL], []), images[3])
    assert np.mean(images[0] != images[1]) > 0.5
    signal = light_in(np.stack(images).astype(float))[:, 200:280, 280:360]
    rays = Rays(Camera())
    fall = (1 + 0.35 * (rays.x ** 2 + rays.y ** 2))[200:280, 280:360] ** 2
    light = 0.3 * sensor.gain / fall
    assert signal.mean() == pytest.approx(light.mean(), rel=0.02)
    expected = np.sqrt(light / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2)
    # One value in 255 is coarse: its rounding adds to the noise.
    rounding = 2.2 * light * (light ** (-1 / 2.2)) / 255.0 / np.sqrt(12.0)
    assert np.std(signal - light, axis=0).mean() == pytest.approx(
        np.sqrt(expected ** 2 + rounding ** 2).mean(), rel=0.1)


def test_two_printed_surfaces_are_refused():
    with pytest.raises(ValueError, match='printed'):
        quick(Camera(), CLEAN, Scenery([]), [*printed(), *printed()], np.zeros(3))


@pytest.mark.parametrize('beyond', [True, False])
def test_a_second_print_is_shown_where_it_stands(beyond):
    place = np.array([3.0, 1.1, 0.1]) if beyond else np.array([1.2, 0.25, 0.0])
    leader_pose = POSES['ahead'] if beyond else POSES['far']
    camera = Camera()
    body = Transform(np.eye(3), place)
    renderer = Renderer(camera, CLEAN, Scenery([]), printed(), fineness=2,
                        viewpoint=np.zeros(3), prints=[second_print().moved(body)])
    for leaders in ([leader_pose, leader_pose], []):
        image = renderer.image(0, [T_WORLD_OPTICAL, T_WORLD_OPTICAL], leaders)
        found = detect(image, 'DICT_4X4_50')
        assert found.ids.tolist() == [0] * (2 if leaders else 1)
        middle = camera.project((T_WORLD_OPTICAL.inverse() @ body @ T_BODY_MARKER)
                                .translation[None])[0]
        assert np.linalg.norm(found.corners.mean(axis=1) - middle, axis=1).min() < 1.0
