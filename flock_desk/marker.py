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
and prints the entry for the neighbours file. With ``--panel`` all are on one page, for one leader
that is to be seen from near and from far: the largest on top, the others side by side below it.
The panel's origin is the middle of the smallest: nearby, the camera sees little else, so it
belongs at the height of the camera. Two runs write the same bytes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from io import BytesIO
import math
import pathlib
import sys
from typing import NamedTuple, NoReturn

from matplotlib import style
from matplotlib.backends.backend_pdf import Name, PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.transforms import Affine2D
import numpy as np

from flock_desk.runs.console import guarded, Options, parsed
from flock_follower.files import whole_file
from flock_follower.perception.markers import (
    dictionary_size,
    draw_marker,
    marker_cells,
    SIDE_LENGTHS,
)

#: Width and height, mm.
PAGES = {'A4': (210.0, 297.0), 'A3': (297.0, 420.0), 'A2': (420.0, 594.0)}
#: Sides of a panel, m: the first is seen from 1 to 8 m, the second from 0.3 to 2 m (640x480,
#: 611 px).
SIZES = (0.3, 0.06)
TAIL = -0.2  # m on the leader's body: where the print is in config/neighbors.yaml

# White around the black border is a cell wide, and no less than this share of the side: OpenCV 4.6
# drops a square with another, here the paper's edge, within 0.05 of its perimeter.
MIN_QUIET = 0.16
MARGIN = 5.0  # mm, along a page's edge where printers do not print
LINE = 0.2  # mm
CAPTION = (100.0, 30.0)  # mm, with the ruler, whose length is the caption's width
INCH = 25.4  # mm
POINTS = 72.0 / INCH  # the unit of text sizes, in a millimetre

#: Left, top, width, height, mm, from the page's top-left corner.
Box = tuple[float, float, float, float]
_ENTRY = """\
  - name: {name}
    marker_id: {marker_id}
    side_length: {side_length:g}  # m; measure the print
    position: [-0.20, 0.0, 0.0]  # m, the marker's centre on the body: forward, left, up
    rpy: [1.5707963, 0.0, -1.5707963]  # rad; upright, facing backwards"""
_PANEL = """\
  - name: leader
    # Middles on the body, m: forward, left, up. Upright on the tail, facing backwards;
    # the smallest at [-0.2, 0, 0], where the follower's camera looks when it is near.
    markers:"""
_PANEL_ENTRY = """\
      - marker_id: {marker_id}
        side_length: {side_length:g}  # m; measure the print
        position: [{forward:.4f}, {left:.4f}, {up:.4f}]
        rpy: [1.5707963, 0.0, -1.5707963]"""
_OPTIONS: Options = {
    '--id': {'type': int, 'nargs': '+', 'metavar': 'N',
             'help': 'of the marker; several make several pages'},
    '--panel': {'action': 'store_true',
                'help': 'all markers on one page, for one leader: seen from far by the large '
                'one, from near by the small (sizes 0.3 0.06, ids 0 1)'},
    '--dictionary': {'default': 'DICT_4X4_50', 'help': 'one of OpenCV; %(default)s'},
    '--size': {'type': float, 'nargs': '+', 'metavar': 'M',
               'help': 'side of the black square, m; of a panel one for each id'},
    '--output': {'type': pathlib.Path, 'default': pathlib.Path('marker.pdf'), 'metavar': 'FILE',
                 'help': '.pdf; %(default)s'},
    '--page': {'default': 'auto', 'metavar': 'NAME',
               'help': f'{", ".join(PAGES)}, exact (as large as needed), or auto: the first of '
               'them that holds it; %(default)s'}}


class Placed(NamedTuple):
    """A marker on a print: its side, m, and its middle from the print's top left corner, mm."""

    marker_id: int
    side_length: float
    x: float
    y: float


class Print(NamedTuple):
    """One marker or a panel, to be cut out: its size, mm, with white borders and corner marks."""

    dictionary: str
    width: float
    height: float
    markers: tuple[Placed, ...]

    @property
    def needed(self) -> tuple[float, float]:
        """Return the least width and height of the page, mm."""
        return (max(self.width, CAPTION[0]) + 2.0 * MARGIN,
                self.height + CAPTION[1] + 2.0 * MARGIN)


class Page(NamedTuple):
    """
    A page, mm, with black boxes and lines of text: left end, baseline, size [mm], text.

    The boxes may touch but not overlap: all are filled as a single path. Filled one by one, boxes
    that share an edge leave hairlines on a screen.
    """

    width: float
    height: float
    boxes: list[Box]
    texts: list[tuple[float, float, float, str]]


def main(args: Sequence[str] | None = None) -> int:
    """Write the file and return the exit code."""
    parser = _Parser(prog='marker', description='Draw ArUco markers to scale, ready to print.')
    return guarded(lambda: _write(parsed(parser, args, _OPTIONS)), refused=2)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Raise the error: one line, without the usage."""
        raise ValueError(message)


def _write(options: argparse.Namespace) -> int:
    """Write the file and print the neighbours file."""
    if options.panel:
        options.size = options.size or [*SIZES]
        options.id = options.id or [*range(len(options.size))]
    ids, sizes, dictionary = options.id or [], options.size or [], options.dictionary
    missing = [f'--{name}' for name in ('id', 'size') if not getattr(options, name)]
    dictionary_size(dictionary)
    for wrong, fault in (
            (missing, f'the following arguments are required: {", ".join(missing)}'),
            (options.output.suffix.lower() != '.pdf',
             f'output = {options.output}: must end in .pdf'),
            (len(set(ids)) < len(ids), f'id = {ids}: must name each marker once'),
            (options.panel and (len(ids) != len(sizes) or len(ids) < 2),
             f'size = {sizes}: a panel takes one for each of at least two ids, {ids}'),
            (not options.panel and len(sizes) > 1, f'size = {sizes}: several are for --panel')):
        if wrong:
            raise ValueError(fault)
    for size in sizes:
        SIDE_LENGTHS.check('size', size)
    prints = [layout(dictionary, each, sizes) for each in (
        [ids] if options.panel else [[marker_id] for marker_id in ids])]
    page = choose_page(options.page, prints[0])
    pages = [draw(each, page) for each in prints]
    title_ids, title_sizes = (', '.join(f'{n:g}' for n in given) for given in (ids, sizes))
    with whole_file(options.output) as file:
        file.write(pdf(pages, f'{dictionary} {title_ids}, {title_sizes} m'))
    hint = '' if options.panel or page == 'A4' else (
        f'; A4 holds up to {largest_on_a4(dictionary)} m')
    print(f'{options.output}: page {page}, {pages[0].width:g} x {pages[0].height:g} mm{hint}',
          file=sys.stderr)
    print(panel_entry(prints[0]) if options.panel else entry(dictionary, ids, sizes[0]))
    return 0


def layout(dictionary: str, ids: Sequence[int], sizes: Sequence[float]) -> Print:
    """Return the print of markers of these sides, m, in the order of their ids."""
    (first, large), *others = sorted(zip(ids, sizes), key=lambda pair: -pair[1])
    top, *outers = [outer_side(dictionary, size) - 2.0 * LINE
                    for size in (large, *(size for _, size in others))]
    width = max(top, sum(outers)) + 2.0 * LINE
    placed = [Placed(first, large, 0.5 * width, LINE + 0.5 * top)]
    left = 0.5 * (width - sum(outers))
    for (marker_id, size), outer in zip(others, outers):
        placed.append(Placed(marker_id, size, left + 0.5 * outer, LINE + top + 0.5 * outer))
        left += outer
    return Print(dictionary, width, top + max(outers, default=0.0) + 2.0 * LINE, tuple(placed))


def outer_side(dictionary: str, side_length: float) -> float:
    """Return the side, mm, of a marker with its white border and the corner marks around it."""
    quiet = max(1.0 / marker_cells(dictionary), MIN_QUIET)
    return 1e3 * side_length * (1.0 + 2.0 * quiet) + 2.0 * LINE


def largest_on_a4(dictionary: str) -> float:
    """Return the longest side, m, of a marker on A4, which its width limits."""
    marks = 2.0 * LINE
    side = (PAGES['A4'][0] - 2.0 * MARGIN - marks) / (outer_side(dictionary, 1.0) - marks)
    return math.floor(1e3 * side) / 1e3


def choose_page(page: str, cut_out: Print) -> str:
    """
    Return the page for a print.

    ``page`` is a key of ``PAGES`` or 'exact', and then returned as it is, or 'auto' for the
    smallest from A4 up.

    :raises ValueError: for an unknown page, and one too small, naming one that is not.
    """
    if page not in (*PAGES, 'auto', 'exact'):
        raise ValueError(f'page = {page!r}: must be one of auto, {", ".join(PAGES)}, exact')
    width, height = cut_out.needed
    fitting = [name for name, size in PAGES.items() if size[0] >= width and size[1] >= height]
    if page == 'auto' and fitting:
        return fitting[0]
    if page in (*fitting, 'exact'):
        return page
    what = 'a marker of' if len(cut_out.markers) == 1 else 'a panel of'
    sides = ' and '.join(f'{marker.side_length:g}' for marker in cut_out.markers)
    raise ValueError(
        f'page = {page!r}: {what} {sides} m with its white border and caption takes '
        f'{math.ceil(width)} x {math.ceil(height)} mm; use --page {[*fitting, "exact"][0]}')


def draw(cut_out: Print, page: str) -> Page:
    """
    Return a print on a page that :func:`choose_page` returned.

    :raises ValueError: for an unknown dictionary or id.
    """
    width, height = cut_out.needed if page == 'exact' else PAGES[page]
    left, top = 0.5 * (width - cut_out.width), MARGIN + 0.5 * (height - cut_out.needed[1])
    ids = ', '.join(str(marker.marker_id) for marker in cut_out.markers)
    sides = ', '.join(f'{1e3 * marker.side_length:g}' for marker in cut_out.markers)
    many = 's' if len(cut_out.markers) > 1 else ''
    texts, ruler = caption(
        0.5 * (width - CAPTION[0]), top + cut_out.height,
        f'{cut_out.dictionary}   id{many} {ids}   side{many} {sides} mm',
        'Print at 100 % (actual size); do not fit to page.',
        f'Check: this ruler is 100 mm, the black square{many} {sides} mm.',
        'Cut at the corner marks, keep it flat: all markers are one print.' if many else
        'Cut at the corner marks: the white border is part of it.')
    boxes = [*corner_marks(left, top, cut_out.width, cut_out.height), *ruler]
    for marker in cut_out.markers:
        side = 1e3 * marker.side_length
        boxes += cells_of(cut_out.dictionary, marker.marker_id, left + marker.x - 0.5 * side,
                          top + marker.y - 0.5 * side, side)
    return Page(width, height, boxes, texts)


def cells_of(dictionary: str, marker_id: int, left: float, top: float, side: float) -> list[Box]:
    """Return a marker's black cells, those beside each other in a row as one box."""
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
    right, bottom = left + width - LINE, top + height - LINE
    boxes = []
    for x, along_x in ((left, left), (right, left + width - arm)):
        for y, along_y in ((top, top + LINE), (bottom, top + height - arm)):
            boxes += [(along_x, y, arm, LINE), (x, along_y, LINE, arm - LINE)]
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
    ticks = [(left + at - LINE * at / 100.0, y + LINE, LINE, 3.5 if at % 50 == 0 else 2.0)
             for at in range(0, 101, 10)]
    return texts, [(left, y, 100.0, LINE), *ticks]


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
        # matplotlib has no option for it: its catalogue is written again, the last one counts.
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
        figure.text(x, y, text, transform=transform, size=size * POINTS)
    return figure


def panel_entry(panel: Print) -> str:
    """Return the neighbours file of a leader that carries a panel on its tail."""
    origin = min(panel.markers, key=lambda marker: marker.side_length)
    return '\n'.join([
        f'dictionary: {panel.dictionary}', 'neighbors:', _PANEL,
        *(_PANEL_ENTRY.format(
            **marker._asdict(), forward=TAIL, left=1e-3 * (origin.x - marker.x) + 0.0,
            up=1e-3 * (origin.y - marker.y) + 0.0) for marker in panel.markers)])


def entry(dictionary: str, ids: Sequence[int], side_length: float) -> str:
    """Return the neighbours file for these markers, each on a neighbour's tail."""
    return '\n'.join([f'dictionary: {dictionary}', 'neighbors:', *(
        _ENTRY.format(name='leader' if len(ids) == 1 else f'drone{marker_id}',
                      marker_id=marker_id, side_length=side_length) for marker_id in ids)])


if __name__ == '__main__':
    sys.exit(main())
