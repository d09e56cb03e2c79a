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

"""The colours of cells in uneven light: each by the cells around it."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.perception import markers as aruco
from flock_follower.perception.print_model import read, SHAPES, Windows, windows


def cells_of(dictionary: str, marker_id: int) -> Array:
    """Return a marker's cells with its quiet zone, bool."""
    return np.pad(aruco.marker_code(dictionary, marker_id), 1, constant_values=True)


def on(cells: Array) -> Windows:
    grid = np.stack([axis.ravel() for axis in np.indices(cells.shape)[::-1]], axis=1)
    return windows(grid.astype(float), cells.ravel())


CELLS = cells_of('DICT_4X4_50', 3)
SEEN = on(CELLS)
SIGNS = np.where(CELLS, 1.0, -1.0)
LEVELS = np.where(CELLS, 200.0, 10.0)


def colours(brightness: Array) -> Array:
    return read(brightness.reshape(1, -1), SEEN).reshape(CELLS.shape)


@pytest.mark.parametrize('dictionary', [
    'DICT_4X4_50', 'DICT_5X5_250', 'DICT_6X6_250', 'DICT_7X7_250', 'DICT_ARUCO_ORIGINAL',
    'DICT_APRILTAG_36h11'])
def test_every_cell_of_every_marker_has_windows_and_is_read_in_them(dictionary: str) -> None:
    for marker_id in range(0, aruco.dictionary_size(dictionary), 11):
        cells = cells_of(dictionary, marker_id)
        seen = on(cells)
        assert seen.cells.shape == seen.white.shape == seen.black.shape
        assert seen.cells.shape[1] == max(width * height for width, height in SHAPES)
        for k, some in enumerate(seen.places):
            assert (seen.cells.ravel()[some] == k).all()
            assert ((seen.white + seen.black).ravel()[some] == 1.0).all()
        np.testing.assert_allclose(
            read(np.where(cells, 90.0, 20.0).reshape(1, -1), seen).ravel(),
            np.where(cells, 1.0, -1.0).ravel())


@pytest.mark.parametrize('half', [np.s_[:, 4:], np.s_[:3], np.s_[2:5], np.s_[:, 3:6]],
                         ids=['right', 'upper', 'rows', 'columns'])
@pytest.mark.parametrize('light', [0.1, 0.3, 0.6])
def test_white_in_the_shade_is_white_and_black_in_the_light_is_black(
        half: tuple[slice, slice], light: float) -> None:
    levels = LEVELS.copy()
    levels[half] *= light
    np.testing.assert_allclose(colours(levels), SIGNS, atol=0.3)


def test_light_that_fades_across_the_marker_changes_nothing() -> None:
    fading = np.linspace(1.0, 0.3, 8)[:, None] * np.linspace(1.0, 0.6, 8)
    assert (colours(LEVELS * fading) * SIGNS > 0.5).all()


@pytest.mark.parametrize('place', [(2, 2), (3, 4), (5, 5), (1, 1), (4, 2)])
def test_a_cell_of_the_wrong_colour_is_read_as_it_is_and_hardly_changes_others(
        place: tuple[int, int]) -> None:
    for shade in (1.0, 0.2):
        levels = LEVELS.copy()
        levels[place] = 10.0 if CELLS[place] else 200.0
        levels[:, 4:] *= shade
        wrong = colours(levels) * SIGNS < 0.0
        assert wrong[place]
        assert np.count_nonzero(wrong) <= 2


@pytest.mark.parametrize('levels', [
    np.full((8, 8), 77.0), np.zeros((8, 8)), np.where(CELLS, 12.0, 10.0),
    np.random.default_rng(3).uniform(0.0, 255.0, (8, 8))],
    ids=['flat', 'dark', 'faint', 'random'])
def test_where_nothing_is_as_it_should_be_nothing_is_told(levels: Array) -> None:
    told = colours(levels)
    assert np.isfinite(told).all()
    assert np.count_nonzero(told * SIGNS > 0.5) < (1 if levels.std() < 5.0 else 30)


def test_several_readings_are_each_by_itself() -> None:
    both = read(np.stack([LEVELS.ravel(), 0.3 * LEVELS[::-1].ravel()]), SEEN)
    np.testing.assert_array_equal(both[0], read(LEVELS.reshape(1, -1), SEEN)[0])
    np.testing.assert_array_equal(both[1], read(0.3 * LEVELS[::-1].reshape(1, -1), SEEN)[0])
