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

"""The edges of markers against the pictures of them: places, directions, room, and parts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flock_follower.geometry import Array, rotation_vector_to_matrix, Transform
from flock_follower.perception import markers as aruco
from flock_follower.perception.markers import MarkedNeighbor, Marker
from flock_follower.perception.print_model import DERIVATIVES, edge_model, EdgeModel

PX = 20  # per cell of a picture
DICTIONARIES = aruco.dictionary_names()


def in_cells(dictionary: str, marker_id: int) -> EdgeModel:
    """Return a model whose lengths are cells, and whose body is the marker's frame."""
    side = float(aruco.marker_cells(dictionary))
    neighbor = MarkedNeighbor('leader', (Marker(marker_id, side, Transform()),))
    return edge_model(neighbor, dictionary)


class Picture:
    """The drawing of a marker with a quiet zone of one cell, looked up at places in its frame."""

    def __init__(self, dictionary: str, marker_id: int) -> None:
        self.cells = aruco.marker_cells(dictionary)
        drawn = aruco.draw_marker(dictionary, marker_id, PX * self.cells)
        self._white = np.pad(drawn, PX, constant_values=255) > 127

    def white(self, places: Array) -> Any:
        """Return what is white at places (n, 2), cells, x right and y up from the middle."""
        half = self.cells / 2.0 + 1.0
        column, row = np.floor(PX * (half + places * [1.0, -1.0])).astype(int).T
        return self._white[row, column]


def left_of(tangents: Array) -> Array:
    return np.column_stack([-tangents[:, 1], tangents[:, 0]])


def some_ids(dictionary: str) -> list[int]:
    size = aruco.dictionary_size(dictionary)
    return sorted({0, 1, size // 3, size - 1})


@pytest.mark.parametrize('dictionary', DICTIONARIES)
def test_every_point_is_where_black_on_the_left_meets_white_on_the_right(dictionary: str) -> None:
    for marker_id in some_ids(dictionary):
        model, picture = in_cells(dictionary, marker_id), Picture(dictionary, marker_id)
        points, tangents = model.places[:len(model), :2], model.tangents[:, :2]
        np.testing.assert_array_equal(model.places[:, 2], 0.0)
        np.testing.assert_array_equal(model.tangents[:, 2], 0.0)
        np.testing.assert_array_equal(np.linalg.norm(tangents, axis=1), 1.0)
        # Also a third of a cell further along: corners are farther away than blur reaches.
        for along in (-0.35, 0.0, 0.35):
            place = points + along * tangents
            assert not picture.white(place + 0.06 * left_of(tangents)).any()
            assert picture.white(place - 0.06 * left_of(tangents)).all()


@pytest.mark.parametrize('dictionary', DICTIONARIES)
def test_room_ends_where_the_next_edge_is(dictionary: str) -> None:
    for marker_id in some_ids(dictionary):
        model, picture = in_cells(dictionary, marker_id), Picture(dictionary, marker_id)
        points, left = model.places[:len(model), :2], left_of(model.tangents[:, :2])
        for side, (outwards, is_white) in enumerate(((left, False), (-left, True))):
            room = model.room[:, side]
            assert room.min() >= 1.0
            for share in (0.02, 0.5, 0.98):
                place = points + (share * room)[:, None] * outwards
                assert (picture.white(place) == is_white).all()
            end = points + (room + 0.06)[:, None] * outwards
            # No more of the paper around than the quiet zone can be relied upon.
            paper = np.abs(end).max(axis=1) > picture.cells / 2.0 + 1.0
            assert (picture.white(end[~paper]) != is_white).all()
            assert not (paper.any() and not is_white)


@pytest.mark.parametrize('dictionary', DICTIONARIES)
def test_no_stretch_of_an_edge_goes_without_a_point(dictionary: str) -> None:
    model, picture = in_cells(dictionary, 1), Picture(dictionary, 1)
    half = picture.cells / 2.0
    points = model.places[:len(model), :2]
    lines, middles = np.arange(-half, half + 0.5), np.arange(-half + 0.5, half)
    for axis in (0, 1):
        for line in lines:
            for middle in middles:
                place, step = np.array([line, middle]), np.array([0.3, 0.0])
                if axis:
                    place, step = place[::-1], step[::-1]
                edge = (picture.white((place - step)[None])
                        != picture.white((place + step)[None]))[0]
                near = ((model.axis == axis) & (points[:, axis] == line)
                        & (np.abs(points[:, 1 - axis] - middle) <= 0.5 + 1e-9))
                assert near.any() == edge


def test_axis_is_the_one_that_the_edge_is_across() -> None:
    model = in_cells('DICT_4X4_50', 0)
    np.testing.assert_array_equal(model.tangents[model.axis == 0][:, 0], 0.0)
    np.testing.assert_array_equal(model.tangents[model.axis == 1][:, 1], 0.0)
    assert [model.axis[k] for k in model.examples] == [0, 1]
    # White that swells moves an edge against its normal, which points from black to white.
    assert set(map(tuple, model.bloom[model.axis == 0])) == {(-1.0, 0.0)}
    assert set(map(tuple, model.bloom[model.axis == 1])) == {(0.0, -1.0)}
    np.testing.assert_array_equal(model.begins, DERIVATIVES * np.arange(len(model)))
    assert model.narrowest == (1.0, 1.0)


def mounted() -> MarkedNeighbor:
    """Return a neighbour with markers of two sizes, each turned and placed its own way."""
    return MarkedNeighbor('leader', tuple(
        Marker(marker_id, side, Transform(rotation_vector_to_matrix(turn), np.array(place)))
        for marker_id, side, turn, place in (
            (3, 0.16, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
            (5, 0.08, (0.4, -0.2, 0.1), (0.2, 0.1, -0.05)),
            (9, 0.12, (0.0, 1.5, 0.0), (-0.2, 0.0, 0.1)))))


def test_each_marker_is_placed_on_the_body_as_mounted() -> None:
    neighbor = mounted()
    model = edge_model(neighbor, 'DICT_4X4_50')
    for k, marker in enumerate(neighbor.markers):
        alone = in_cells('DICT_4X4_50', marker.marker_id)
        cell, edges, T = marker.side_length / 6.0, model.marker == k, marker.T_body_marker
        np.testing.assert_allclose(model.places[:len(model)][edges],
                                   T.apply(cell * alone.places[:len(alone)]), atol=1e-15)
        np.testing.assert_allclose(model.places[len(model):][model.cell_marker == k],
                                   T.apply(cell * alone.places[len(alone):]), atol=1e-15)
        np.testing.assert_allclose(model.tangents[edges], alone.tangents @ T.rotation.T)
        np.testing.assert_allclose(model.room[edges], cell * alone.room)
        np.testing.assert_array_equal(model.axis[edges], alone.axis)
        np.testing.assert_allclose(model.centers[k], T.translation)
        np.testing.assert_allclose(model.facings[k], T.rotation @ [0.0, 0.0, 1.0])
    np.testing.assert_allclose(model.narrowest, 0.08 / 6.0)


@pytest.mark.parametrize('chosen', [(0,), (1,), (2,), (0, 2), (1, 2)])
def test_only_some_markers_are_a_model_of_those_alone(chosen: tuple[int, ...]) -> None:
    neighbor = mounted()
    whole = edge_model(neighbor, 'DICT_4X4_50')
    choice = np.isin(np.arange(3), chosen)
    part = whole.only(choice)
    fresh = edge_model(
        MarkedNeighbor('part', tuple(neighbor.markers[k] for k in chosen)), 'DICT_4X4_50')
    for name in ('places', 'tangents', 'axis', 'room', 'marker', 'cell_marker', 'centers',
                 'facings', 'bloom', 'begins'):
        np.testing.assert_array_equal(getattr(part, name), getattr(fresh, name), err_msg=name)
    assert (part.examples, part.narrowest) == (fresh.examples, fresh.narrowest)
    assert part.codes == tuple(whole.codes[k] for k in chosen)
    assert whole.only(choice) is part  # made once


def test_all_markers_are_the_model_itself() -> None:
    model = edge_model(mounted(), 'DICT_4X4_50')
    assert model.only(np.ones(3, dtype=bool)) is model


@pytest.mark.parametrize('marker_id', [-1, 50])
def test_a_marker_the_dictionary_lacks_is_refused(marker_id: int) -> None:
    with pytest.raises(ValueError, match=rf'marker_id = {marker_id}: DICT_4X4_50 has 0 to 49'):
        in_cells('DICT_4X4_50', marker_id)
