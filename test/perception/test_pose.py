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

"""Neighbors' poses: precision, honest covariances, mirrored attitudes, and several markers."""

from __future__ import annotations

import math
from typing import Any
import warnings

import cv2
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_images import (
    Cover,
    DICTIONARY,
    facing,
    known,
    make_camera,
    marker_code,
    render,
    SIDE,
    TAIL,
)
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker
from flock_follower.perception import pose as pose_module
from flock_follower.perception.camera import CameraModel, DISTORTION_MODELS
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.measurement import (
    choose,
    Hypothesis,
    Measurement,
    PosePrior,
)
from flock_follower.perception.pose import locate, Target, target, track, UNRIVALED_DOUBT
from flock_follower.perception.smear_fit import fit_smeared, SmearFit

LEADER = target(MarkedNeighbor('leader', (Marker(0, SIDE, TAIL),)), DICTIONARY)
CAMERA = make_camera()
SMALL = make_camera(width=240, height=180)  # the middle of it: as sharp, but quicker
FLAT = np.full((480, 640), 128, dtype=np.uint8)  # no edges: only the corners given count


def body(T_camera_marker: Transform) -> Transform:
    """Return T_camera_body."""
    return T_camera_marker @ TAIL.inverse()


def corners_of(camera: CameraModel, T_camera_marker: Transform) -> Array:
    return camera.project(T_camera_marker.apply(marker_corners(SIDE)))


def error(found: Measurement, truth: Transform) -> Array:
    """Return (6,): of the place of the reference, m, and the rotation vector to the truth."""
    return np.concatenate([
        truth.apply(found.reference) - found.T_camera_body.apply(found.reference),
        matrix_to_rotation_vector(truth.rotation @ found.T_camera_body.rotation.T)])


def chi2(found: Measurement, truth: Transform) -> float:
    e = error(found, truth)
    return float(e @ np.linalg.solve(found.covariance, e))


def turned(pose: Transform, *turn: float) -> Transform:
    return Transform(rotation_vector_to_matrix(turn) @ pose.rotation, pose.translation)


def mirrored(pose: Transform) -> Transform:
    """Return the other T_camera_marker whose corners look much the same: tilted oppositely."""
    line = pose.translation / np.linalg.norm(pose.translation)
    normal = pose.rotation[:, 2]
    other = -normal + 2.0 * (normal @ line) * line
    axis = np.cross(normal, other)
    angle = math.atan2(float(np.linalg.norm(axis)), float(normal @ other))
    return turned(pose, *(angle * axis / np.linalg.norm(axis)))


def tracked(image: GrayImage, camera: CameraModel, sought: Target, expected: Transform,
            check: bool = False) -> Measurement:
    return known(track(image, camera, sought, PosePrior(expected), None, check))


# Tracking one marker


@pytest.mark.parametrize('model', DISTORTION_MODELS)
@pytest.mark.parametrize('distance', [1.2, 2.0, 2.8])
def test_a_tracked_neighbor_is_where_it_is(model: str, distance: float) -> None:
    camera = make_camera(model)
    rng = np.random.default_rng(8)
    for k in range(2):
        marker = facing((0.25 * distance, -0.15 * distance, distance),
                        tuple(rng.uniform(-0.4, 0.4, 3)))
        truth = body(marker)
        expected = Transform(truth.rotation, truth.translation + np.array([0.01, -0.008, 0.03]))
        found = tracked(render(camera, {0: marker}, blur=0.7, noise=3.0, rays=3, seed=k), camera,
                        LEADER, turned(expected, 0.02, 0.03, -0.02))
        assert (found.name, found.stage, found.margin) == ('leader', 'track', None)
        # The middle of the edges, about that of the marker.
        np.testing.assert_allclose(found.reference, TAIL.translation, atol=0.02)
        e = error(found, truth)
        scale = 610.0 / camera.matrix[0, 0]  # a wider lens shows the marker smaller
        assert np.linalg.norm(e[:3]) < 0.004 * scale * distance
        assert np.linalg.norm(e[3:]) < 0.08 * scale * distance
        assert chi2(found, truth) < 22.5  # 6 dof, 0.999
        np.testing.assert_allclose(found.covariance, found.covariance.T, rtol=1e-9)
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0


@pytest.mark.parametrize('cells', [(2.2, 0.0), (-1.5, 2.0), (0.0, -2.4)])
def test_marker_moved_cells_beyond_expectation_is_tracked(
        cells: tuple[float, float]) -> None:
    marker = facing((0.02, -0.01, 1.5), (0.1, 0.3, 0.1))
    step = SIDE / 6.0 * (cells[0] * marker.rotation[:, 0] + cells[1] * marker.rotation[:, 1])
    expected = Transform(marker.rotation, marker.translation + step)
    found = tracked(render(SMALL, {0: marker}), SMALL, LEADER, body(expected))
    assert np.linalg.norm(error(found, body(marker))[:3]) < 0.006


@pytest.mark.parametrize('expected', [
    None, facing((0.25, 0.0, 1.5), (0.0, 0.0, 0.0)), facing((0.0, 0.0, 3.0), (0.0, 0.0, 0.0)),
    facing((0.0, 0.0, -1.5), (0.0, 0.0, 0.0)), facing((0.0, 0.0, 1.5), (0.0, np.pi, 0.0)),
    facing((0.0, 0.0, 1.5), (0.0, 0.0, np.pi / 2)), facing((np.nan, 0.0, 1.5), (0.0, 0.0, 0.0)),
    facing((0.0, 0.0, np.inf), (0.0, 0.0, 0.0))],
    ids=['never seen', 'elsewhere', 'farther', 'behind', 'turned away', 'on its side', 'nan',
         'inf'])
def test_where_it_is_not_a_marker_is_not_tracked(expected: Transform | None) -> None:
    image = render(SMALL, {0: facing((0.0, 0.0, 1.5), (0.1, 0.2, 0.0))})
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for check in (False, True):
            pose = None if expected is None else body(expected)
            assert track(image, SMALL, LEADER, PosePrior(pose), None, check) is None


FINITE = st.floats(-5.0, 5.0)
SHOWN = render(SMALL, {0: facing((0.0, 0.0, 1.5), (0.1, 0.2, 0.0))})


@settings(max_examples=80)
@given(st.tuples(FINITE, FINITE, FINITE), st.tuples(FINITE, FINITE, FINITE), st.booleans())
def test_tracking_from_anywhere_neither_raises_nor_warns(
        place: tuple[float, float, float], turn: tuple[float, float, float], check: bool) -> None:
    expected = PosePrior(Transform(rotation_vector_to_matrix(turn), np.array(place)),
                         np.array([0.0, -1.0, 0.0]))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = track(SHOWN, SMALL, LEADER, expected, None, check)
    if found is not None:
        assert np.linalg.norm(found.T_camera_body.apply(found.reference) - [0.0, 0.0, 1.5]) < 0.02


# The mirrored attitude


@pytest.mark.parametrize(('distance', 'turn'), [
    (2.0, (0.0, 0.15, 0.0)), (3.0, (0.0, 0.25, 0.0)), (3.0, (-0.6, 0.2, 0.3))])
def test_the_wrong_branch_is_left_where_the_image_is_clear(
        distance: float, turn: tuple[float, float, float]) -> None:
    marker = facing((0.03, -0.02, distance), turn)
    image = render(SMALL, {0: marker})
    truth, wrong = body(marker), body(mirrored(marker))
    stuck = tracked(image, SMALL, LEADER, wrong)
    assert np.linalg.norm(error(stuck, truth)[3:]) > 0.2  # a minimum of its own
    found = tracked(image, SMALL, LEADER, wrong, check=True)
    assert np.linalg.norm(error(found, truth)[3:]) < 0.03
    assert chi2(found, truth) < 22.5
    # The right one stays, by as much and more.
    again = tracked(image, SMALL, LEADER, found.T_camera_body, check=True)
    assert known(again.margin) > known(found.margin) > 0.0
    np.testing.assert_allclose(again.T_camera_body.rotation, found.T_camera_body.rotation,
                               atol=0.03)


@pytest.mark.parametrize(('turn', 'smear'), [
    ((0.0, 0.45, 0.0), (3.0, 2.0)), ((0.4, 0.3, 0.2), (0.0, 6.0)), ((0.0, -0.5, 0.0), (8.0, 0.0))])
def test_the_wrong_branch_is_left_where_the_marker_is_smeared(
        turn: tuple[float, float, float], smear: tuple[float, float]) -> None:
    marker = facing((0.03, -0.02, 1.2), turn)
    image = render(SMALL, {0: marker}, motion=smear)
    truth, wrong = body(marker), body(mirrored(marker))
    stuck = known(fit_smeared(image, SMALL, LEADER.smears[0], wrong))
    turned = stuck.pose.rotation @ truth.rotation.T
    assert np.linalg.norm(matrix_to_rotation_vector(turned)) > 0.5  # a minimum of its own
    found = tracked(image, SMALL, LEADER, wrong, True)
    assert found.spacing is None
    assert np.linalg.norm(error(found, truth)[3:]) < 0.1
    assert chi2(found, truth) < 22.5
    assert known(found.margin) > 9.0


@pytest.mark.parametrize(('cells', 'blurred'), [(0.1, False), (1.0, True)])
def test_a_print_whose_edges_run_together_is_fitted_whole(cells: float, blurred: bool) -> None:
    marker = facing((0.03, -0.02, 1.2), (0.1, 0.3, 0.05))
    motion = cells * SIDE / 6.0 * SMALL.matrix[0, 0] / 1.2
    found = tracked(render(SMALL, {0: marker}, motion=(motion, 0.0)), SMALL, LEADER, body(marker))
    assert (found.spacing is None) is blurred
    assert (found.alike > 0.0) is blurred
    assert np.linalg.norm(error(found, body(marker))[3:]) < 0.05


def test_edges_turn_a_track_that_a_smear_fit_confirms(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = make_camera(width=320, height=320)
    marker = facing((0.03, -0.02, 0.65), (0.0, 0.5, 0.0))  # 25 px a cell
    image, truth, wrong = render(camera, {0: marker}), body(marker), body(mirrored(marker))
    stuck = SmearFit(wrong, 1e-4 * np.eye(6), 0.05, np.array([0.2, 0.0]), 0, 3)
    monkeypatch.setattr(pose_module, 'descend', lambda *_: stuck)
    last = tracked(image, camera, LEADER, truth)._replace(
        T_camera_body=wrong, spacing=None, smear=stuck.smear)
    found = known(track(image, camera, LEADER, PosePrior(wrong), last, True))
    assert found.spacing is not None
    assert chi2(found, truth) < 22.5


def test_attitude_without_rival_fit_covers_the_mirrored_one(
        monkeypatch: pytest.MonkeyPatch) -> None:
    # The mirrored attitude was not fitted: that is no evidence against it.
    marker = facing((0.03, -0.02, 1.2), (0.0, 0.45, 0.0))
    image = render(SMALL, {0: marker}, motion=(12.0, 4.0))
    monkeypatch.setattr(pose_module, 'descend', lambda *_: None)
    found = known(locate(image, SMALL, LEADER, 0, corners_of(SMALL, marker), PosePrior()))
    assert found.spacing is None
    assert found.doubt == UNRIVALED_DOUBT
    assert chi2(found, body(marker)) < 16.0
    assert chi2(found, body(mirrored(marker))) < 16.0


def test_large_marker_beyond_its_profiles_is_found_by_its_edges(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_module, 'seek', lambda *_: None)  # a reflex spoils the likeness
    camera = make_camera(width=320, height=320)
    marker = facing((0.0, 0.0, 0.65), (0.1, 0.3, 0.05))  # 25 px a cell
    image, truth = render(camera, {0: marker}), body(marker)
    last = tracked(image, camera, LEADER, truth)
    aside = np.array([0.0064, 0.0026, 0.0])  # 6 px and 2 px: profiles reach 2 px
    found = known(track(image, camera, LEADER, PosePrior(
        Transform(truth.rotation, truth.translation + aside)), last, True))
    assert found.spacing is not None
    assert chi2(found, truth) < 22.5


def test_clear_edges_with_hidden_code_do_not_count_as_smear(
        monkeypatch: pytest.MonkeyPatch) -> None:
    marker = facing((0.03, -0.02, 1.2), (0.1, 0.3, 0.05))
    image, corners = render(SMALL, {0: marker}), corners_of(SMALL, marker)
    size = float(np.ptp(corners[:, 0]))
    cv2.circle(image, np.rint(corners.mean(axis=0)).astype(int).tolist(), round(0.27 * size), 255,
               -1)  # a reflex

    def smeared(*_: Any) -> None:
        raise AssertionError('the marker is not smeared')

    monkeypatch.setattr(pose_module, 'fit_smeared', smeared)
    monkeypatch.setattr(pose_module, 'descend', smeared)
    found = known(track(image, SMALL, LEADER, PosePrior(body(marker)), None, True))
    assert found.spacing is not None  # it was there before: its edges are enough
    assert locate(image, SMALL, LEADER, 0, corners, PosePrior(body(marker))) is None


def test_edges_all_in_place_show_the_code_of_tracked_marker(
        monkeypatch: pytest.MonkeyPatch) -> None:
    marker = facing((0.03, -0.02, 1.2), (0.1, 0.3, 0.05))
    image = render(SMALL, {0: marker})
    monkeypatch.setattr(pose_module, 'shows_code', lambda *_: False)
    assert track(image, SMALL, LEADER, PosePrior(body(marker)), None, True) is not None
    assert locate(image, SMALL, LEADER, 0, corners_of(SMALL, marker), PosePrior()) is None


@pytest.mark.parametrize('another', [False, True])
def test_edges_alike_but_for_two_do_not_show_the_code(another: bool) -> None:
    # Of all pairs in the dictionary: 39, turned, lacks two of the 52 edge points of 17.
    marker = facing((0.03, -0.02, 1.0), (0.1, 0.3, 0.05))
    sought = target(MarkedNeighbor('leader', (Marker(17, SIDE, TAIL),)), DICTIONARY)
    image = render(SMALL, {17: marker}, codes={
        17: np.rot90(marker_code(39), 3) if another else marker_code(17)})
    found = track(image, SMALL, sought, PosePrior(body(marker)), None, True)
    assert (found is None) == another


def test_covered_marker_with_sharp_edges_is_not_fitted_as_smear(
        monkeypatch: pytest.MonkeyPatch) -> None:
    marker, fits = facing((0.03, -0.02, 1.2), (0.1, 0.3, 0.05)), list[Any]()
    image = render(SMALL, {0: marker}, cover=Cover('bottom', 0.5, 110.0), noise=10.0)
    monkeypatch.setattr(pose_module, 'descend', lambda *start: fits.append(start))
    assert track(image, SMALL, LEADER, PosePrior(body(marker)), None, True) is None
    assert not fits


def test_covariance_covers_both_probable_attitudes() -> None:
    wider, values = [], []
    for seed in range(6):
        marker = facing((0.0, 0.0, 4.0), (0.0, 0.1, 0.0))
        image = render(SMALL, {0: marker}, blur=1.0, noise=12.0, seed=seed)
        plain = tracked(image, SMALL, LEADER, body(marker))
        found = tracked(image, SMALL, LEADER, body(marker), check=True)
        assert plain.margin is None
        assert known(found.margin) < 8.0
        wider.append(np.sqrt(found.covariance[4, 4] / plain.covariance[4, 4]))
        values.append(chi2(found, body(marker)))
    assert np.median(wider) > 1.1  # about y, where the two are 0.2 rad apart
    assert np.mean(values) < 12.0


def test_gravity_chooses_between_mirrored_poses() -> None:
    marker = facing((0.0, 0.0, 4.0), (0.35, 0.0, 0.0))
    both = [Hypothesis(body(pose), 5.0) for pose in (marker, mirrored(marker))]
    for upright in both:
        chosen = choose(both, PosePrior(None, upright.pose.rotation[:, 2]))
        assert chosen.chosen is upright
        assert chosen.margin > 1.0


# From a detected marker


@pytest.mark.parametrize('model', DISTORTION_MODELS)
def test_from_coarse_corners_the_edges_are_found(model: str) -> None:
    camera = make_camera(model, width=240, height=180)
    rng = np.random.default_rng(5)
    for k, distance in enumerate(camera.matrix[0, 0] / 610.0 * np.array([1.0, 1.8, 2.6])):
        marker = facing((0.02, -0.03, distance), (0.2, -0.5, 0.4))
        corners = corners_of(camera, marker) + rng.uniform(-1.0, 1.0, (4, 2))
        found = known(locate(render(camera, {0: marker}, seed=k), camera, LEADER, 0, corners,
                             PosePrior()))
        assert np.linalg.norm(error(found, body(marker))[:3]) < 0.006 * distance
        assert np.linalg.norm(error(found, body(marker))[3:]) < 0.08
        assert found.spacing is not None
        assert found.rms < 0.2


@pytest.mark.parametrize('blur', [0.6, 7.0])
def test_detected_marker_must_show_its_code_sharp_or_smeared(blur: float) -> None:
    marker = facing((0.0, 0.0, 1.3), (0.1, 0.4, 0.1))
    corners = corners_of(SMALL, marker)
    found = known(locate(render(SMALL, {0: marker}, blur=blur), SMALL, LEADER, 0, corners,
                         PosePrior()))
    assert (found.spacing is None) == (blur > 1.0)
    assert np.linalg.norm(error(found, body(marker))[:3]) < 0.05
    for shown in ({'codes': {0: np.rot90(marker_code(0))}}, {'codes': {0: marker_code(4)}},
                  {'black': 200.0, 'white': 30.0}):
        image = render(SMALL, {0: marker}, blur=blur, **shown)
        assert locate(image, SMALL, LEADER, 0, corners, PosePrior()) is None
    assert locate(FLAT[:180, :240], SMALL, LEADER, 0, corners, PosePrior()) is None


@pytest.mark.parametrize('corners', [
    corners_of(CAMERA, facing((0.0, 0.0, 1.2), (0.0, 0.2, 0.0)))
    + np.array([[12.0, -6.0], [0.0, 0.0], [8.0, 0.0], [0.0, 9.0]]),
    np.full((4, 2), 100.0), np.full((4, 2), np.nan),
    np.array([[10.0, 10.0], [20.0, 20.0], [30.0, 30.0], [40.0, 40.0]]),
    np.array([[1e7, 0.0], [2e7, 0.0], [2e7, 1e7], [1e7, 1e7]])],
    ids=['crooked', 'a point', 'nan', 'a line', 'far outside'])
def test_corners_of_no_square_have_no_pose(corners: Array) -> None:
    assert locate(FLAT, CAMERA, LEADER, 0, corners, PosePrior()) is None


# Several markers on one neighbor

PORT = Transform(TAIL.rotation, np.array([-0.2, 0.2, 0.0]))
STARBOARD = Transform(rotation_vector_to_matrix([0.0, 0.0, 0.3]) @ TAIL.rotation,
                      np.array([-0.15, -0.2, 0.06]))
SIDEWAYS = Transform(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
                     np.array([0.0, -0.3, 0.0]))  # faces right: seen edge on from behind
WINGED = target(MarkedNeighbor('winged', (Marker(0, SIDE, PORT), Marker(1, SIDE, STARBOARD),
                                          Marker(2, SIDE, SIDEWAYS))), DICTIONARY)
#: T_camera_body of a neighbor ahead, a little above, turned by 14 degrees.
AHEAD = Transform(rotation_vector_to_matrix([0.0, 0.25, 0.0])
                  @ np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
                  np.array([0.1, -0.2, 2.4]))


def scene(*marker_ids: int, pose: Transform = AHEAD, seed: int = 0) -> GrayImage:
    markers = WINGED.neighbor.markers
    return render(CAMERA, {k: pose @ markers[k].T_body_marker for k in marker_ids}, rays=3,
                  seed=seed)


def near(pose: Transform) -> Transform:
    return turned(Transform(pose.rotation, pose.translation + np.array([0.006, -0.005, 0.02])),
                  0.01, -0.015, 0.01)


def seen_from_its_right(angle: float) -> Transform:
    return Transform(rotation_vector_to_matrix([0.0, angle, 0.0]) @ AHEAD.rotation,
                     AHEAD.translation)


@pytest.mark.parametrize(('shown', 'angle', 'reference', 'off'), [
    ((0,), 0.0, PORT.translation, 0.015), ((1,), 0.0, STARBOARD.translation, 0.015),
    # Turned by 71 degrees all three show; by 106 only that on the side.
    ((0, 1, 2), 1.0, (-0.1, -0.04, 0.0), 0.005), ((0, 1, 2), 1.6, SIDEWAYS.translation, 0.02)])
def test_the_markers_in_view_make_the_pose(shown: tuple[int, ...], angle: float,
                                           reference: Array, off: float) -> None:
    pose = seen_from_its_right(angle)
    found = tracked(scene(*shown, pose=pose), CAMERA, WINGED, near(pose))
    np.testing.assert_allclose(found.reference, reference, atol=0.02)
    assert np.linalg.norm(error(found, pose)[:3]) < off
    assert chi2(found, pose) < 22.5


@pytest.mark.parametrize('index', [0, 1])
def test_one_detected_marker_brings_in_the_others(index: int) -> None:
    marker = WINGED.neighbor.markers[index]
    corners = corners_of(CAMERA, AHEAD @ marker.T_body_marker) + 0.4
    upright = PosePrior(None, AHEAD.rotation[:, 2])
    found = known(locate(scene(0, 1), CAMERA, WINGED, index, corners, upright))
    assert found.margin == math.inf
    np.testing.assert_allclose(found.reference, [-0.175, 0.0, 0.03], atol=0.02)
    assert np.linalg.norm(error(found, AHEAD)[3:]) < 0.02
    # Where it is the only one in sight, it alone counts.
    found = known(locate(scene(index), CAMERA, WINGED, index, corners, upright))
    np.testing.assert_allclose(found.reference, marker.T_body_marker.translation, atol=0.02)
    assert np.linalg.norm(error(found, AHEAD)[:3]) < 0.015
