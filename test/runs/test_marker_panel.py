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

"""A panel of markers: the print holds what its entry says, and is seen from near and far."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import cv2
from marker_images import make_camera, render, SIDE
import numpy as np
import pytest
import yaml

from flock_desk.marker import main, snippet
from flock_desk.runs.marker_panel import draw, layout
from flock_desk.runs.marker_panel import snippet as panel_snippet
from flock_follower.geometry import Array, IDENTITY_QUATERNION, Transform
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import detect, NeighborConfig, parse
from flock_follower.perception.tracker import camera_mounting, Tracker

DICTIONARY = 'DICT_4X4_50'
CAMERA = make_camera()
MOUNTING = camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
PANEL = parse(yaml.safe_load(panel_snippet(layout(DICTIONARY, [0, 1], [0.3, 0.06]))))
SINGLE = parse(yaml.safe_load(snippet(DICTIONARY, [0], 0.16)))


def rasterized(boxes: tuple[tuple[float, ...], ...], width: float, height: float) -> GrayImage:
    """Return a page at 2 px per mm."""
    fine = np.full((round(8 * height), round(8 * width)), 255, dtype=np.uint8)
    for x, y, w, h in boxes:
        fine[round(8 * y):round(8 * (y + h)), round(8 * x):round(8 * (x + w))] = 0
    return cv2.resize(fine, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(('ids', 'sizes', 'page'), [
    ([0, 1], [0.3, 0.06], 'A2'), ([7, 3, 4], [0.05, 0.2, 0.06], 'A3'),
    ([5, 6], [0.04, 0.12], 'A4')])
def test_the_print_holds_the_markers_where_the_entry_says(
        ids: list[int], sizes: list[float], page: str, tmp_path: Path,
        capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['--panel', '--id', *map(str, ids), '--size', *map(str, sizes), '--output',
                 str(tmp_path / 'm.pdf')]) == 0
    told = capsys.readouterr()
    assert f'page {page}, ' in told.err
    (leader,) = parse(yaml.safe_load(told.out)).neighbors
    assert {m.marker_id: m.side_length for m in leader.markers} == dict(zip(ids, sizes))

    drawing = draw(layout(DICTIONARY, ids, sizes), page)
    found = detect(rasterized(drawing.boxes, drawing.width, drawing.height), DICTIONARY)
    at = {number: corners.mean(axis=0) / 2e3 + 0.25e-3 for number, corners in zip(
        found.ids.tolist(), found.corners)}
    sides = {number: np.linalg.norm(corners[1] - corners[0]) / 2e3
             for number, corners in zip(found.ids.tolist(), found.corners)}
    assert sides == pytest.approx(dict(zip(ids, sizes)), abs=6e-4)  # a pixel is 0.5 mm
    for one, other in combinations(leader.markers, 2):
        right, down = at[other.marker_id] - at[one.marker_id]
        moved = other.T_body_marker.translation - one.T_body_marker.translation
        # Seen from behind, the leader's left is on the left; up is up.
        np.testing.assert_allclose(moved, [0.0, -right, -down], atol=6e-4)
    smallest = min(leader.markers, key=lambda marker: marker.side_length)
    np.testing.assert_allclose(smallest.T_body_marker.translation, [-0.2, 0.0, 0.0])
    for x, y, w, h in drawing.boxes:
        assert min(x, y) > 4.99 and x + w < drawing.width - 4.99 and y + h < drawing.height - 4.99


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--panel', '--size', '0.3'], 'takes one for each of at least two ids'),
    (['--panel', '--id', '1', '2', '3', '--size', '0.3', '0.1'], 'takes one for each'),
    (['--panel', '--page', 'A3'], 'takes 411 x 521 mm; use --page A2'),
    (['--panel', '--id', '4', '4', '--size', '0.3', '0.1'], 'must name each marker once'),
    (['--id', '0', '--size', '0.3', '0.1'], 'several are for --panel')])
def test_a_panel_that_cannot_be_is_refused_in_one_line(
        arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert told.count('\n') == 1 and message in told
    assert not list(tmp_path.iterdir())


def seen(config: NeighborConfig, distance: float, aside: float, up: float) -> Array | None:
    """
    Return by how much the leader is misplaced, (3,), m; None where it is not seen.

    :param distance: of its tail before the camera, m; ``aside`` and ``up``, as shares of that,
        how far off the middle of the image.
    """
    leader = Transform(translation=np.array([0.3, 0.0, 0.0]) + distance * np.array(
        [1.0, aside, up]))
    image = np.full((CAMERA.height, CAMERA.width), 255, dtype=np.uint8)
    for marker in config.neighbors[0].markers:
        pose = MOUNTING.inverse() @ leader @ marker.T_body_marker
        # A marker half as large looks the same at half the distance.
        scaled = Transform(pose.rotation, pose.translation * (SIDE / marker.side_length))
        alone = render(CAMERA, {marker.marker_id: scaled}, rays=3, noise=0.0, black=30.0,
                       white=200.0)
        empty = render(CAMERA, {}, rays=3, noise=0.0)
        image = np.where(alone != empty, alone, image)
    image = np.where(image == 255, empty, image)
    tracker = Tracker(config, MOUNTING)
    for stamp in (0.98, 1.0, 1.02):
        tracker.feed_odometry(OdometrySample(
            stamp, np.zeros(3), IDENTITY_QUATERNION, np.zeros(3), np.zeros(3)))
    estimate = tracker.process_image(1.0, image, CAMERA).estimates.get('leader')
    return None if estimate is None else estimate.position - leader.translation


@pytest.mark.parametrize(('distance', 'aside', 'up', 'error'), [
    (0.3, 0.2, -0.17, 0.003), (1.4, 0.1, 0.0, 0.01),
    (8.0, 0.1, 0.1, 0.1)])
def test_a_panel_is_seen_from_near_and_far(distance: float, aside: float, up: float,
                                           error: float) -> None:
    off = seen(PANEL, distance, aside, up)
    assert off is not None and np.linalg.norm(off) < error


@pytest.mark.parametrize(('distance', 'aside', 'up'), [(0.3, 0.2, -0.17), (12.0, 0.1, 0.1)])
def test_one_marker_is_not(distance: float, aside: float, up: float) -> None:
    assert seen(SINGLE, distance, aside, up) is None
    off = seen(SINGLE, 1.4, aside, up)
    assert off is not None and np.linalg.norm(off) < 0.01
