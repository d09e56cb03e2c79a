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

"""Smeared markers: where they are, and that nothing else is taken for one."""

from __future__ import annotations

import math
import warnings

from marker_images import DICTIONARY, facing, known, make_camera, marker_code, render, SIDE
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.parameters.neighbors_file import Marker
from flock_follower.perception.images import GrayImage
from flock_follower.perception.smear_fit import descend, fit_smeared, SmearStart
from flock_follower.perception.smear_print import smear_model

CAMERA = make_camera(width=240, height=180)
CELL = SIDE / 6.0
MOUNTED = Transform(rotation_vector_to_matrix([0.2, -0.1, 0.3]), np.array([0.1, -0.05, 0.02]))
MODEL = smear_model(Marker(3, SIDE, MOUNTED), DICTIONARY)
HERE = facing((0.02, -0.01, 1.5), (0.1, 0.3, 0.05))  # T_camera_marker


def smeared(pose: Transform, cells: float, direction: float, seed: int = 0, *,
            marker_id: int = 3, codes: Array | None = None, gamma: float = 1.0) -> GrayImage:
    length = cells * CELL * CAMERA.matrix[0, 0] / pose.translation[2]
    return render(CAMERA, {marker_id: pose}, seed=seed, gamma=gamma,
                  motion=(length * math.cos(direction), length * math.sin(direction)),
                  codes=None if codes is None else {marker_id: codes})


def body(pose: Transform) -> Transform:
    return pose @ MOUNTED.inverse()


def off(pose: Transform, seed: int) -> Transform:
    """Return a pose off by up to two cells across the line of sight, and a little in all else."""
    rng = np.random.default_rng(seed)
    aside = np.append(rng.uniform(-1.4, 1.4, 2) * CELL, rng.uniform(-0.03, 0.03))
    return Transform(rotation_vector_to_matrix(rng.normal(0.0, 0.03, 3)) @ pose.rotation,
                     pose.translation + aside)


@pytest.mark.parametrize('cells, gamma', [
    (0.3, 1.0), (0.6, 1.0), (1.0, 1.0), (1.5, 1.0), (0.6, 2.2), (1.0, 2.2), (1.5, 2.2)])
def test_a_smeared_marker_has_an_honest_covariance(cells: float, gamma: float) -> None:
    squares = []
    for k in range(4):
        pose = facing((0.02 * k, -0.02, 1.2 + 0.25 * k), (0.1, 0.15 * k - 0.3, 0.05))
        found = known(fit_smeared(smeared(pose, cells, 0.6 * k, k, gamma=gamma), CAMERA, MODEL,
                                  off(body(pose), k)))
        error = np.concatenate([
            pose.translation - found.pose.apply(MOUNTED.translation), matrix_to_rotation_vector(
                body(pose).rotation @ found.pose.rotation.T)])
        assert np.linalg.norm(error[:2]) < 0.001 * pose.translation[2]
        assert abs(error[2]) < 0.012 * pose.translation[2]
        assert np.linalg.norm(error[3:]) < 0.15
        np.linalg.cholesky(found.covariance)
        squares.append(error @ np.linalg.solve(found.covariance, error) / 6.0)
    assert np.mean(squares) < 1.5


@pytest.mark.parametrize('cells', [1.0, 1.5, 1.8])
def test_a_fit_ends_where_it_leads_no_farther(cells: float) -> None:
    image = smeared(HERE, cells, 0.4, gamma=2.2)
    found = known(fit_smeared(image, CAMERA, MODEL, off(body(HERE), 2)))
    again = known(descend(image, CAMERA, MODEL, SmearStart(
        found.pose, found.smear, found.lens)))
    turned = matrix_to_rotation_vector(again.pose.rotation @ found.pose.rotation.T)
    assert np.linalg.norm(turned) < 0.01
    assert np.linalg.norm(again.smear - found.smear) < 0.02
    assert np.linalg.norm(found.smear) == pytest.approx(cells, abs=0.15)


def test_descent_from_last_smear_ends_where_a_searched_one_does() -> None:
    for k, cells in enumerate((0.6, 1.0, 1.5, 1.8)):
        before = known(fit_smeared(smeared(HERE, cells, 0.4, gamma=2.2), CAMERA, MODEL,
                                   off(body(HERE), k)))
        moved = facing((0.02 + 0.2 * CELL, -0.01, 1.5), (0.1, 0.3, 0.05))
        image = smeared(moved, cells, 0.45, k, gamma=2.2)
        found = known(descend(image, CAMERA, MODEL, SmearStart(
            before.pose, before.smear, before.lens), True))
        again = known(fit_smeared(image, CAMERA, MODEL, before.pose))
        assert found.steps < again.steps or cells < 1.5
        assert np.linalg.norm(found.smear - again.smear) < 0.05
        aside, along = np.split((found.pose @ MOUNTED).translation - moved.translation, [2])
        assert np.linalg.norm(aside) < 0.0015
        assert abs(along[0]) < 0.02


@pytest.mark.parametrize('cells', [1.0, 1.35])
@pytest.mark.parametrize('marker_id', [0, 3, 17, 33])
def test_smeared_mirrored_prints_are_refused(
        marker_id: int, cells: float) -> None:
    model = smear_model(Marker(marker_id, SIDE, MOUNTED), DICTIONARY)
    own = marker_code(marker_id)
    for mirrored in (own[::-1], own[:, ::-1]):
        image = smeared(HERE, cells, 0.0, marker_id=marker_id, codes=mirrored)
        # One word is its own mirror image.
        assert (fit_smeared(image, CAMERA, model, body(HERE)) is None) != np.array_equal(
            mirrored, own)


@pytest.mark.parametrize('cells', [0.0, 1.0, 1.5])
def test_no_other_marker_is_taken_for_it(cells: float) -> None:
    assert fit_smeared(smeared(HERE, max(cells, 0.3), 0.4), CAMERA, MODEL, body(HERE)) is not None
    for marker_id in range(0, 50, 3):
        if marker_id != 3:
            image = smeared(HERE, cells, 0.4, marker_id=marker_id)
            assert fit_smeared(image, CAMERA, MODEL, body(HERE)) is None, marker_id
    own = marker_code(3)
    # Smeared by 1.5 cells along its rows, id 3 looks like its mirror image.
    mirrored = (own[::-1],) if cells > 1.0 else (own[::-1], own[:, ::-1])
    for code in (np.rot90(own), np.rot90(own, 2), *mirrored):
        assert fit_smeared(smeared(HERE, cells, 0.4, codes=code), CAMERA, MODEL,
                           body(HERE)) is None


def test_cells_that_are_wrong_are_told_through_the_smear() -> None:
    rng = np.random.default_rng(4)
    for k in range(12):
        code = marker_code(3).copy()
        inner = code[1:-1, 1:-1]  # a view
        for cell in rng.permutation(16)[:3]:
            inner[cell // 4, cell % 4] ^= True
        image = smeared(HERE, 1.2, 0.5 * k, codes=code)
        assert fit_smeared(image, CAMERA, MODEL, body(HERE)) is None


@pytest.mark.parametrize('image', [
    np.full((180, 240), 128, dtype=np.uint8), np.zeros((180, 240), dtype=np.uint8),
    np.random.default_rng(5).integers(0, 256, (180, 240), dtype=np.uint8),
    255 - smeared(HERE, 1.0, 0.3)], ids=['flat', 'black', 'noise', 'inverted'])
def test_where_it_is_not_there_is_no_pose(image: GrayImage) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert fit_smeared(image, CAMERA, MODEL, body(HERE)) is None
