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

"""Whether a marker shows its code."""

from __future__ import annotations

import math
from typing import Any

import cv2
from marker_images import DICTIONARY
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.parameters.neighbors_file import Marker
from flock_follower.perception import markers as aruco
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import cell_code, CellCode, shows_code

DICTIONARIES = ('DICT_4X4_50', 'DICT_5X5_100', 'DICT_6X6_250', 'DICT_7X7_50',
                'DICT_ARUCO_ORIGINAL', 'DICT_APRILTAG_36h11')
PX = 10  # per cell
AROUND = 4  # cells of the picture either side of the marker


def code_of(marker_id: int, dictionary: str = DICTIONARY) -> CellCode:
    return cell_code(Marker(marker_id, 0.16, Transform()), dictionary)


def picture(cells: Any, black: int = 30, white: int = 200) -> GrayImage:
    """Return a drawing of cells, True where white, amid a quiet zone and a gray background."""
    size = len(cells) + 2 * AROUND
    levels = np.full((size, size), (black + white) // 2)
    levels[AROUND - 1:1 - AROUND, AROUND - 1:1 - AROUND] = white
    levels[AROUND:-AROUND, AROUND:-AROUND] = np.where(cells, white, black)
    return np.kron(levels, np.ones((PX, PX))).astype(np.uint8)


def places(code: CellCode, right: float = 0.0, down: float = 0.0) -> Array:
    """Return where the cells' middles are in a picture, px; they may be off by some cells."""
    pixels: Array = (code.grid + AROUND + 0.5 + np.array([right, down])) * PX - 0.5
    return pixels


def shown(cells: Any, code: CellCode, tracked: bool = False, **levels: int) -> bool:
    return shows_code(picture(cells, **levels), places(code), code, tracked)


def with_flipped(cells: Any, *inner: int) -> Any:
    """Return cells of which some inner ones, counted along the rows, are the wrong way."""
    cells = cells.copy()
    for k in inner:
        row, column = 1 + k // (len(cells) - 2), 1 + k % (len(cells) - 2)
        cells[row, column] = not cells[row, column]
    return cells


@pytest.mark.parametrize('marker_id', range(50))
def test_turned_mirrored_inverted_markers_do_not_show_code(marker_id: int) -> None:
    cells, code = aruco.marker_code(DICTIONARY, marker_id), code_of(marker_id)
    assert shown(cells, code)
    for quarters in (1, 2, 3):
        assert not shown(np.rot90(cells, quarters), code)
    assert not shown(~cells, code)
    assert not shows_code(255 - picture(cells), places(code), code)
    for mirrored in (np.fliplr(cells), np.flipud(cells)):
        # One word of 4x4 is its own mirror image: nothing tells those apart.
        assert shown(mirrored, code) == (marker_id == 17 and np.array_equal(mirrored, cells))


@pytest.mark.parametrize('dictionary', DICTIONARIES)
def test_as_many_cells_as_can_be_corrected_may_be_wrong(dictionary: str) -> None:
    code, cells = code_of(7, dictionary), aruco.marker_code(dictionary, 7)
    assert code.errors == max(aruco.correctable_cells(dictionary), 1)
    rng = np.random.default_rng(6)
    for _ in range(20):
        flipped = rng.permutation(code.bits.size)
        if dictionary != 'DICT_ARUCO_ORIGINAL':  # there, a cell off may be another word
            assert shown(with_flipped(cells, *flipped[:code.errors]), code, tracked=True)
        assert not shown(with_flipped(cells, *flipped[:code.errors + 1]), code, tracked=True)
        # A print with so many clearly wrong cells is not found in the first place.
        assert not shown(with_flipped(cells, *flipped[:max(code.errors + 1 >> 1, 1)]), code)


def test_mirrored_print_is_not_found_though_few_cells_differ() -> None:
    cells, code = aruco.marker_code('DICT_5X5_100', 25), code_of(25, 'DICT_5X5_100')
    alike = min((np.rot90(np.fliplr(cells), k) for k in range(4)), key=lambda c: (c ^ cells).sum())
    assert np.count_nonzero(alike ^ cells) == 2 < code.errors
    assert not shown(alike, code)


@pytest.mark.parametrize('clarity', [0.1, 0.9])
def test_what_is_nearer_to_another_word_does_not_show_the_code(clarity: float) -> None:
    # One cell is wrong, which is allowed, and the others by which the nearest word differs are
    # hardly, or clearly, as they should be.
    code, cells = code_of(7), aruco.marker_code(DICTIONARY, 7)
    other = code.others[int(np.argmax(code.others @ code.bits))]
    wrong, *unclear = np.flatnonzero(other != code.bits).tolist()
    assert len(unclear) >= 2
    image = picture(with_flipped(cells, wrong))
    for k in unclear:
        column, row = (code.grid[k] + AROUND) * PX
        image[row:row + PX, column:column + PX] = round(115.0 + 85.0 * clarity * code.bits[k])
    assert shows_code(image, places(code), code, tracked=True) == (clarity > 0.5)


def test_contrast_must_be_enough_and_the_border_black() -> None:
    code, cells = code_of(5), aruco.marker_code(DICTIONARY, 5)
    assert shown(cells, code, black=100, white=115)
    assert not shown(cells, code, black=100, white=108)
    assert not shown(cells, code, black=100, white=100)
    image = picture(cells)
    image[:, :(AROUND + 1) * PX] = 200  # a quarter of the border covered
    assert shows_code(image, places(code), code)
    image[:, -(AROUND + 1) * PX:] = 200
    image[:(AROUND + 1) * PX] = 200
    assert not shows_code(image, places(code), code)


@pytest.mark.parametrize(('white', 'hidden', 'is_shown'), [
    (200, 2, True), (200, 3, False), (255, 2, False)])
def test_reflex_may_hide_cells_unless_paper_is_saturated(
        white: int, hidden: int, is_shown: bool) -> None:
    code, cells = code_of(5), aruco.marker_code(DICTIONARY, 5)
    image = picture(cells, white=white)
    for k in np.flatnonzero(code.bits < 0.0)[:hidden]:
        column, row = (code.grid[k] + AROUND) * PX
        image[row:row + PX, column:column + PX] = 255
    assert shows_code(image, places(code), code) == is_shown


def shaded(image: GrayImage, direction: float, offset: float, light: float) -> GrayImage:
    """Return an image half of which lies in shade, from ``offset`` cells past the middle on."""
    v, u = np.mgrid[:image.shape[0], :image.shape[1]] - (len(image) - 1) / 2.0
    dark = u * np.cos(direction) + v * np.sin(direction) > offset * PX
    return np.where(dark, np.rint(light * image), image).astype(np.uint8)


@pytest.mark.parametrize('light', [0.15, 0.3, 0.5])
@pytest.mark.parametrize('dictionary', ['DICT_4X4_50', 'DICT_5X5_100', 'DICT_7X7_50'])
def test_the_edge_of_a_shadow_does_not_hide_the_code(dictionary: str, light: float) -> None:
    rng = np.random.default_rng(12)
    for marker_id in range(12):
        code, cells = code_of(marker_id, dictionary), aruco.marker_code(dictionary, marker_id)
        for _ in range(6):
            image = shaded(picture(cells, black=12), rng.uniform(0.0, 2.0 * np.pi),
                           rng.uniform(-0.4, 0.4) * len(cells), light)
            assert shows_code(image, places(code), code), marker_id


@pytest.mark.parametrize('count', [18, pytest.param(60, marks=pytest.mark.sweep)])
@pytest.mark.parametrize('dictionary', DICTIONARIES)
def test_no_other_marker_shows_code_in_even_light_or_shade(
        dictionary: str, count: int) -> None:
    rng, code = np.random.default_rng(13), code_of(3, dictionary)
    for marker_id in range(min(aruco.dictionary_size(dictionary), count)):
        for quarters in range(4):
            cells = np.rot90(aruco.marker_code(dictionary, marker_id), quarters)
            image = picture(cells, black=12)
            assert shows_code(image, places(code), code) == ((marker_id, quarters) == (3, 0))
            if (marker_id, quarters) != (3, 0):
                image = shaded(image, rng.uniform(0.0, 2.0 * np.pi),
                               rng.uniform(-0.4, 0.4) * len(cells), rng.uniform(0.1, 0.6))
                assert not shows_code(image, places(code), code), (marker_id, quarters)


@pytest.mark.parametrize(('level', 'share'), [(255, 0.4), (200, 0.4), (115, 0.4), (30, 0.4)])
def test_no_other_marker_that_is_half_hidden_shows_code(
        level: int, share: float) -> None:
    rng, dictionary = np.random.default_rng(2), DICTIONARY
    radius = PX * math.sqrt(share * 16 / math.pi)
    shown_tracked = 0
    for marker_id in range(0, 50, 5):
        code = code_of(marker_id)
        for other in range(50):
            if other == marker_id:
                continue
            image = picture(aruco.marker_code(dictionary, other))
            x, y = (AROUND + 1 + rng.uniform(0.0, 4.0, 2)) * PX
            cv2.circle(image, (round(x), round(y)), round(radius), level, -1)
            assert not shows_code(image, places(code), code), (marker_id, other)
            shown_tracked += shows_code(image, places(code), code, True)
    # A saturated disc hides white and black cells alike: of a tracked marker few words are left.
    assert shown_tracked <= (10 if level == 255 else 0)


@pytest.mark.parametrize('off', [(9000.0, 0.0), (-9000.0, 50.0), (0.0, 1e6)])
def test_places_outside_the_image_show_nothing(off: tuple[float, float]) -> None:
    code, image = code_of(5), picture(aruco.marker_code(DICTIONARY, 5))
    assert not shows_code(image, places(code) + off, code)
