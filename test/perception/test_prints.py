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

"""Prints that are not what the file says: of another border, or turned."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

from marker_images import facing, Hovering, make_camera, render, SIDE, TAIL
import numpy as np
import pytest

from flock_follower.checks.collector import Collector, INVERTED, MIRRORED
from flock_follower.checks.observations import Observations, Picture
from flock_follower.geometry import Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker, NeighborConfig
from flock_follower.perception import prints
from flock_follower.perception.look import Sighting
from flock_follower.perception.markers import marker_code
from flock_follower.perception.tracker import camera_mounting

CAMERA = make_camera(width=320, height=240)
MOST_IMAGES = 11  # at 30 Hz, until a print is used or refused
CASES = [('DICT_4X4_50', 0, 2), ('DICT_5X5_100', 33, 3), ('DICT_APRILTAG_36h11', 3, 2)]


def printed(dictionary: str, marker_id: int, border: int = 1, quarters: int = 0) -> Any:
    """Return the cells of a print, turned left by quarters of a turn."""
    return np.rot90(np.pad(marker_code(dictionary, marker_id)[1:-1, 1:-1], border), quarters)


def seen(dictionary: str, marker_id: int, code: Any) -> Sighting:
    marker = Marker(marker_id, SIDE, TAIL)
    hovering = Hovering(CAMERA, camera_mounting((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)), config=(
        NeighborConfig(dictionary, (MarkedNeighbor('leader', (marker,)),))))
    pose = facing((0.05, -0.05, 1.2), (0.15, 0.35, 0.05))
    image = render(CAMERA, {0: pose}, codes={0: code}, rays=3)
    sightings = (hovering.see(image) for _ in range(MOST_IMAGES))
    return next((each for each in sightings if each.estimates or each.misprints), Sighting())


def test_print_of_the_file_is_used() -> None:
    sighting = seen('DICT_4X4_50', 0, printed('DICT_4X4_50', 0))
    assert [*sighting.estimates] == ['leader']
    assert not sighting.misprints


@pytest.mark.parametrize(('dictionary', 'marker_id', 'border'), CASES)
def test_print_with_a_wide_border_is_refused(
        dictionary: str, marker_id: int, border: int) -> None:
    sighting = seen(dictionary, marker_id, printed(dictionary, marker_id, border))
    assert not sighting.estimates
    assert sighting.misprints['leader'].reason == prints.WRONG_BORDER


@pytest.mark.parametrize('quarters', [1, 2])
def test_turned_print_is_refused(quarters: int) -> None:
    sighting = seen('DICT_4X4_50', 0, printed('DICT_4X4_50', 0, quarters=quarters))
    assert not sighting.estimates
    assert sighting.misprints['leader'].reason == prints.TURNED


@pytest.mark.parametrize('quarters', [1, 2, 3])
def test_proposed_mounting_is_upright(quarters: int) -> None:
    marker = Marker(0, SIDE, TAIL)
    right = facing((0.0, 0.0, 1.2), (0.0, 0.4, 0.0))
    turn = Transform(rotation_vector_to_matrix((0.0, 0.0, 0.5 * math.pi * quarters)))
    pose = right @ turn @ TAIL.inverse()
    up = np.array([0.0, -1.0, 0.0])
    fault = prints.turned_print(pose, up, marker)
    assert fault is not None
    assert any(prints.lean((right @ turn).rotation @ prints.mounted_turned(marker, k).T, up) < 0.1
               for k in range(4))
    rpy = fault.remedy.partition('[')[2].rstrip(']').split(', ')
    assert len(rpy) == 3, fault.remedy


def test_lying_marker_is_judged_by_its_body() -> None:
    flat = Transform(np.eye(3), np.array([0.0, 0.0, 0.1]))  # on top, facing upwards
    pose = Transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0]))  # seen from above
    assert prints.turned_print(pose, np.array([0.0, 0.0, -1.0]), Marker(0, SIDE, flat)) is None


def picture_of(code: Any) -> Picture:
    """Return what check finds in an image of marker 0 with these cells."""
    marker = Marker(0, SIDE, TAIL)
    config = NeighborConfig('DICT_4X4_50', (MarkedNeighbor('leader', (marker,)),))
    image = render(CAMERA, {0: facing((0.05, -0.05, 1.2), (0.15, 0.35, 0.05))}, codes={0: code},
                   rays=3)
    collector = Collector(Observations(live=False), 1.0)
    collector.take('image_raw', '/image_raw', SimpleNamespace(
        width=320, height=240, encoding='mono8', step=320, is_bigendian=0, data=image.tobytes()),
        0.0)
    collector.finish(config)
    (picture,) = collector.observations.pictures
    return picture


@pytest.mark.parametrize(('code', 'reason'), [
    (printed('DICT_4X4_50', 0, 2), prints.WRONG_BORDER),
    (printed('DICT_4X4_50', 0)[:, ::-1], MIRRORED),
    # Its margin is inverted, too: OpenCV 4.6 does not find it in a white one.
    (np.pad(~printed('DICT_4X4_50', 0), 1), INVERTED)])
def test_check_counts_a_print_that_was_refused_as_misprint(code: Any, reason: str) -> None:
    picture = picture_of(code)
    assert not picture.markers
    assert picture.misprints[0].reason == reason


def test_another_marker_is_no_mirrored_one() -> None:
    picture = picture_of(printed('DICT_4X4_50', 7))
    assert picture.markers and not picture.misprints
