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

"""The rendered camera against OpenCV's projection, cast rays and the statistics of a sensor."""

import cv2
import numpy as np
import pytest

from flock_desk.camera.lens import Camera
from flock_desk.camera.renderer import Renderer, Sensor
from flock_desk.camera.scene import (
    field_with_buildings,
    leader,
    plain,
    Scenery,
    Surface,
    T_BODY_MARKER,
)
from flock_follower.geometry import R_FLU_OPTICAL, rotation_vector_to_matrix, Transform

pytestmark = pytest.mark.slow
FISHEYE = Camera(focal_x=372.4, focal_y=372.1, centre_x=318.8, centre_y=241.7,
                 model='equidistant', distortion=(-0.018, 0.012, -0.009, 0.002))
#: As wide as they come: its corners are beyond the image circle.
WIDE = Camera(212, 200, 71.5, 71.5, 105.3, 100.9, 'equidistant',
              (-0.0076, 0.0450, -0.0426, 0.0076))
SMALL = Camera(width=160, height=120, focal_x=150.0, focal_y=150.0, centre_x=80.0, centre_y=60.0)
BLACK = np.pad(np.zeros((6, 6)), 1, constant_values=1.0)  # a marker without code, quiet zone
SIDE = 0.16
#: Camera at the origin looking along +x; the leader's tail ahead, turned and off the axis.
T_WORLD_OPTICAL = Transform(R_FLU_OPTICAL)
TURNED = Transform(rotation_vector_to_matrix([0.1, -0.15, 0.6]), np.array([1.7, 0.25, -0.12]))
AHEAD = Transform(np.eye(3), np.array([1.4, 0.0, 0.0]))


def project(camera, points):
    """Return pixels (N, 2) of points (N, 3) in the optical frame, by OpenCV."""
    matrix = np.array([[camera.focal_x, 0, camera.centre_x],
                       [0, camera.focal_y, camera.centre_y], [0, 0, 1.0]])
    projection = cv2.fisheye.projectPoints if camera.model == 'equidistant' else cv2.projectPoints
    pixels, _ = projection(np.reshape(points, (-1, 1, 3)), np.zeros(3), np.zeros(3), matrix,
                           np.array(camera.distortion))
    return pixels.reshape(-1, 2)


def look(image, points):
    """Return the image (N,), linearly interpolated at points (N, 2)."""
    x, y = points.astype(np.float32).T
    return cv2.remap(image, x[None], y[None], cv2.INTER_LINEAR)[0]


def located_edges(image, camera, T_optical_marker):
    """
    Return where the marker's four edges are seen, (4, n, 2), and where they project to.

    Along a profile from black to white the edge is where the light missing equals a step's.
    """
    h = SIDE / 2
    corners = np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    steps = np.linspace(-3.0, 3.0, 121)
    seen, true = [], []
    for start, end in zip(corners, np.roll(corners, -1, axis=0)):
        along = np.linspace(0.12, 0.88, 40)[:, None]
        outwards = (start + end) / np.linalg.norm(start + end)
        edge = start + along * (end - start)
        at = project(camera, T_optical_marker.apply(edge))
        normal = project(camera, T_optical_marker.apply(edge + 1e-4 * outwards)) - at
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        for pixel, n in zip(at, normal):
            profile = look(image, pixel + steps[:, None] * n)
            black, white = profile[:12].mean(), profile[-12:].mean()
            missing = (white - profile) / (white - black)
            offset = np.sum(missing[1:] + missing[:-1]) * (steps[1] - steps[0]) / 2 - 3.0
            seen.append(pixel + offset * n)
            true.append(pixel)
    return np.reshape(seen, (4, 40, 2)), np.reshape(true, (4, 40, 2))


def corners_from_edges(edges, camera):
    """Return the corners (4, 2), normalised coordinates, where fitted edges cross."""
    matrix = np.array([[camera.focal_x, 0, camera.centre_x],
                       [0, camera.focal_y, camera.centre_y], [0, 0, 1.0]])
    undistort = (cv2.fisheye.undistortPoints if camera.model == 'equidistant'
                 else cv2.undistortPoints)
    lines = []
    for edge in edges:
        points = undistort(edge.reshape(-1, 1, 2), matrix, np.array(camera.distortion))
        points = points.reshape(-1, 2)
        n = np.linalg.svd(points - points.mean(axis=0))[2][1]
        lines.append(np.append(n, -n @ points.mean(axis=0)))
    crossings = [np.cross(lines[k - 1], lines[k]) for k in range(4)]
    return np.array([c[:2] / c[2] for c in crossings])


@pytest.mark.parametrize('camera', [Camera(), FISHEYE], ids=['plumb_bob', 'equidistant'])
def test_rays_are_the_inverse_of_opencvs_projection(camera):
    u, v = np.meshgrid(np.linspace(0, 639, 33), np.linspace(0, 479, 25))
    x, y = camera.rays(u, v)
    pixels = project(camera, np.stack([x, y, np.ones_like(x)], axis=-1))
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-5)


@pytest.mark.parametrize('camera', [Camera(), FISHEYE, WIDE],
                         ids=['plumb_bob', 'equidistant', 'very wide'])
def test_points_are_seen_where_opencv_projects_them(camera):
    x, y, z = np.random.default_rng(2).uniform([-0.6, -0.45, 0.5], [0.6, 0.45, 3.0], (200, 3)).T
    points = np.stack([x * z, y * z, z], axis=1)
    np.testing.assert_allclose(camera.project(points), project(camera, points), atol=1e-9)


def test_a_point_far_beside_the_view_stays_beside_it_however_the_lens_folds():
    folding = Camera(distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))  # r (1 - 0.3 r^2) falls from 1.05 on
    for aside in (1.0, 2.0, 10.0):
        for sign in (-1.0, 1.0):
            u = folding.project(np.array([[sign * aside, 0.0, 1.0]]))[0, 0]
            assert not 0.0 < u < folding.width - 1.0


def test_rays_of_a_very_wide_lens_end_at_its_image_circle():
    u, v = np.meshgrid(np.arange(212.0), np.arange(200.0))
    x, y = WIDE.rays(u, v)
    angle = np.arctan(np.hypot(x, y))
    assert angle.max() == pytest.approx(1.45, abs=1e-6)  # 83 degrees, in the corners
    inside = angle < 1.44
    assert 0.6 < inside.mean() < 0.9
    pixels = project(WIDE, np.stack([x, y, np.ones_like(x)], axis=-1)[inside])
    np.testing.assert_allclose(pixels, np.stack([u[inside], v[inside]], axis=1), atol=1e-5)


def test_a_very_wide_lens_shows_the_field_and_black_corners():
    body = Transform(np.eye(3), np.array([0.0, 0.0, 1.6]))
    renderer = Renderer(WIDE, Sensor(vignetting=0.15), field_with_buildings(), leader(BLACK, SIDE))
    image = renderer.image(0, [body @ T_WORLD_OPTICAL] * 2, [body @ AHEAD] * 2)
    assert max(image[:9, :9].mean(), image[-9:, -9:].mean()) < 40
    assert image[70:130, 70:140].mean() > 90
    assert image[99:104, 103:108].mean() < 65  # the marker


@pytest.mark.parametrize('camera', [Camera(), FISHEYE], ids=['plumb_bob', 'equidistant'])
@pytest.mark.parametrize('pose', [AHEAD, TURNED], ids=['ahead', 'turned'])
def test_the_markers_corners_are_where_the_truth_projects(camera, pose):
    renderer = Renderer(camera, Sensor(), Scenery([]), leader(BLACK, SIDE))
    image = renderer.radiance([T_WORLD_OPTICAL] * 4, [pose] * 4)
    T_optical_marker = T_WORLD_OPTICAL.inverse() @ pose @ T_BODY_MARKER
    seen, true = located_edges(image, camera, T_optical_marker)
    assert np.abs(np.linalg.norm(seen - true, axis=2)).mean() < 0.02  # px
    h = SIDE / 2
    q = T_optical_marker.apply([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    error = camera.focal_x * (corners_from_edges(seen, camera) - q[:, :2] / q[:, 2:])
    assert np.linalg.norm(error, axis=1).max() < 0.02  # px


@pytest.mark.parametrize('part', ['leader', 'world'])
def test_a_turn_during_the_exposure_smears_edges_by_its_angle_about_the_stamp(part):
    camera, count, length = Camera(distortion=(0.0,) * 5), 12, 5.0  # px
    body = leader(BLACK, SIDE)
    world = Scenery([s.moved(AHEAD) for s in body] if part == 'world' else [], visibility=1e9)
    renderer = Renderer(camera, Sensor(), world, body if part == 'leader' else ())
    angles = length / camera.focal_x * ((np.arange(count) + 0.5) / count - 0.5)
    moments = []
    for turns in (np.zeros(count), angles):
        cameras = [Transform(rotation_vector_to_matrix([0.0, 0.0, a])) @ T_WORLD_OPTICAL
                   for a in turns]
        rows = renderer.radiance(cameras, [AHEAD] * count)[210:264, 352:374]
        profile = rows.mean(axis=0)  # across one vertical edge, from black to white
        gradient = np.diff(profile) / (profile[-1] - profile[0])
        at = np.arange(len(gradient)) + 0.5
        mean = np.sum(gradient * at)
        moments.append((mean, np.sum(gradient * (at - mean)**2)))
    assert moments[1][0] == pytest.approx(moments[0][0], abs=0.03)
    # The variance of a uniform smear, less what 12 poses leave out, that of the pixels' width,
    # and that of a difference between two of them.
    expected = length**2 / 12 * (1 - count**-2) + 1 / 12 + 1 / 12
    assert moments[1][1] == pytest.approx(expected, rel=0.03)


def test_noise_has_the_variance_of_shot_and_read_noise():
    sensor = Sensor(gamma=1.0, vignetting=0.0, gain=1.0, full_well=2000.0, read_noise=20.0)
    renderer = Renderer(Camera(distortion=(0.0,) * 5), sensor, Scenery([]))
    for radiance in (0.1, 0.5):
        image = renderer.develop(3, np.full((480, 640), radiance, dtype=np.float32)) / 255.0
        assert image.mean() == pytest.approx(radiance, abs=0.001)
        quantisation = 1.0 / 12.0 / 255.0**2
        expected = radiance / 2000.0 + (20.0 / 2000.0)**2 + quantisation
        assert image.var() == pytest.approx(expected, rel=0.02)


def test_noise_differs_between_images_and_repeats_for_the_same_one():
    grey = np.full((120, 160), 0.4, dtype=np.float32)
    sensor = Sensor(vignetting=0.0)
    first, again = (Renderer(SMALL, sensor, Scenery([]), seed=5) for _ in range(2))
    np.testing.assert_array_equal(first.develop(7, grey), again.develop(7, grey))
    difference = first.develop(7, grey).astype(float) - first.develop(8, grey)
    assert difference.std() == pytest.approx(2**0.5 * first.develop(7, grey).std(), rel=0.1)


def test_gamma_brightens_and_vignetting_darkens_the_corners():
    renderer = Renderer(SMALL, Sensor(gain=1.0, full_well=1e12, read_noise=0.0), Scenery([]))
    image = renderer.develop(0, np.full((120, 160), 0.5, dtype=np.float32))
    assert image[60, 80] == round(255 * 0.5**(1 / 2.2))
    x, y = SMALL.rays(np.array(0.0), np.array(0.0))
    light = 0.5 / (1 + 0.35 * (x**2 + y**2))**2
    assert image[0, 0] == pytest.approx(255 * light**(1 / 2.2), abs=1)


def test_a_nearer_surface_hides_a_farther_one_and_a_back_is_not_seen():
    facing = Transform(T_BODY_MARKER.rotation)  # towards -x
    away = Transform(-T_BODY_MARKER.rotation @ np.diag([1.0, -1.0, 1.0]))

    def at(x, surface):
        return surface.moved(Transform(translation=np.array([x, 0.0, 0.0])))
    near, far = Surface(facing, 1.0, 1.0, plain(0.1)), Surface(facing, 9.0, 9.0, plain(0.9))
    world = Scenery([at(5.0, far), at(3.0, near), at(1.0, Surface(away, 1.0, 1.0, plain(0.0)))],
                    visibility=1e9, ambient=1.0)
    image = Renderer(SMALL, Sensor(), world).radiance([T_WORLD_OPTICAL], [Transform()])
    assert image[60, 80] == pytest.approx(0.1)  # 1 m / 3 m * 150 px = 50 px to every side
    assert image[60, 80 + 55] == pytest.approx(0.9)


def test_the_same_scene_renders_to_the_same_bytes_and_another_seed_to_others():
    body = Transform(np.eye(3), np.array([0.0, 0.0, 1.6]))
    images = [Renderer(SMALL, Sensor(), field_with_buildings(), leader(BLACK, SIDE), seed).image(
        0, [body @ T_WORLD_OPTICAL] * 2, [body @ AHEAD] * 2) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(images[0], images[1])
    assert np.any(images[0] != images[2])


@pytest.mark.parametrize('pose', [
    TURNED,
    Transform(rotation_vector_to_matrix([0.0, 0.0, 0.4]), np.array([0.3, 0.0, 0.1])),
    *(pytest.param(Transform(rotation_vector_to_matrix(turn), np.array(place)),
                   marks=pytest.mark.sweep) for turn, place in (
        ([0.0, 0.1, 1.0], [1.1, -0.1, 0.05]), ([0.2, 0.3, -0.9], [1.3, 0.2, 0.2]),
        ([0.0, 0.0, 2.6], [1.2, 0.0, -0.4]), ([0.3, -0.4, -1.6], [0.9, 0.1, 0.4])))],
    ids=['turned', 'flown through', 'left', 'right', 'from ahead', 'from below'])
def test_the_leader_is_drawn_as_rays_would_show_it(pose):
    body = leader(BLACK, SIDE)
    drawn, cast = (Renderer(Camera(), Sensor(), Scenery(still, visibility=1e9), body).radiance(
        [T_WORLD_OPTICAL] * 16, leaders) for still, leaders in (
            ([], [pose] * 16), ([s.moved(pose) for s in body], [])))
    # Light differs by direction, which the scenery takes from the same normals.
    off = np.abs(drawn - cast)
    shown = np.abs(cast - cast[0, 0]) > 1e-3
    assert shown.sum() > 4000
    assert off[shown].mean() < 0.008
    assert np.mean(off[shown] > 0.15) < 0.006  # pixels on the edges of dark parts, and no others


@pytest.mark.parametrize('camera', [Camera(), FISHEYE, SMALL], ids=['sharp', 'fisheye', 'coarse'])
@pytest.mark.parametrize('pose', [AHEAD, TURNED], ids=['ahead', 'turned'])
def test_the_marker_is_filtered_as_many_rays_would_show_it(camera, pose):
    marker = [s for s in leader(BLACK, SIDE) if len(s.texture.values) > 1 and not s.two_sided]
    drawn, cast = (Renderer(camera, Sensor(), Scenery(still, visibility=1e9), body).radiance(
        [T_WORLD_OPTICAL] * 64, leaders) for still, body, leaders in (
            ([], marker, [pose] * 64), ([s.moved(pose) for s in marker], [], [])))
    assert np.abs(drawn - cast).max() < 0.05
    assert abs(np.mean(drawn - cast)) < 1e-5


def test_a_leader_behind_the_camera_is_not_seen():
    renderer = Renderer(SMALL, Sensor(), Scenery([]), leader(BLACK, SIDE))
    behind = Transform(np.eye(3), np.array([-2.0, 0.0, 0.0]))
    image = renderer.radiance([T_WORLD_OPTICAL], [behind])
    np.testing.assert_allclose(image, Scenery([]).haze, rtol=1e-6)


@pytest.mark.parametrize(('arguments', 'message'), [
    ({'model': 'fov'}, "model = 'fov': must be plumb_bob or equidistant"),
    ({'distortion': (0.1,)}, r'distortion = \(0.1,\): plumb_bob takes 5 values')])
def test_an_impossible_camera_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Camera(**arguments)


def test_a_marker_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r'marker has shape \(6, 6\): must be \(8, 8\)'):
        leader(np.zeros((6, 6)), SIDE)
