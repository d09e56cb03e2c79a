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

from flock_follower.geometry import Array, Transform
from flock_follower.perception import markers as aruco
from flock_follower.perception.markers import MarkedNeighbor, Marker
from flock_follower.perception.print_model import edge_model, EdgeModel

PX = 20  # per cell of a picture
DICTIONARIES = ('DICT_4X4_50', 'DICT_6X6_250', 'DICT_ARUCO_ORIGINAL')


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
