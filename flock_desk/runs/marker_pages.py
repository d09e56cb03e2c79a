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

"""Markers on pages, to scale, each with the white border that detection needs, and a ruler."""

from __future__ import annotations

import math

from flock_desk.runs.drawing import Box, Drawing, Text
from flock_follower.perception.markers import draw_marker, marker_cells

#: Width and height, mm.
PAGES = {'A4': (210.0, 297.0), 'A3': (297.0, 420.0), 'A2': (420.0, 594.0)}

# White around the black border is a cell wide, and no less than this share of the side: OpenCV 4.6
# drops a square with another, here the paper's edge, within 0.05 of its perimeter.
MIN_QUIET = 0.16
MARGIN = 5.0  # mm, along a page's edge where printers do not print
LINE = 0.2  # mm
CAPTION = (100.0, 30.0)  # mm, with the ruler, whose length is the caption's width


def choose_page(page: str, dictionary: str, side_length: float) -> str:
    """
    Return the page that a marker of a side length, m, is drawn on.

    ``page`` is a key of ``PAGES`` or 'exact', and then returned as it is, or 'auto' for the
    smallest from A4 up.

    :raises ValueError: for an unknown page, and one too small, naming one that is not.
    """
    return fitting_page(page, *_needed(dictionary, side_length),
                        f'a marker of {side_length:g} m')


def fitting_page(page: str, width: float, height: float, what: str) -> str:
    """Return the page for something so large, mm, with its caption; see :func:`choose_page`."""
    if page not in (*PAGES, 'auto', 'exact'):
        raise ValueError(f'page = {page!r}: must be one of auto, {", ".join(PAGES)}, exact')
    if page == 'exact':
        return page
    fitting = [name for name, size in PAGES.items() if size[0] >= width and size[1] >= height]
    if page in fitting or (page == 'auto' and fitting):
        return fitting[0] if page == 'auto' else page
    raise ValueError(
        f'page = {page!r}: {what} with its white border and caption takes '
        f'{math.ceil(width)} x {math.ceil(height)} mm; use --page {[*fitting, "exact"][0]}')


def _needed(dictionary: str, side_length: float) -> tuple[float, float]:
    """Return the width and height, mm, of a page that holds a marker."""
    outer = outer_side(dictionary, side_length)
    return max(outer, CAPTION[0]) + 2.0 * MARGIN, outer + CAPTION[1] + 2.0 * MARGIN


def largest_on_a4(dictionary: str) -> float:
    """Return the longest side, m, of a marker on A4, whose width is what limits it."""
    marks = 2.0 * LINE
    side = (PAGES['A4'][0] - 2.0 * MARGIN - marks) / (outer_side(dictionary, 1.0) - marks)
    return math.floor(1e3 * side) / 1e3


def outer_side(dictionary: str, side_length: float) -> float:
    """Return the side, mm, of a marker with its white border and the corner marks around it."""
    quiet = max(1.0 / marker_cells(dictionary), MIN_QUIET)
    return 1e3 * side_length * (1.0 + 2.0 * quiet) + 2.0 * LINE


def draw(dictionary: str, marker_id: int, side_length: float, page: str) -> Drawing:
    """
    Return a marker of a side length, m, on a page that :func:`choose_page` returned.

    :raises ValueError: for an unknown dictionary or id.
    """
    needed = _needed(dictionary, side_length)
    width, height = needed if page == 'exact' else PAGES[page]
    outer, side = outer_side(dictionary, side_length), 1e3 * side_length
    left, top = 0.5 * (width - outer), MARGIN + 0.5 * (height - needed[1])
    inset = 0.5 * (outer - side)
    caption, ruler = caption_at(
        0.5 * (width - CAPTION[0]), top + outer,
        f'{dictionary}   id {marker_id}   side {side:g} mm',
        'Print at 100 % (actual size); do not fit to page.',
        f'Check: this ruler is 100 mm, the black square {side:g} mm.',
        'Cut at the corner marks: the white border is part of it.')
    boxes = [*cells_of(dictionary, marker_id, left + inset, top + inset, side),
             *corner_marks(left, top, outer, outer), *ruler]
    return Drawing(width, height, tuple(boxes), tuple(caption))


def cells_of(dictionary: str, marker_id: int, left: float, top: float, side: float) -> list[Box]:
    """Return a marker's black cells, those beside each other in a row as one box."""
    cells = marker_cells(dictionary)
    black = draw_marker(dictionary, marker_id, cells) < 128
    edges = [k * side / cells for k in range(cells + 1)]
    boxes = []
    for row in range(cells):
        column = 0
        while column < cells:
            end = column
            while end < cells and black[row, end]:
                end += 1
            if end > column:
                boxes.append((left + edges[column], top + edges[row],
                              edges[end] - edges[column], edges[row + 1] - edges[row]))
            column = end + 1
    return boxes


def corner_marks(left: float, top: float, width: float, height: float) -> list[Box]:
    """Return angles along the inside of a rectangle: they show where to cut."""
    arm = min(8.0, 0.25 * min(width, height))
    right, bottom = left + width - LINE, top + height - LINE
    boxes = []
    for x, along_x in ((left, left), (right, left + width - arm)):
        for y, along_y in ((top, top + LINE), (bottom, top + height - arm)):
            boxes += [(along_x, y, arm, LINE), (x, along_y, LINE, arm - LINE)]
    return boxes


def caption_at(left: float, top: float, *lines: str) -> tuple[list[Text], list[Box]]:
    """Return lines of text, the first a title, and under them a ruler of 100 mm."""
    texts = [Text(left, top + 6.0 + 4.0 * n, 3.6 if n == 0 else 2.6, line)
             for n, line in enumerate(lines)]
    y = top + 22.0
    texts += [Text(left + at, y + 7.0, 2.6, label)
              for at, label in ((0.0, '0'), (50.0, '50'), (100.0 - 11.0, '100 mm'))]
    # The first and last tick end where the ruler ends: 100 mm from outer edge to outer edge.
    ticks = [(left + at - LINE * at / 100.0, y + LINE, LINE, 3.5 if at % 50 == 0 else 2.0)
             for at in range(0, 101, 10)]
    return texts, [(left, y, 100.0, LINE), *ticks]

