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

"""What is drawn of a flight is where geometry says, in the frame of the odometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flock_follower.geometry import (
    Array,
    quaternion_from_yaw,
    quaternion_to_matrix,
    R_FLU_OPTICAL,
    Transform,
)
from flock_follower.messages import Command, OdometryState
from flock_follower.nodes.shapes import (
    ACCELERATION_SCALE,
    Band,
    CameraSight,
    DEGENERATE,
    ellipsoid,
    image_corners,
    PlannerReport,
    Shape,
    shapes,
    SIGHT_DEPTH,
    Snapshot,
)

NOW = 1_700_000_000 * 10**9  # ns
K = [610.0, 0.0, 320.0, 0.0, 610.0, 240.0, 0.0, 0.0, 1.0]
#: Level, its nose to the north; the leader 2 m ahead of it.
OWN = Transform.from_quaternion([1.0, 2.0, 3.0], quaternion_from_yaw(math.pi / 2))
LEADER_AT = np.array([1.0, 4.0, 3.0])


def leader(age: float = 0.0, velocity: tuple[float, float, float] = (0.5, 0.0, 0.0),
           name: str = 'leader') -> OdometryState:
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([0.01, 0.04, 0.0])
    twist = np.zeros((6, 6))
    twist[0, 0] = 0.09
    return OdometryState(
        NOW - round(age * 1e9), 'odom', name, LEADER_AT, quaternion_from_yaw(0.3),
        np.array(velocity), np.zeros(3), covariance, twist, np.eye(3))


def drawn(**known: object) -> dict[str, Shape]:
    given = {'neighbors': [leader()], 'own': (NOW, OWN), **known}
    found = shapes(Snapshot(NOW, **given))
    assert len({shape.name for shape in found}) == len(found)
    return {shape.name: shape for shape in found}


def test_the_leader_is_where_it_is_and_its_arrow_ends_where_it_is_in_a_second() -> None:
    found = drawn()
    np.testing.assert_allclose(found['leader'].position, LEADER_AT)
    np.testing.assert_allclose(found['leader'].quaternion, quaternion_from_yaw(0.3))
    np.testing.assert_allclose(found['leader velocity'].points, [LEADER_AT, [1.5, 4.0, 3.0]])
    assert 'leader last seen' not in found


def test_the_circles_are_the_roots_of_the_band_and_those_of_the_radius_more() -> None:
    found = drawn(band=Band(1.0, 8.0, 0.2))
    for name, radius in (('leader d0', 1.2), ('leader d1', math.sqrt(8.0) + 0.2)):
        away = found[name].points - LEADER_AT
        np.testing.assert_allclose(np.linalg.norm(away, axis=1), radius)
        np.testing.assert_allclose(away[:, 2], 0.0)
        np.testing.assert_allclose(found[name].points[0], found[name].points[-1], atol=1e-12)
    assert 'leader d0' not in drawn()


def test_only_those_attended_to_have_a_band_where_there_are_several() -> None:
    other = leader(name='other')._replace(position=np.array([3.0, 4.0, 3.0]))
    found = drawn(neighbors=[leader(), other], band=Band(1.0, 8.0),
                  planner=PlannerReport('TRACK', edges=('other',)))
    assert 'other d0' in found and 'leader d0' not in found
    np.testing.assert_allclose(found['edges'].points, [OWN.translation, other.position])


@pytest.mark.parametrize(('limits', 'thick', 'thin'), [
    ('a_max, separation', 'leader d0', 'leader d1'), ('cohesion', 'leader d1', 'leader d0')])
def test_the_circle_that_the_guard_holds_is_thick_and_the_command_has_another_colour(
        limits: str, thick: str, thin: str) -> None:
    command = Command(np.array([0.0, 1.0, 0.0]), 0.0, stamp=NOW)
    free = drawn(band=Band(1.0, 8.0), command=command, planner=PlannerReport('TRACK'))
    held = drawn(band=Band(1.0, 8.0), command=command, planner=PlannerReport('TRACK', '', limits))
    assert held[thick].size[0] > 2.0 * held[thin].size[0]
    assert held[thin].size == free[thin].size
    assert held['command'].color != free['command'].color
    assert f'guard: {limits.split(", ")[-1]}' in held['state'].text
    assert free['state'].text == 'TRACK'


def test_the_command_starts_at_the_follower_and_goes_when_it_is_old() -> None:
    command = Command(np.array([0.0, -2.0, 0.5]), 0.0, stamp=NOW - 10**8)
    np.testing.assert_allclose(drawn(command=command)['command'].points, [
        OWN.translation, OWN.translation + ACCELERATION_SCALE * np.array([0.0, -2.0, 0.5])])
    assert 'command' not in drawn(command=command._replace(stamp=NOW - 10**9))


def test_out_of_sight_the_leader_is_where_it_flies_on_to_and_is_less_well_known() -> None:
    found = drawn(neighbors=[leader(age=1.0)], planner=PlannerReport('COAST', 'last seen'))
    np.testing.assert_allclose(found['leader'].position, [1.5, 4.0, 3.0])
    np.testing.assert_allclose(found['leader last seen'].position, LEADER_AT)
    sizes = sorted(found['leader covariance'].size)
    np.testing.assert_allclose(sizes, sorted([
        4.0 * math.sqrt(0.01 + 0.09), 4.0 * 0.2, DEGENERATE]))
    assert 'not seen for 1.0 s' in found['leader name'].text
    assert found['state'].text == 'COAST\nlast seen'
    later = drawn(neighbors=[leader(age=8.0)])
    np.testing.assert_allclose(later['leader'].position, [2.0, 4.0, 3.0])  # not for ever
    assert 'leader' not in drawn(neighbors=[leader(age=11.0)])


def test_an_ellipsoid_has_the_covariance_it_is_made_of() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        root = rng.normal(size=(3, 3))
        covariance = root @ root.T
        shape = ellipsoid('', np.zeros(3), covariance, 1.0, (0.0, 0.0, 0.0, 1.0))
        axes = quaternion_to_matrix(shape.quaternion)
        again = axes @ np.diag(np.square(np.array(shape.size) / 2.0)) @ axes.T
        np.testing.assert_allclose(again, covariance, atol=1e-9)


def sight(corners: Array, position: tuple[float, float, float] = (0.1, 0.0, 0.0)) -> Array:
    camera = CameraSight(Transform(R_FLU_OPTICAL, np.array(position)), corners)
    return drawn(cameras={'': camera})['sight'].points


def test_the_field_of_view_opens_ahead_of_the_camera() -> None:
    points = sight(image_corners(640, 480, K))
    np.testing.assert_allclose(points[0], [1.0, 2.1, 3.0])  # ahead is north
    base = points[1::4]  # of each edge of the pyramid the far end
    away = base - [1.0, 2.1, 3.0]
    np.testing.assert_allclose(away[:, 1], SIGHT_DEPTH)
    # Top left of the image: to the west, and up.
    np.testing.assert_allclose(away[0], SIGHT_DEPTH * np.array([-320 / 610, 1.0, 240 / 610]))


def test_a_fisheye_lens_is_drawn_by_its_angles() -> None:
    corners = image_corners(848, 800, [286.0, 0, 424.0, 0, 286.0, 400.0, 0, 0, 1], fisheye=True)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), SIGHT_DEPTH)
    assert np.all(corners[:, 2] > 0.0)
    with pytest.raises(ValueError, match='must all be above 0'):
        image_corners(640, 480, np.zeros(9))


def test_what_does_not_move_has_no_arrow() -> None:
    assert 'leader velocity' not in drawn(neighbors=[leader(velocity=(0.0, 0.0, 0.0))])
    assert 'command' not in drawn(command=Command(np.zeros(3), 0.0, stamp=NOW))


def test_without_odometry_only_the_neighbours_are_drawn() -> None:
    assert set(drawn(own=None)) == {
        'leader', 'leader velocity', 'leader covariance', 'leader name'}
