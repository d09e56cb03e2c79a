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

"""Marker poses: precision, an honest covariance, and the right one of two mirrored poses."""

from __future__ import annotations

from dataclasses import replace

from marker_images import DICTIONARY, facing, make_camera, render, SIDE
import numpy as np
import pytest

from flock_follower.geometry import (
    Array,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    Transform,
)
from flock_follower.perception import pose as pose_module
from flock_follower.perception.camera import CameraModel, DISTORTION_MODELS
from flock_follower.perception.neighbors import Neighbor, NeighborConfig
from flock_follower.perception.pose import (
    marker_corners,
    MAX_RMS,
    measure,
    Prediction,
    solve,
    WIDENING,
)

# The marker on the tail, facing backwards, the body's x axis ahead.
TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))
LEADER = Neighbor('leader', 0, SIDE, TAIL)
WING = Neighbor('wing', 1, SIDE, TAIL)
CONFIG = NeighborConfig(DICTIONARY, (LEADER,))
UP = np.array([0.0, -1.0, 0.0])  # of a level camera


def corners_of(camera: CameraModel, pose: Transform) -> Array:
    return camera.project(pose.apply(marker_corners(SIDE)))


def error(estimate: Transform, truth: Transform) -> Array:
    """Return (6,): position error, m, and the rotation vector from estimate to truth."""
    return np.concatenate([truth.translation - estimate.translation,
                           matrix_to_rotation_vector(truth.rotation @ estimate.rotation.T)])


def mirrored(pose: Transform) -> Transform:
    """Return the other pose whose corners look much the same: tilted oppositely."""
    line = pose.translation / np.linalg.norm(pose.translation)
    normal = pose.rotation[:, 2]
    flip = 2.0 * np.outer(line, line) - np.eye(3)  # half a turn about the line of sight
    axis = np.cross(normal, flip @ normal)
    angle = np.arctan2(np.linalg.norm(axis), normal @ flip @ normal)
    turn = Transform.from_quaternion(
        np.zeros(3), np.append(np.sin(angle / 2) * axis / np.linalg.norm(axis), np.cos(angle / 2)))
    return Transform(turn.rotation @ pose.rotation, pose.translation)


@pytest.mark.parametrize('model', DISTORTION_MODELS)
@pytest.mark.parametrize('distance', [1.2, 2.0, 2.8])
def test_pose_of_a_rendered_marker_is_precise(model: str, distance: float) -> None:
    camera = make_camera(model)
    rng = np.random.default_rng(8)
    for k in range(3):
        truth = facing((0.25 * distance, -0.15 * distance, distance),
                       tuple(rng.uniform(-0.4, 0.4, 3)))
        image = render(camera, {0: truth}, blur=0.7, noise=3.0, seed=k)
        (found,), others = measure(image, camera, CONFIG, Prediction(up=None))
        assert (found.name, found.rejected, others) == ('leader', '', [])
        e = error(found.T_camera_marker, truth)
        scale = 610.0 / camera.matrix[0, 0]  # a wider lens shows the marker smaller
        assert np.linalg.norm(e[:3]) < 0.005 * scale * distance
        assert np.linalg.norm(e[3:]) < 0.03 * scale * distance
        assert e @ np.linalg.solve(found.covariance, e) < 22.5  # chi^2, 6 dof, 0.999


@pytest.mark.parametrize('roll', np.radians([0.0, 44.0, 46.0, 90.0, 135.0, 180.0, 270.0]))
def test_exact_corners_give_the_exact_pose(roll: float) -> None:
    # A marker upright or upside down is exactly half a turn from the camera's axes.
    camera = make_camera()
    truth = facing((0.3, -0.2, 1.5), (0.0, 0.6, 0.0))
    truth = Transform(truth.rotation @ rotation_vector_to_matrix([0.0, 0.0, roll]),
                      truth.translation)
    found = solve(corners_of(camera, truth), 0.1, 0.05, camera, LEADER, Prediction())
    assert found is not None
    np.testing.assert_allclose(error(found.T_camera_marker, truth), 0.0, atol=1e-6)
    assert found.rms < 1e-6
    assert found.solutions == 2


@pytest.mark.parametrize('model', ['plumb_bob', 'equidistant'])
def test_covariance_is_that_of_noisy_corners_widened(model: str) -> None:
    camera, sigma = make_camera(model), 0.1
    truth = facing((0.3, -0.2, 1.5), (0.2, 0.6, 0.1))
    exact = corners_of(camera, truth)
    rng = np.random.default_rng(9)
    errors, covariances = [], []
    for _ in range(300):
        noisy = exact + rng.normal(0.0, sigma, (4, 2))
        found = solve(noisy, sigma, 0.05, camera, LEADER, Prediction())
        assert found is not None
        errors.append(error(found.T_camera_marker, truth))
        covariances.append(found.covariance)
    actual = np.cov(np.transpose(errors))
    claimed = np.mean(covariances, axis=0) / WIDENING**2
    # Equal covariances have all generalised eigenvalues 1.
    ratios = np.linalg.eigvals(np.linalg.solve(actual, claimed)).real
    assert ratios.min() > 0.75
    assert ratios.max() < 1.3


def test_perfect_corners_do_not_make_the_covariance_vanish() -> None:
    camera, truth = make_camera(), facing((0.0, 0.0, 1.5), (0.2, 0.4, 0.0))
    found = solve(corners_of(camera, truth), 1e-6, 0.05, camera, LEADER, Prediction())
    coarse = solve(corners_of(camera, truth), 0.5, 0.05, camera, LEADER, Prediction())
    assert found is not None
    assert coarse is not None
    depth = np.sqrt([found.covariance[2, 2], coarse.covariance[2, 2]])
    assert 0.0005 < depth[0] < 0.005
    assert depth[1] > 4 * depth[0]


def test_systematic_error_is_what_a_shift_of_all_edges_does() -> None:
    camera, truth = make_camera(), facing((0.2, 0.1, 1.8), (0.1, 0.3, 0.05))
    corners = corners_of(camera, truth)
    middle = corners.mean(axis=0)
    half = np.linalg.norm(corners[1] - corners[0]) / 2
    grown = middle + (corners - middle) * (1.0 + 0.15 / half)
    a = solve(corners, 0.1, 0.15, camera, LEADER, Prediction())
    b = solve(grown, 0.1, 0.05, camera, LEADER, Prediction())
    assert a is not None
    assert b is not None
    moved = b.T_camera_marker.translation - a.T_camera_marker.translation
    np.testing.assert_allclose(a.systematic, moved, atol=0.15 * np.linalg.norm(moved))


@pytest.mark.parametrize('turn', [(0.35, 0.0, 0.0), (-0.35, 0.1, 0.0)])
def test_gravity_chooses_between_mirrored_poses(turn: tuple[float, float, float]) -> None:
    # Seen from 4 m, small, with noisy corners: reprojection cannot tell one from the other.
    camera, truth = make_camera(), facing((0.0, 0.0, 4.0), turn)
    up = truth.rotation @ TAIL.rotation.T @ np.array([0.0, 0.0, 1.0])  # the neighbour is upright
    rng = np.random.default_rng(10)
    for _ in range(20):
        corners = corners_of(camera, truth) + rng.normal(0.0, 0.3, (4, 2))
        right = solve(corners, 0.6, 0.05, camera, LEADER, Prediction(up=up))
        assert right is not None
        assert right.solutions == 2
        assert np.linalg.norm(error(right.T_camera_marker, truth)[3:]) < 0.3
        # The same corners of a neighbour upright in the mirrored pose give that pose.
        other = mirrored(truth)
        other_up = other.rotation @ TAIL.rotation.T @ np.array([0.0, 0.0, 1.0])
        wrong = solve(corners, 0.6, 0.05, camera, LEADER, Prediction(up=other_up))
        assert wrong is not None
        assert np.linalg.norm(error(wrong.T_camera_marker, other)[3:]) < 0.3


def test_history_chooses_between_mirrored_poses() -> None:
    camera, truth = make_camera(), facing((0.0, 0.0, 4.0), (0.0, 0.35, 0.0))
    rng = np.random.default_rng(11)
    for _ in range(20):
        corners = corners_of(camera, truth) + rng.normal(0.0, 0.3, (4, 2))
        for expected in (truth, mirrored(truth)):
            found = solve(corners, 0.6, 0.05, camera, LEADER,
                          Prediction(up=UP, markers={'leader': expected}))
            assert found is not None
            assert np.linalg.norm(error(found.T_camera_marker, expected)[3:]) < 0.3


def test_a_clear_image_overrules_history() -> None:
    camera, truth = make_camera(), facing((0.0, 0.0, 1.2), (0.0, 0.5, 0.0))
    found = solve(corners_of(camera, truth), 0.1, 0.05, camera, LEADER,
                  Prediction(up=UP, markers={'leader': mirrored(truth)}))
    assert found is not None
    np.testing.assert_allclose(error(found.T_camera_marker, truth), 0.0, atol=1e-6)


def test_an_undecided_attitude_shows_in_the_covariance() -> None:
    camera, truth = make_camera(), facing((0.0, 0.0, 4.0), (0.0, 0.35, 0.0))
    undecided = solve(corners_of(camera, truth), 3.0, 0.05, camera, LEADER, Prediction(up=UP))
    assert undecided is not None
    assert undecided.solutions == 2
    assert np.sqrt(undecided.covariance[4, 4]) > 0.35  # half the way to the mirrored pose


def test_corners_of_no_square_are_rejected_with_the_reason() -> None:
    camera, truth = make_camera(), facing((0.0, 0.0, 1.2), (0.0, 0.2, 0.0))
    spoilt = np.array([[12.0, -6.0], [0.0, 0.0], [8.0, 0.0], [0.0, 9.0]])
    corners = corners_of(camera, truth) + spoilt
    found = solve(corners, 0.1, 0.05, camera, LEADER, Prediction())
    assert found is not None
    assert found.rms > MAX_RMS
    assert found.rejected == f'reprojection above {MAX_RMS} px'


def test_markers_of_nobody_are_named_and_not_measured() -> None:
    camera = make_camera()
    image = render(camera, {5: facing((-0.3, 0.0, 1.5), (0.0, 0.0, 0.0)),
                            7: facing((0.3, 0.0, 1.5), (0.0, 0.0, 0.0))})
    assert measure(image, camera, CONFIG, Prediction()) == ([], [5, 7])


def test_two_neighbours_are_measured_in_one_image() -> None:
    camera = make_camera()
    places = {0: facing((-0.3, 0.0, 1.5), (0.1, 0.3, 0.0)),
              1: facing((0.4, 0.1, 2.0), (0.0, -0.3, 0.0))}
    config = replace(CONFIG, neighbors=(LEADER, WING))
    found = {m.name: m for m in measure(render(camera, places), camera, config,
                                        Prediction(up=UP)).measurements}
    for neighbor in config.neighbors:
        assert np.linalg.norm(error(found[neighbor.name].T_camera_marker,
                                    places[neighbor.marker_id])[:3]) < 0.01


def test_where_a_marker_is_expected_only_there_is_searched(
        monkeypatch: pytest.MonkeyPatch) -> None:
    camera, truth = make_camera(), facing((0.1, 0.0, 1.8), (0.1, 0.3, 0.0))
    image = render(camera, {0: truth})
    regions = []
    detect = pose_module.aruco.detect

    def watched(*args: object, **kwargs: object) -> object:
        regions.append(kwargs.get('region'))
        return detect(*args, **kwargs)

    monkeypatch.setattr(pose_module.aruco, 'detect', watched)
    everywhere = measure(image, camera, CONFIG, Prediction(up=UP)).measurements[0]
    assert regions == [None]
    regions.clear()
    near = measure(image, camera, CONFIG,
                   Prediction(up=UP, markers={'leader': truth})).measurements[0]
    assert len(regions) == 1
    assert regions[0] is not None
    np.testing.assert_allclose(near.T_camera_marker.translation,
                               everywhere.T_camera_marker.translation, atol=2e-3)
    regions.clear()
    far_off = facing((-0.5, 0.3, 1.8), (0.0, 0.0, 0.0))
    assert measure(image, camera, CONFIG,
                   Prediction(up=UP, markers={'leader': far_off})).measurements
    assert regions[0] is not None
    assert regions[1] is None


@pytest.mark.parametrize('place', [(0.0, 0.0, -2.0), (9.0, 0.0, 2.0), (0.0, 0.0, 0.02)])
def test_expectations_out_of_sight_do_no_harm(place: tuple[float, float, float]) -> None:
    camera, truth = make_camera(), facing((0.1, 0.0, 1.8), (0.1, 0.3, 0.0))
    expected = Transform(truth.rotation, np.array(place))
    found, _ = measure(render(camera, {0: truth}), camera, CONFIG,
                       Prediction(up=UP, markers={'leader': expected}))
    assert len(found) == 1


def test_of_two_equal_markers_the_expected_one_counts() -> None:
    camera = make_camera()
    near, far = facing((-0.4, 0.0, 1.4), (0.0, 0.1, 0.0)), facing((0.5, 0.0, 2.2), (0.0, 0.1, 0.0))
    image = render(camera, {0: far})
    image = np.where(np.arange(640) < 320, render(camera, {0: near}), image)
    image = np.ascontiguousarray(image)
    for expected in (near, far):
        found, _ = measure(image, camera, CONFIG,
                           Prediction(up=UP, markers={'leader': expected}))
        assert np.linalg.norm(error(found[0].T_camera_marker, expected)[:3]) < 0.02
    found, _ = measure(image, camera, CONFIG, Prediction(up=UP))
    assert np.linalg.norm(error(found[0].T_camera_marker, near)[:3]) < 0.02


def test_an_image_of_the_wrong_size_is_refused() -> None:
    with pytest.raises(ValueError, match='320x240'):
        measure(np.zeros((240, 320), dtype=np.uint8), make_camera(), CONFIG, Prediction())
