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

"""The camera model against OpenCV's own projection, its own inverse, and bad calibrations."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
from marker_images import make_camera
import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.perception.camera import CameraModel, DISTORTION_MODELS

K = np.array([[610.0, 0.0, 322.5], [0.0, 608.0, 238.2], [0.0, 0.0, 1.0]])


def points_ahead(count: int = 200) -> Array:
    """Return points (N, 3), m, all over the field of view and from 0.5 to 4 m deep."""
    rng = np.random.default_rng(3)
    ray = np.column_stack([rng.uniform(-0.55, 0.55, count), rng.uniform(-0.42, 0.42, count),
                           np.ones(count)])
    return ray * rng.uniform(0.5, 4.0, (count, 1))


@pytest.mark.parametrize('model', DISTORTION_MODELS)
def test_projection_agrees_with_opencv(model: str) -> None:
    camera, points = make_camera(model), points_ahead()
    project: Any = cv2.fisheye.projectPoints if model == 'equidistant' else cv2.projectPoints
    expected = project(points[:, None], np.zeros(3), np.zeros(3), camera.matrix,
                       camera.distortion)[0]
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize('model', DISTORTION_MODELS)
def test_undistortion_inverts_projection(model: str) -> None:
    camera, points = make_camera(model), points_ahead()
    np.testing.assert_allclose(camera.undistort(camera.project(points)),
                               points[:, :2] / points[:, 2:], atol=1e-10)


@pytest.mark.parametrize('model', DISTORTION_MODELS)
def test_jacobian_agrees_with_differences(model: str) -> None:
    camera, points = make_camera(model), np.vstack([points_ahead(50), [[0.0, 0.0, 1.0]]])
    numeric = np.stack([(camera.project(points + step) - camera.project(points - step)) / 2e-6
                        for step in 1e-6 * np.eye(3)], axis=2)
    np.testing.assert_allclose(camera.linearize(points)[1], numeric, atol=1e-4)


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels = make_camera().project([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.1, 0.1, 1.0]])
    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()


def test_points_beyond_the_fold_of_the_distortion_have_no_pixel() -> None:
    # r (1 - 0.3 r^2) turns back at r = 1.054: r = 1.7 would land in the middle of the image.
    camera = CameraModel(K, np.array([-0.3, 0.0, 0.0, 0.0, 0.0]), 'plumb_bob', 640, 480)
    assert camera.radius == pytest.approx(np.sqrt(1.0 / 0.9), abs=0.01)
    assert np.isnan(camera.project([[1.7, 0.0, 1.0]])).all()
    assert np.isfinite(camera.project([[1.0, 0.0, 1.0]])).all()


def test_pixels_no_ray_reaches_are_nan_and_spoil_no_others() -> None:
    camera = CameraModel(K, np.array([-0.3, 0.0, 0.0, 0.0, 0.0]), 'plumb_bob', 640, 480)
    xy = camera.undistort([[5000.0, 238.2], [322.5, 238.2], [np.nan, 0.0]])
    assert np.isnan(xy[0]).all()
    np.testing.assert_allclose(xy[1], 0.0, atol=1e-12)
    assert np.isnan(xy[2]).all()


@pytest.mark.parametrize('count', [12, 14])
def test_thin_prism_and_tilted_sensor_agree_with_opencv(count: int) -> None:
    plain, points = make_camera('rational_polynomial'), points_ahead()
    more = [0.02, -0.01, 0.015, 0.02, 0.05, -0.03][:count - 8]
    camera = CameraModel(plain.matrix, [*plain.distortion, *more], plain.model, 640, 480)
    expected, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.matrix,
                                    camera.distortion)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(camera.undistort(camera.project(points)),
                               points[:, :2] / points[:, 2:], atol=1e-9)
    differences = np.stack([(camera.project(points + n) - camera.project(points - n)) / 2e-6
                            for n in 1e-6 * np.eye(3)], axis=2)
    np.testing.assert_allclose(camera.linearize(points)[1], differences, rtol=1e-5, atol=1e-3)


def info(scale: float = 1.0, shift: tuple[float, float] = (0.0, 0.0),
         size: tuple[int, int] = (640, 480),
         roi: tuple[int, int, int, int] = (0, 0, 0, 0), binning: int = 0) -> Any:
    """Return a CameraInfo with K scaled, then shifted by px, and what else it claims."""
    matrix = np.diag([scale, scale, 1.0]) @ K
    matrix[:2, 2] -= shift
    x, y, width, height = roi
    return SimpleNamespace(
        k=matrix.ravel(), d=[], distortion_model='plumb_bob', width=size[0], height=size[1],
        p=np.column_stack([matrix, np.zeros(3)]).ravel(),
        roi=SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height),
        binning_x=binning, binning_y=binning)


@pytest.mark.parametrize(('claims', 'sees'), [
    ({}, (640, 480)),
    ({'binning': 2}, (320, 240)),
    ({'roi': (160, 120, 320, 240)}, (320, 240)),
    ({'roi': (0, 0, 320, 240), 'binning': 2}, (160, 120)),
    ({'scale': 0.5, 'size': (320, 240)}, (320, 240)),
    ({'scale': 2.0, 'size': (1280, 960), 'roi': (700, 500, 400, 400)}, (400, 400)),
    ({'shift': (-60.0, 40.0)}, (640, 480))])
def test_what_camera_info_says_of_the_image_is_used(
        claims: dict[str, Any], sees: tuple[int, int]) -> None:
    camera = CameraModel.from_info(info(**claims))
    assert (camera.width, camera.height) == sees


@pytest.mark.parametrize('rectified', [False, True])
@pytest.mark.parametrize('claims', [
    {'scale': 2.0}, {'scale': 0.5}, {'scale': 1.5}, {'scale': 2.0 / 3.0},
    {'scale': 0.5, 'binning': 2},  # K is binned already
    {'size': (320, 240), 'binning': 2},  # only the size is binned
    {'size': (320, 240)},  # a region, or a smaller image, without its roi or binning
    {'shift': (160.0, 120.0), 'roi': (160, 120, 320, 240)},  # K is that of the region
    {'shift': (160.0, 120.0)}])
def test_a_matrix_for_another_image_is_refused(claims: dict[str, Any], rectified: bool) -> None:
    with pytest.raises(ValueError, match='K is for another image'):
        CameraModel.from_info(info(**claims), rectified)


def test_rectified_image_uses_p_without_distortion() -> None:
    P = np.array([[500.0, 0.0, 300.0, -40.0], [0.0, 500.0, 200.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    camera = CameraModel.from_calibration(
        np.zeros(9), [9.0] * 5, 'plumb_bob', 640, 480, P.ravel(), rectified=True)
    np.testing.assert_allclose(camera.project([[0.2, -0.1, 2.0]]), [[350.0, 175.0]])


@pytest.mark.parametrize(('model', 'D'), [
    ('plumb_bob', []), ('', []), ('plumb_bob', [0.1, 0.0, 0.0, 0.0]),
    ('plumb_bob', [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
    ('equidistant', [0.1, 0.0, 0.0, 0.0, 0.0]), ('rational_polynomial', [0.1] + [0.0] * 13)])
def test_drivers_ways_of_writing_d_are_accepted(model: str, D: list[float]) -> None:
    camera = CameraModel.from_calibration(K, D, model, 640, 480)
    assert len(camera.distortion) == DISTORTION_MODELS[camera.model]


@pytest.mark.parametrize('count', [4, 5, 8, 12, 14])
def test_number_of_coefficients_counts_not_the_models_name(count: int) -> None:
    D = [-0.1, 0.05, 0.001, -0.001, 0.01, 0.02, -0.01, 0.005, *[0.003] * 6][:count]
    expected, _ = cv2.projectPoints(points_ahead()[:, None], np.zeros(3), np.zeros(3), K,
                                    np.array(D))
    for model in ('plumb_bob', 'rational_polynomial'):
        camera = CameraModel.from_calibration(K, D, model, 640, 480)
        np.testing.assert_allclose(camera.project(points_ahead()), expected[:, 0], atol=1e-9)


def test_region_of_interest_and_binning_see_the_same_rays() -> None:
    camera = make_camera()
    part = camera.scaled(100, 60, 400, 300, 2, 2)
    assert (part.width, part.height) == (200, 150)
    # The binned pixel (i, j) covers the full pixels 100 + 2 i and the next, 60 + 2 j and the next.
    np.testing.assert_allclose(part.undistort([[10.0, 20.0]]),
                               camera.undistort([[120.5, 100.5]]), atol=1e-12)


@pytest.mark.parametrize(('change', 'message'), [
    ({'K': np.zeros((3, 3))}, 'not calibrated'),
    ({'K': np.diag([-1.0, 600.0, 1.0])}, 'positive focal lengths'),
    ({'K': np.full((3, 3), np.nan)}, 'finite'),
    ({'K': np.eye(3)},
     r'focal length for 640x480 = 1\.0: must be a number in \[12\.8, 640000\] px'),
    ({'K': np.diag([600.0, 1e300, 1.0])}, r'focal length for 640x480 = 1e\+300'),
    ({'K': np.eye(4)}, 'K has 16 elements'),
    ({'D': [0.1] * 3}, 'D has 3 elements: plumb_bob takes 4'),
    ({'D': [0.1] * 9}, 'D has 9 elements: plumb_bob takes 4 or 5 or 8 or 12 or 14'),
    ({'distortion_model': 'rational_polynomial', 'D': [0.1] * 6}, 'D has 6 elements: rational'),
    ({'D': [np.inf] * 5}, 'finite'),
    ({'distortion_model': 'magic'}, "'magic': must be one of plumb_bob, rational"),
    ({'distortion_model': 'equidistant', 'D': [-1.0] * 5}, 'equidistant takes 4'),
    ({'width': 0}, 'width = 0'),
    ({'height': -3}, 'height = -3'),
    ({'rectified': True}, 'P = None'),
    ({'rectified': True, 'P': np.zeros(12)}, 'P = 0'),
    ({'K': np.array([600.0, 0.0, 1e6, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0])},
     r'optical axis as a share of 640x480 = 1562\.5'),
    ({'K': np.array([600.0, 600.0, 320.0, 600.0, 600.0, 240.0, 0.0, 0.0, 1.0])}, '0 below it'),
    ({'K': np.array([600.0, 1e4, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0])}, 'a skew of at')])
def test_bad_calibrations_are_refused_by_name(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {
        'K': K, 'D': [0.0] * 5, 'distortion_model': 'plumb_bob', 'width': 640, 'height': 480}
    with pytest.raises(ValueError, match=message):
        CameraModel.from_calibration(**{**arguments, **change})


def test_region_outside_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match='must lie inside 640x480'):
        make_camera().scaled(600, 0, 100, 100)


def test_image_of_another_size_is_refused() -> None:
    camera = make_camera()
    camera.check_image(640, 480)
    with pytest.raises(ValueError, match='320x240: camera_info is for 640x480'):
        camera.check_image(320, 240)
