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

"""Poses from edges: precise and unbiased on rendered markers, None where there are none."""

from __future__ import annotations

import math
from typing import Any
import warnings

import cv2
from marker_images import (
    Cover,
    DICTIONARY,
    facing,
    known,
    make_camera,
    marker_code,
    render,
    SIDE,
)
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker
from flock_follower.perception import edge_fit
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edge_fit import EdgeFit, fit
from flock_follower.perception.edges import MAX_INFLATION, normal_covariance, solve_normal
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import edge_model

MODEL = edge_model(MarkedNeighbor('leader', (Marker(3, SIDE, Transform()),)), DICTIONARY)
CELL = SIDE / 6.0
# The middle of the usual cameras: as sharp, but quicker.
CAMERA = make_camera(width=240, height=180)
FISHEYE = make_camera('equidistant', width=240, height=180)


def error(estimate: EdgeFit, truth: Transform) -> Array:
    """Return (6,): error of the place of the edges' middle, m, and rotation vector to truth."""
    middle = estimate.pose.inverse().apply(estimate.center[None])
    return np.concatenate([
        truth.apply(middle)[0] - estimate.center,
        matrix_to_rotation_vector(truth.rotation @ estimate.pose.rotation.T)])


def off(pose: Transform, seed: int) -> Transform:
    """Return a pose off by half a cell across the line of sight, and a little in all else."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    aside = 0.4 * CELL * (math.cos(angle) * pose.rotation[:, 0]
                          + math.sin(angle) * pose.rotation[:, 1])
    nearer = rng.uniform(0.98, 1.02)
    return Transform(rotation_vector_to_matrix(rng.normal(0.0, 0.02, 3)) @ pose.rotation,
                     nearer * pose.translation + aside)


def fitted(image: GrayImage, start: Transform, camera: CameraModel = CAMERA,
           spacing: tuple[float, float] | None = None) -> EdgeFit:
    return known(fit(image, camera, MODEL, start, spacing))


@pytest.mark.parametrize(('camera', 'conditions'), [
    (CAMERA, {}), (FISHEYE, {}), (make_camera('rational_polynomial', 240, 180), {}),
    (CAMERA, {'gamma': 2.2, 'black': 8.0}), (CAMERA, {'black': 60.0, 'white': 330.0, 'blur': 0.8}),
    (CAMERA, {'blur': 1.2, 'noise': 3.0})],
    ids=['plain', 'fisheye', 'rational', 'gamma', 'over-exposed', 'blurred'])
def test_distance_has_no_bias(camera: CameraModel, conditions: dict[str, float]) -> None:
    # Equally large in the image, whatever the lens.
    near = camera.matrix[0, 0] / 610.0
    ratios = []
    rng = np.random.default_rng(4)
    for k, distance in enumerate(near * np.linspace(1.2, 3.0, 14)):
        truth = facing((0.0, 0.0, distance), tuple(rng.uniform(-0.5, 0.5, 3)))
        found = fitted(render(camera, {3: truth}, seed=k, **conditions), off(truth, k), camera)
        ratios.append(found.center @ [0, 0, 1] / truth.apply(
            found.pose.inverse().apply(found.center[None]))[0, 2])
    assert abs(np.mean(ratios) - 1.0) < 0.003
    assert np.std(ratios) < 0.006


@pytest.mark.parametrize(('distance', 'is_found'), [(0.65, True), (1.6, False)])
def test_errors_of_edges_are_bounded_by_size_of_cells(distance: float, is_found: bool) -> None:
    camera = make_camera(width=320, height=320)
    pose = facing((0.0, 0.0, distance), (0.1, 0.2, 0.0))  # 25 px a cell, or 10
    v, u = np.mgrid[:320, :320].astype(np.float32)
    waves = 0.85 * np.sin(0.3 * v).astype(np.float32), 0.85 * np.sin(0.3 * u).astype(np.float32)
    image = cv2.remap(render(camera, {3: pose}), u + waves[0], v + waves[1], cv2.INTER_LINEAR)
    assert (fit(image, camera, MODEL, pose) is not None) == is_found


def test_edges_in_a_shadow_count() -> None:
    # Without them the attitude would rest on the lit half alone.
    pose = facing((0.0, 0.0, 1.2), (0.02, 0.03, 0.0))
    image = render(CAMERA, {3: pose}, black=10.0)
    image[:, :round(CAMERA.project(pose.translation)[0, 0])] //= 5
    found = fitted(image, pose)
    assert found.inlier_share > 0.85
    assert np.linalg.norm(error(found, pose)[3:]) < 0.05


@pytest.mark.parametrize('axis', [0, 1])
def test_white_that_swells_one_way_does_not_move_pose(axis: int) -> None:
    # White that reaches 1 px further left and right, or up and down, and nowhere else.
    camera = CameraModel(np.array([[600.0, 0.0, 99.5], [0.0, 600.0, 99.5], [0.0, 0.0, 1.0]]),
                         np.zeros(5), 'plumb_bob', 200, 200)
    drawn = np.kron(np.pad(marker_code(3), 2, constant_values=True), np.ones((20, 20), dtype=bool))
    along = 1 - axis  # columns of the image run along the marker's x
    swollen = drawn | np.roll(drawn, 1, axis=along) | np.roll(drawn, -1, axis=along)
    truth = facing((0.0, 0.0, 600.0 * SIDE / 120.0), (0.0, 0.0, 0.0))  # 20 px a cell
    found = fitted(np.where(swollen, 200, 30).astype(np.uint8), truth, camera)
    np.testing.assert_allclose(found.pose.translation, truth.translation, atol=0.002)


def test_over_exposed_edges_are_followed_from_image_to_image() -> None:
    pose = facing((0.02, -0.01, 1.8), (0.1, 0.25, 0.05))
    image = render(CAMERA, {3: pose}, black=60.0, white=1500.0, blur=1.0)
    found = fitted(image, off(pose, 1))
    for seed in range(3):  # from as near as a prediction is
        start = Transform(pose.rotation, pose.translation
                          + np.random.default_rng(seed).normal(0.0, 0.001, 3))
        again = fitted(image, start, spacing=found.spacing)
        assert again.inlier_share > 0.9
        assert np.abs(error(again, pose)[:2]).max() < 0.0005


@pytest.mark.parametrize('side', ['left', 'right', 'top', 'bottom'])
@pytest.mark.parametrize('level', [0.0, 110.0, 250.0])
def test_a_covered_side_does_not_drag_the_pose(side: str, level: float) -> None:
    image = render(CAMERA, {3: HERE}, cover=Cover(side, 0.1, level))
    e = error(fitted(image, off(HERE, 1)), HERE)
    assert np.linalg.norm(e[:2]) < 0.002 and abs(e[2]) < 0.02


HERE = facing((0.05, -0.03, 1.5), (0.1, 0.3, 0.05))
SHOWN = render(CAMERA, {3: HERE})


@pytest.mark.parametrize('image', [
    np.full((180, 240), 128, dtype=np.uint8), np.zeros((180, 240), dtype=np.uint8), 255 - SHOWN],
    ids=['flat', 'black', 'inverted'])
def test_where_there_are_no_edges_there_is_no_pose(image: GrayImage) -> None:
    assert fit(image, CAMERA, MODEL, HERE) is None


@pytest.mark.parametrize('place', [
    (0.0, 0.0, -1.5), (0.0, 0.0, 0.01), (9.0, 0.0, 1.5), (np.nan, 0.0, 1.5), (0.0, 0.0, np.inf),
    (0.0, 0.0, 1e6), (1e200, 0.0, 1.0)])
def test_poses_out_of_sight_are_none(place: tuple[float, float, float]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert fit(SHOWN, CAMERA, MODEL, Transform(HERE.rotation, np.array(place))) is None


@pytest.mark.parametrize('axis', [0, 1])
@pytest.mark.parametrize('others', [0, 2])
def test_a_fit_that_rests_on_edges_of_one_axis_is_none(monkeypatch: pytest.MonkeyPatch,
                                                       axis: int, others: int) -> None:
    find, seen = edge_fit._find, MODEL.axis == axis
    seen[np.flatnonzero(~seen)[:others]] = True

    def in_part(*arguments: Any) -> Any:
        found = find(*arguments)
        return found and found._replace(found=found.found & seen)

    monkeypatch.setattr(edge_fit, '_find', in_part)
    for turn in ((0.0, 0.0, 0.0), (0.4, 0.3, 0.2)):
        truth = facing((0.02, 0.01, 1.2), turn)
        assert fit(render(CAMERA, {3: truth}), CAMERA, MODEL, truth) is None


def test_nearly_dependent_equations_are_refused() -> None:
    units = np.array([1.0, 1e-3, 1e4, 1.0, 1e2, 1e-4])  # far apart
    for away in (1.0, 1e-3, 1e-5, 1e-6, 1e-7, 1e-9, 0.0):  # two unknowns act alike but for that
        design = np.random.default_rng(5).normal(0.0, 1.0, (40, 6))
        design[:, 1] = design[:, 0] + away * design[:, 1]
        matrix = (design * units).T @ (design * units)
        inverse = normal_covariance(matrix)
        # The variance of either unknown is that of one alone over away^2.
        assert (inverse is None) == (2.0 / away**2 > MAX_INFLATION if away else True), away
        if inverse is not None:
            np.linalg.cholesky(inverse)
        if away == 1.0:
            x = solve_normal(matrix, matrix @ (1.0 / units))
            assert x is not None and inverse is not None
            np.testing.assert_allclose(x * units, np.ones(6), rtol=1e-9)
            np.testing.assert_allclose(inverse @ matrix * units[:, None] / units, np.eye(6),
                                       atol=1e-9)
