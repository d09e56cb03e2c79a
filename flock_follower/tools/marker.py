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

"""
``ros2 run flock_follower marker --id 0 --dictionary DICT_4X4_50 --size 0.16 --output marker.pdf``.

Draws markers to scale, one to a page, each with the white border that detection needs, and prints
the entry for the neighbours file. Two runs write the same bytes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import math
from pathlib import Path
import sys
from typing import NoReturn

from flock_follower.perception.aruco import dictionary_size, draw_marker, marker_cells
from flock_follower.perception.neighbors import SIDE_LENGTHS
from flock_follower.tools.drawing import Box, Drawing, pdf, png, svg, Text

#: Width and height, mm.
PAGES = {
    'A5': (148.0, 210.0), 'A4': (210.0, 297.0), 'A3': (297.0, 420.0), 'A2': (420.0, 594.0),
    'A1': (594.0, 841.0), 'A0': (841.0, 1189.0), 'Letter': (215.9, 279.4),
    'Legal': (215.9, 355.6), 'Tabloid': (279.4, 431.8)}
AUTOMATIC = ('A4', 'A3', 'A2', 'A1', 'A0')  # the first that holds the marker
SUFFIXES = ('.pdf', '.svg', '.png')

# White around the black border is a cell wide, and no less than this share of the side: OpenCV 4.6
# drops a square with another, here the paper's edge, within 0.05 of its perimeter.
MIN_QUIET = 0.16
MARGIN = 5.0  # mm, along a page's edge where printers do not print
LINE = 0.2  # mm
CAPTION = (100.0, 30.0)  # mm, with the ruler, whose length is the caption's width


def main(args: Sequence[str] | None = None) -> int:
    """Write the file and return the exit code."""
    try:
        options = _parser().parse_args(args)
        page = _write(options)
    except (OSError, ValueError) as error:
        print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    print(f'{options.output}: page {page}', file=sys.stderr)
    print(snippet(options.dictionary, options.id, options.size))
    return 0


def _write(options: argparse.Namespace) -> str:
    """Write the file and return its page's name and size."""
    SIDE_LENGTHS.check('size', options.size)
    suffix = options.output.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f'output = {options.output}: must end in {", ".join(SUFFIXES)}')
    if len(set(options.id)) < len(options.id):
        raise ValueError(f'id = {options.id}: must name each marker once')
    if suffix != '.pdf' and len(options.id) > 1:
        raise ValueError(f'output = {options.output}: only .pdf holds more than one marker')
    page = choose_page(options.page, options.dictionary, options.size)
    drawings = [draw(options.dictionary, marker_id, options.size, page)
                for marker_id in options.id]
    if suffix == '.pdf':
        ids = ', '.join(map(str, options.id))
        content = pdf(drawings, f'{options.dictionary} {ids}, {options.size:g} m')
    else:
        content = svg(drawings[0]) if suffix == '.svg' else png(drawings[0], options.dpi)
    options.output.write_bytes(content)
    hint = '' if page == 'A4' else f'; A4 holds up to {_largest_on_a4(options.dictionary)} m'
    return f'{page}, {drawings[0].width:g} x {drawings[0].height:g} mm{hint}'


def choose_page(page: str, dictionary: str, side_length: float) -> str:
    """
    Return the page that a marker of a side length, m, is drawn on.

    ``page`` is a key of ``PAGES`` or 'exact', and then returned as it is, or 'auto' for the
    smallest from A4 up.

    :raises ValueError: for an unknown page, and one too small, naming one that is not.
    """
    if page not in (*PAGES, 'auto', 'exact'):
        raise ValueError(f'page = {page!r}: must be one of auto, {", ".join(PAGES)}, exact')
    if page == 'exact':
        return page
    width, height = _needed(dictionary, side_length)
    fitting = [name for name in AUTOMATIC if PAGES[name][0] >= width and PAGES[name][1] >= height]
    if page == 'auto' and fitting:
        return fitting[0]
    if page != 'auto' and PAGES[page][0] >= width and PAGES[page][1] >= height:
        return page
    raise ValueError(
        f'page = {page!r}: a marker of {side_length:g} m with its white border and caption takes '
        f'{math.ceil(width)} x {math.ceil(height)} mm; use --page {[*fitting, "exact"][0]}')


def _needed(dictionary: str, side_length: float) -> tuple[float, float]:
    """Return the width and height, mm, of a page that holds a marker."""
    outer = _outer(dictionary, side_length)
    return max(outer, CAPTION[0]) + 2.0 * MARGIN, outer + CAPTION[1] + 2.0 * MARGIN


def _largest_on_a4(dictionary: str) -> float:
    """Return the longest side, m, of a marker on A4, whose width is what limits it."""
    side = (PAGES['A4'][0] - 2.0 * MARGIN - 2.0 * LINE) / (_outer(dictionary, 1.0) - 2.0 * LINE)
    return math.floor(1e3 * side) / 1e3


def _outer(dictionary: str, side_length: float) -> float:
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
    outer, side = _outer(dictionary, side_length), 1e3 * side_length
    left, top = 0.5 * (width - outer), MARGIN + 0.5 * (height - needed[1])
    inset = 0.5 * (outer - side)
    caption, ruler = _caption(
        0.5 * (width - CAPTION[0]), top + outer,
        f'{dictionary}   id {marker_id}   side {side:g} mm',
        'Print at 100 % (actual size); do not fit to page.',
        f'Check: this ruler is 100 mm, the black square {side:g} mm.',
        'Cut at the corner marks: the white border is part of it.')
    boxes = [*_cells(dictionary, marker_id, left + inset, top + inset, side),
             *_corner_marks(left, top, outer), *ruler]
    return Drawing(width, height, tuple(boxes), tuple(caption))


def _cells(dictionary: str, marker_id: int, left: float, top: float, side: float) -> list[Box]:
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


def _corner_marks(left: float, top: float, outer: float) -> list[Box]:
    """Return angles along the inside of a square: they show where to cut."""
    arm = min(8.0, 0.25 * outer)
    right, bottom = left + outer - LINE, top + outer - LINE
    boxes = []
    for x, along_x in ((left, left), (right, left + outer - arm)):
        for y, along_y in ((top, top + LINE), (bottom, top + outer - arm)):
            boxes += [(along_x, y, arm, LINE), (x, along_y, LINE, arm - LINE)]
    return boxes


def _caption(left: float, top: float, *lines: str) -> tuple[list[Text], list[Box]]:
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


def snippet(dictionary: str, ids: Sequence[int], side_length: float) -> str:
    """Return the neighbours file for these markers, each on a neighbour's tail."""
    entries = [f"""\
  - name: {'leader' if len(ids) == 1 else f'drone{marker_id}'}
    marker_id: {marker_id}
    side_length: {side_length:g}  # m; measure the print
    position: [-0.20, 0.0, 0.0]  # m, the marker's centre on the body: forward, left, up
    rpy: [1.5707963, 0.0, -1.5707963]  # rad; upright, facing backwards"""
               for marker_id in ids]
    return '\n'.join([f'dictionary: {dictionary}', 'neighbors:', *entries])


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Leave the telling to main: one line, without the usage."""
        raise ValueError(message)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog='marker', description='Draw ArUco markers to scale, ready to print.')
    parser.add_argument('--id', type=int, nargs='+', required=True, metavar='N',
                        help='of the marker; several make a PDF of several pages')
    parser.add_argument('--dictionary', type=_dictionary, default='DICT_4X4_50',
                        help='one of OpenCV; %(default)s')
    parser.add_argument('--size', type=float, required=True, metavar='M',
                        help='side of the black square, m')
    parser.add_argument('--output', type=Path, default=Path('marker.pdf'), metavar='FILE',
                        help='.pdf, .svg or .png; %(default)s')
    parser.add_argument('--page', default='auto', metavar='NAME',
                        help=f'{", ".join(PAGES)}, exact (as large as needed), or auto: from A4 '
                        'up; %(default)s')
    parser.add_argument('--dpi', type=int, default=300, help='of a .png; %(default)s')
    return parser


def _dictionary(name: str) -> str:
    try:
        dictionary_size(name)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return name


if __name__ == '__main__':
    sys.exit(main())
