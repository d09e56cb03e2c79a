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

"""The rendered camera against OpenCV's projection, perception and the statistics of a sensor."""

import cv2
from marker_images import seen_corners
import numpy as np
import pytest

from flock_desk.camera.lens import Camera
from flock_desk.camera.renderer import (
    leader,
    marker_print,
    Renderer,
    second_print,
    Sensor,
    T_BODY_MARKER,
)
from flock_follower.geometry import R_FLU_OPTICAL, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.markers import detect

FISHEYE = Camera(focal_x=372.4, focal_y=372.1, center_x=318.8, center_y=241.7,
                 model='equidistant', distortion=(-0.018, 0.012, -0.009, 0.002))
#: As wide as they come: its corners are beyond the image circle.
WIDE = Camera(212, 200, 71.5, 71.5, 105.3, 100.9, 'equidistant',
              (-0.0076, 0.0450, -0.0426, 0.0076))
STRAIGHT = Camera(distortion=(0.0,) * 5)
SIDE = 0.16
#: A marker without code, and its quiet zone.
BLACK = marker_print(np.pad(np.zeros((6, 6)), 1, constant_values=1.0), SIDE / 6)
#: The camera is at the origin and looks along +x.
T_WORLD_OPTICAL = Transform(R_FLU_OPTICAL)
POSES = {
    'ahead': Transform(np.eye(3), np.array([1.4, 0.0, 0.0])),
    'turned': Transform(rotation_vector_to_matrix([0.1, -0.15, 0.6]),
                        np.array([1.7, 0.25, -0.12])),
    'in the corner': Transform(rotation_vector_to_matrix([0.0, 0.1, 0.3]),
                               np.array([1.6, 0.5, 0.32])),
    'far': Transform(np.eye(3), np.array([2.4, -0.5, 0.25])),
}


def project(camera, points):
    """Return pixels (N, 2) of points (N, 3) in the optical frame, by OpenCV."""
    matrix = np.array([[camera.focal_x, 0, camera.center_x],
                       [0, camera.focal_y, camera.center_y], [0, 0, 1.0]])
    projection = cv2.fisheye.projectPoints if camera.model == 'equidistant' else cv2.projectPoints
    pixels, _ = projection(np.reshape(points, (-1, 1, 3)), np.zeros(3), np.zeros(3), matrix,
                           np.array(camera.distortion))
    return pixels.reshape(-1, 2)


def model_of(camera):
    return CameraModel(np.array([[camera.focal_x, 0, camera.center_x],
                                 [0, camera.focal_y, camera.center_y], [0, 0, 1]]),
                       camera.distortion, camera.model, camera.width, camera.height)


def corners_at(pose):
    """Return the marker's corners (4, 3) in the optical frame."""
    h = SIDE / 2
    return (T_WORLD_OPTICAL.inverse() @ pose @ T_BODY_MARKER).apply(
        [[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])


@pytest.fixture(scope='module')
def live():
    """Give the camera of flights in real time."""
    return Renderer(Camera(), Sensor(sub_poses=2), fineness=2)


@pytest.mark.parametrize('camera', [Camera(), FISHEYE, WIDE],
                         ids=['plumb_bob', 'equidistant', 'very wide'])
def test_points_match_opencv_projection_rays_are_its_inverse(camera):
    u, v = np.meshgrid(np.linspace(50, 160, 33), np.linspace(50, 150, 25))
    rays = camera.rays(u, v)
    pixels = project(camera, np.stack([*rays, np.ones_like(u)], axis=-1))
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-5)
    x, y, z = np.random.default_rng(2).uniform([-0.6, -0.45, 0.5], [0.6, 0.45, 3.0], (200, 3)).T
    points = np.stack([x * z, y * z, z], axis=1)
    np.testing.assert_allclose(camera.project(points), project(camera, points), atol=1e-9)


def test_point_far_outside_view_stays_outside_any_lens():
    folding = Camera(distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))  # r (1 - 0.3 r^2) falls from 1.05 on
    for aside in (-10.0, -2.0, -1.0, 1.0, 2.0, 10.0):
        u = folding.project(np.array([[aside, 0.0, 1.0]]))[0, 0]
        assert not 0.0 < u < folding.width - 1.0


def test_rays_of_a_very_wide_lens_end_at_its_image_circle():
    x, y = WIDE.rays(*np.meshgrid(np.arange(212.0), np.arange(200.0)))
    angle = np.arctan(np.hypot(x, y))
    assert angle.max() == pytest.approx(1.45, abs=1e-6)  # 83 degrees, in the corners
    image = Renderer(WIDE, Sensor(vignetting=0.15)).image(0, [T_WORLD_OPTICAL], [POSES['ahead']])
    assert image[:9, :9].mean() < 40 and image[70:130, 70:140].mean() > 90


def test_light_becomes_pixel_by_vignetting_gamma_seeded_noise():
    sensor = Sensor(gamma=1.0, vignetting=0.0, gain=1.0, full_well=2000.0, read_noise=20.0)
    renderer = Renderer(STRAIGHT, sensor)
    for radiance in (0.1, 0.5):
        gray = np.full((480, 640), radiance, dtype=np.float32)
        image = renderer.develop(3, gray) / 255.0
        assert image.mean() == pytest.approx(radiance, abs=0.001)
        expected = radiance / 2000.0 + (20.0 / 2000.0)**2 + 1.0 / 12.0 / 255.0**2
        assert image.var() == pytest.approx(expected, rel=0.02)
    again = Renderer(STRAIGHT, sensor)
    np.testing.assert_array_equal(renderer.develop(7, gray), again.develop(7, gray))
    assert (renderer.develop(7, gray) != renderer.develop(8, gray)).any()
    image = Renderer(STRAIGHT, Sensor(gain=1.0, full_well=1e12, read_noise=0.0)).develop(0, gray)
    x, y = STRAIGHT.rays(np.array(0.0), np.array(0.0))
    light = 0.5 / (1 + 0.35 * (x**2 + y**2))**2  # vignetting in the corner
    assert image[237, 322] == round(255 * 0.5**(1 / 2.2))
    assert image[0, 0] == pytest.approx(255 * light**(1 / 2.2), abs=1)


def test_surroundings_move_against_camera_turn_without_seam(live):
    def turned(heading):
        return live.radiance([Transform(rotation_vector_to_matrix([0.0, 0.0, heading]))
                              @ T_WORLD_OPTICAL], [])
    step = 20.0 / 611.3  # rad: 20 px in the middle of the image
    for heading in (0.0, np.pi - 0.01):
        before, after = (turned(h)[200:280, 200:440] for h in (heading, heading + step))
        assert np.corrcoef(before[:, :-20].ravel(), after[:, 20:].ravel())[0, 1] > 0.97
    np.testing.assert_allclose(turned(np.pi - 1e-7), turned(-np.pi + 1e-7), atol=1e-3)


def test_poses_of_exposure_spread_about_stamp_weigh_alike(live):
    times = Sensor(exposure=0.02, sub_poses=10).times(5.0)
    assert [times.mean(), np.ptp(times)] == pytest.approx([5.0, 0.018])
    poses = [POSES['ahead'], POSES['far']]
    both = live.radiance([T_WORLD_OPTICAL] * 2, poses)
    np.testing.assert_allclose(both, np.mean(
        [live.radiance([T_WORLD_OPTICAL], [pose]) for pose in poses], axis=0), atol=1e-6)


@pytest.mark.parametrize('pose', POSES.values(), ids=POSES)
def test_perception_finds_the_marker_where_it_is(live, pose):
    image = live.image(3, [T_WORLD_OPTICAL] * 2, [pose] * 2)
    model = model_of(Camera())
    off = seen_corners(image, model, SIDE) - model.project(corners_at(pose))
    assert np.linalg.norm(off, axis=1).max() < 0.3


def test_leader_is_seen_to_edge_of_view_and_not_behind_camera(live):
    empty = live.radiance([T_WORLD_OPTICAL], [])
    for place, shown in (((1.6, 0.75, 0.0), True), ((1.6, -0.75, 0.0), True),
                         ((1.6, 0.0, 0.55), True), ((1.6, 0.0, -0.55), True),
                         ((-1.5, 0.0, 0.0), False), ((0.5, 2.5, 0.0), False),
                         ((0.5, -2.5, 0.0), False)):
        there = Transform(translation=np.array(place))
        changed = np.abs(live.radiance([T_WORLD_OPTICAL], [there]) - empty) > 0.05
        edges = changed[:, 0], changed[:, -1], changed[0], changed[-1]
        assert any(edge.any() for edge in edges) == changed.any() == shown


def test_only_tail_shows_marker_and_nearer_body_hides_it(live):
    away = Transform(rotation_vector_to_matrix([0.0, 0.0, np.pi]), np.array([1.4, 0.0, 0.0]))
    hiding = Renderer(Camera(), Sensor(), prints=[(leader(BLACK), Transform(
        translation=np.array([1.0, 0.0, 0.0])))])
    for renderer, leaders in ((live, [away]), (hiding, [POSES['ahead']]), (live, [])):
        image = renderer.image(0, [T_WORLD_OPTICAL], leaders)
        assert not len(detect(image, 'DICT_4X4_50').ids)


@pytest.mark.parametrize('beyond', [True, False])
def test_a_second_print_is_shown_where_it_stands(beyond):
    place = np.array([3.0, 1.1, 0.1]) if beyond else np.array([1.2, 0.25, 0.0])
    leader_pose = POSES['ahead'] if beyond else POSES['far']
    body = Transform(translation=place)
    renderer = Renderer(Camera(), Sensor(), fineness=2, prints=[([second_print()], body)])
    found = detect(renderer.image(0, [T_WORLD_OPTICAL], [leader_pose]), 'DICT_4X4_50')
    assert found.ids.tolist() == [0, 0]
    middle = Camera().project((T_WORLD_OPTICAL.inverse() @ body @ T_BODY_MARKER)
                              .translation[None])[0]
    assert np.linalg.norm(found.corners.mean(axis=1) - middle, axis=1).min() < 1.0
