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

Draws markers to scale, one to a page, each with the white border that detection needs and a ruler,
and prints the neighbors file. With ``--panel`` all markers are on one page, the largest on top,
for a leader that is followed at small and large distances. The panel's origin is the middle of the
smallest marker. Mount this marker at the height of the camera: at a small distance the camera sees
little else. Two runs write the same bytes. ``--output NAME.png --pixels N`` writes one marker as a
texture for simulators.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from io import BytesIO
import pathlib
import sys
from typing import NamedTuple

import cv2
from matplotlib import style
from matplotlib.backends.backend_pdf import Name, PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.transforms import Affine2D
import numpy as np
from numpy.typing import NDArray

from flock_desk.runs.console import guarded
from flock_follower.parameters.neighbors_file import SIDE_LENGTHS
from flock_follower.perception.markers import dictionary_size, draw_marker, marker_cells
from flock_follower.ranges import Range
from flock_follower.system.whole_file import whole_file

#: Width and height, mm.
PAGES = {'A4': (210.0, 297.0), 'A3': (297.0, 420.0), 'A2': (420.0, 594.0)}
#: Sides of a panel, m: the first is seen from 1 to 8 m, the second from 0.3 to 2 m (640x480,
#: 611 px).
APRILTAG_NOTE = ("note: the images of AprilTag's own project are these turned by 180 deg; print "
                 'this file, or hang those upside down')
DEFAULT_SIDE = 0.16  # m, side of the marker of config/neighbors.yaml
SIZES = (0.3, 0.06)
# White around the black border is a cell wide, and no less than this share of the side: OpenCV 4.6
# drops a square with another, here the paper's edge, within 0.05 of its perimeter.
MIN_QUIET = 0.16
MARGIN = 5.0  # mm, along a page's edge where printers do not print
LINE_WIDTH_MM = 0.2  # mm
MOST_PIXELS = 8192  # of a texture's side
CAPTION = (100.0, 30.0)  # mm, with the ruler, whose length is the caption's width
INCH = 25.4  # mm

#: Left, top, width, height, mm, from the page's top-left corner.
Box = tuple[float, float, float, float]
_ENTRY = """\
{first}marker_id: {marker_id}
{next}side_length: {side_length:g}  # m; measure the print
{next}position: [-0.20, 0.0, {up:.4f}]  # m, the center on the body: forward, left, up
{next}rpy: [1.5707963, 0.0, -1.5707963]  # rad; upright, facing backwards"""


class Placed(NamedTuple):
    """A marker on a print: its side, m; its side with the white border, mm; its center, mm."""

    marker_id: int
    side_length: float
    outer: float
    y: float
    """From the print's top edge down."""


class Page(NamedTuple):
    """
    A page, mm, with black boxes and lines of text: left end, baseline, size [mm], text.

    The boxes may touch but not overlap: all are filled as a single path. Filled one by one, boxes
    that share an edge leave hairlines on a screen.
    """

    name: str
    width: float
    height: float
    boxes: list[Box]
    texts: list[tuple[float, float, float, str]]


def main(args: Sequence[str] | None = None) -> int:
    """Write the file and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='marker', description='Draw ArUco markers to scale, ready to print.')
    parser.add_argument('--id', type=int, nargs='+', default=[], metavar='N',
                        help='of the marker (0); several make several pages')
    parser.add_argument('--panel', action='store_true',
                        help='all markers on one page, for one leader: seen from far by the large '
                        'one, from near by the small (sizes 0.3 0.06, ids 0 1)')
    parser.add_argument('--dictionary', default='DICT_4X4_50', help='one of OpenCV; %(default)s')
    parser.add_argument('--size', type=float, nargs='+', default=[], metavar='M',
                        help='side of the black square, m (0.16); of a panel one for each id')
    parser.add_argument('--output', type=pathlib.Path, default='marker.pdf', metavar='FILE',
                        help='.pdf, or .png: one marker as a texture for simulators; %(default)s')
    parser.add_argument('--pixels', type=int, metavar='N',
                        help='side of the .png, white border of one cell included (100 a cell)')
    return guarded(partial(_write, parser.parse_args(args)), refused=2)


def _write(options: argparse.Namespace) -> int:
    """Write the file and print the neighbors file."""
    ids, sizes = options.id, options.size
    sizes = sizes or ([*SIZES] if options.panel else [DEFAULT_SIDE])
    ids = ids or [*range(len(sizes))]
    if len(set(ids)) < len(ids):
        raise ValueError(f'--id = {ids}: must name each marker once')
    if len(sizes) != (len(ids) if options.panel else 1):
        raise ValueError(f'--size = {sizes}: must be one side, of a panel one for each of {ids}')
    suffix = options.output.suffix.lower()
    if suffix not in ('.pdf', '.png'):
        raise ValueError(f'--output = {options.output}: must end in .pdf or .png')
    for size in sizes:
        SIDE_LENGTHS.check('--size', size)
    if suffix == '.png':
        return _write_texture(options, ids, sizes)
    if options.pixels is not None:
        raise ValueError(f'--pixels = {options.pixels}: only with --output NAME.png')
    groups = [ids] if options.panel else [[marker_id] for marker_id in ids]
    prints = [layout(options.dictionary, group, sizes) for group in groups]
    pages = [draw(options.dictionary, markers) for markers in prints]
    with whole_file(options.output) as file:
        file.write(pdf(pages, f'{options.dictionary} {ids}, {sizes} m'))
    page = pages[0]
    print(f'{options.output}: page {page.name}, {page.width:g} x {page.height:g} mm',
          file=sys.stderr)
    if 'APRILTAG' in options.dictionary:
        print(APRILTAG_NOTE, file=sys.stderr)
    print(neighbors_file(options.dictionary, prints))
    return 0


def _write_texture(options: argparse.Namespace, ids: Sequence[int],
                   sizes: Sequence[float]) -> int:
    """Write one marker as an image and print its neighbors file."""
    if len(ids) > 1:
        raise ValueError(f'--id = {list(ids)}: a .png has one marker: write a file for each')
    image = texture(options.dictionary, ids[0], options.pixels)
    written, data = cv2.imencode('.png', image)
    if not written:
        raise OSError(f'{options.output}: not written')
    with whole_file(options.output) as file:
        file.write(data.tobytes())
    cells = marker_cells(options.dictionary)
    print(f'{options.output}: {len(image)} x {len(image)} pixels, upright; put it on a square of '
          f'{sizes[0] * (cells + 2) / cells:.4f} m', file=sys.stderr)
    if 'APRILTAG' in options.dictionary:
        print(APRILTAG_NOTE, file=sys.stderr)
    print(neighbors_file(options.dictionary, [layout(options.dictionary, ids, sizes)]))
    return 0


def texture(dictionary: str, marker_id: int, pixels: int | None = None) -> NDArray[np.uint8]:
    """
    Return a marker with a white border of one cell, (n, n), its first row on top.

    :raises ValueError: for a number of pixels that is no multiple of the cells, or no such marker.
    """
    cells = marker_cells(dictionary)
    whole = cells + 2
    pixels = 100 * whole if pixels is None else pixels
    if not 0 < pixels <= MOST_PIXELS or pixels % whole:
        near = min(max(round(pixels / whole), 1), MOST_PIXELS // whole) * whole
        raise ValueError(f'--pixels = {pixels}: must be a multiple of the {whole} cells, at most '
                         f'{MOST_PIXELS}: {near}')
    ids = Range(0, dictionary_size(dictionary) - 1, whole=True)
    ids.check('--id', marker_id)
    code = np.pad(draw_marker(dictionary, marker_id, cells), 1, constant_values=255)
    return np.kron(code, np.ones((pixels // whole, pixels // whole), np.uint8))


def layout(dictionary: str, ids: Sequence[int], sizes: Sequence[float]) -> list[Placed]:
    """Return markers of these sides, m, in the order of their ids, the largest on top."""
    top, placed = LINE_WIDTH_MM, []
    for marker_id, size in sorted(zip(ids, sizes), key=lambda pair: -pair[1]):
        quiet = max(1.0 / marker_cells(dictionary), MIN_QUIET)
        outer = 1e3 * size * (1.0 + 2.0 * quiet)
        placed.append(Placed(marker_id, size, outer, top + 0.5 * outer))
        top += outer
    return placed


def draw(dictionary: str, markers: Sequence[Placed]) -> Page:
    """
    Return markers, to be cut out together, on the smallest page that holds them.

    :raises ValueError: for an unknown dictionary or id, and a print larger than all pages.
    """
    cut = (markers[0].outer + 2.0 * LINE_WIDTH_MM,
           markers[-1].y + 0.5 * markers[-1].outer + LINE_WIDTH_MM)
    least = max(cut[0], CAPTION[0]) + 2.0 * MARGIN, cut[1] + CAPTION[1] + 2.0 * MARGIN
    sides = ' and '.join(f'{1e3 * marker.side_length:g}' for marker in markers)
    name = next((name for name, (width, height) in PAGES.items()
                 if width >= least[0] and height >= least[1]), None)
    if name is None:
        raise ValueError(f'--size: {sides} mm with white border and caption take {least[0]:.0f} x '
                         f'{least[1]:.0f} mm: must fit {[*PAGES][-1]}')
    width, height = PAGES[name]
    left, top = 0.5 * (width - cut[0]), MARGIN + 0.5 * (height - least[1])
    texts, boxes = caption(
        0.5 * (width - CAPTION[0]), top + cut[1],
        f'{dictionary}   id {", ".join(str(marker.marker_id) for marker in markers)}   '
        f'side {sides} mm', 'Print at 100 % (actual size); do not fit to page.',
        f'Check: this ruler is 100 mm, the black square {sides} mm.',
        'Cut at the corner marks, keep it flat: the white border is part of it.')
    boxes += corner_marks(left, top, *cut)
    for marker in markers:
        side = 1e3 * marker.side_length
        boxes += cells_of(dictionary, marker.marker_id, 0.5 * (width - side),
                          top + marker.y - 0.5 * side, side)
    return Page(name, width, height, boxes, texts)


def cells_of(dictionary: str, marker_id: int, left: float, top: float, side: float) -> list[Box]:
    """Return a marker's black cells; adjacent cells of a row are one box."""
    cells = marker_cells(dictionary)
    black = np.pad(draw_marker(dictionary, marker_id, cells) < 128, ((0, 0), (1, 1)))
    edges = np.arange(cells + 1) * side / cells
    boxes = []
    for row, changes in enumerate(np.diff(black.astype(int), axis=1)):
        for begin, end in zip(np.flatnonzero(changes == 1), np.flatnonzero(changes == -1)):
            boxes.append((left + float(edges[begin]), top + float(edges[row]),
                          float(edges[end] - edges[begin]), float(edges[row + 1] - edges[row])))
    return boxes


def corner_marks(left: float, top: float, width: float, height: float) -> list[Box]:
    """Return angles along the inside of a rectangle: they show where to cut."""
    arm = min(8.0, 0.25 * min(width, height))
    right, bottom = left + width - LINE_WIDTH_MM, top + height - LINE_WIDTH_MM
    boxes = []
    for x, along_x in ((left, left), (right, left + width - arm)):
        for y, along_y in ((top, top + LINE_WIDTH_MM), (bottom, top + height - arm)):
            boxes += [(along_x, y, arm, LINE_WIDTH_MM),
                      (x, along_y, LINE_WIDTH_MM, arm - LINE_WIDTH_MM)]
    return boxes


def caption(left: float, top: float, *lines: str
            ) -> tuple[list[tuple[float, float, float, str]], list[Box]]:
    """Return lines of text, the first a title, and under them a ruler of 100 mm."""
    texts = [(left, top + 6.0 + 4.0 * n, 3.6 if n == 0 else 2.6, line)
             for n, line in enumerate(lines)]
    y = top + 22.0
    texts += [(left + at, y + 7.0, 2.6, label)
              for at, label in ((0.0, '0'), (50.0, '50'), (100.0 - 11.0, '100 mm'))]
    # The first and last tick end where the ruler ends: 100 mm from outer edge to outer edge.
    ticks = [(left + at - LINE_WIDTH_MM * at / 100.0, y + LINE_WIDTH_MM, LINE_WIDTH_MM, 3.5
              if at % 50 == 0 else 2.0)
             for at in range(0, 101, 10)]
    return texts, [(left, y, 100.0, LINE_WIDTH_MM), *ticks]


def pdf(pages: Sequence[Page], title: str) -> bytes:
    """
    Return a PDF to scale, uncompressed, with the outlines of its letters, without a date.

    The PDF asks viewers to print without scaling, the usual reason for a wrong print. A user's
    matplotlibrc has no effect: a tight bounding box would crop the page.
    """
    out = BytesIO()
    about = {'Title': title, 'CreationDate': None}
    with style.context(['default', {'pdf.compression': 0, 'pdf.fonttype': 42}]), PdfPages(
            out, metadata=about) as file:
        for page in pages:
            file.savefig(_figure(page))
        # matplotlib has no option for it: its catalog is written again, the last one counts.
        file._file.writeObject(file._file.rootObject, {
            'Type': Name('Catalog'), 'Version': Name('1.6'), 'Pages': file._file.pagesObject,
            'ViewerPreferences': {'PrintScaling': Name('None')}})
    return out.getvalue()


def _figure(page: Page) -> Figure:
    figure = Figure((page.width / INCH, page.height / INCH), facecolor='white')
    transform = (Affine2D().translate(0.0, -page.height).scale(1.0 / INCH, -1.0 / INCH)
                 + figure.dpi_scale_trans)
    corners = [((x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y))
               for x, y, w, h in page.boxes]
    box = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    figure.add_artist(PathPatch(
        Path(np.reshape(corners, (-1, 2)), box * len(corners)), transform=transform,
        facecolor='black', linewidth=0.0, snap=False))
    for x, y, size, text in page.texts:
        figure.text(x, y, text, transform=transform, size=size * 72.0 / INCH)  # in points
    return figure


def neighbors_file(dictionary: str, prints: Sequence[Sequence[Placed]]) -> str:
    """Return the neighbors file of leaders that each carry a print on the tail."""
    lines = [f'dictionary: {dictionary}', 'neighbors:']
    for markers in prints:
        name = 'leader' if len(prints) == 1 else f'drone{markers[0].marker_id}'
        lines.append(f'  - name: {name}')
        first = indent = '    '
        if len(markers) > 1:
            lines.append('    markers:')
            first, indent = '      - ', '        '
        lines += [_ENTRY.format(
            first=first, next=indent, marker_id=marker.marker_id, side_length=marker.side_length,
            up=1e-3 * (markers[-1].y - marker.y)) for marker in markers]
    return '\n'.join(lines)


if __name__ == '__main__':
    sys.exit(main())
