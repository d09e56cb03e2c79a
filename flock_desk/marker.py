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
the entry for the neighbours file. With ``--panel`` all are on one page, for one leader that is to
be seen from near and from far. Two runs write the same bytes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import NoReturn

from flock_desk.runs import marker_panel
from flock_desk.runs.drawing import Drawing, pdf
from flock_desk.runs.marker_pages import choose_page, draw, largest_on_a4, PAGES
from flock_follower.perception.markers import dictionary_size, SIDE_LENGTHS


def main(args: Sequence[str] | None = None) -> int:
    """Write the file and return the exit code."""
    try:
        options = _parser().parse_args(args)
        page, entries = _write(options)
    except (OSError, ValueError) as error:
        print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    print(f'{options.output}: page {page}', file=sys.stderr)
    print(entries)
    return 0


def _write(options: argparse.Namespace) -> tuple[str, str]:
    """Write the file and return its page's name and size, and the neighbours file."""
    if options.panel:
        options.size = options.size or [*marker_panel.SIZES]
        options.id = options.id or [*range(len(options.size))]
    missing = [f'--{name}' for name in ('id', 'size') if not getattr(options, name)]
    if missing:
        raise ValueError(f'the following arguments are required: {", ".join(missing)}')
    for size in options.size:
        SIDE_LENGTHS.check('size', size)
    if options.output.suffix.lower() != '.pdf':
        raise ValueError(f'output = {options.output}: must end in .pdf')
    if len(set(options.id)) < len(options.id):
        raise ValueError(f'id = {options.id}: must name each marker once')
    page, drawings, entries, hint = (_panel if options.panel else _single)(options)
    ids, sizes = (', '.join(f'{n:g}' for n in given) for given in (options.id, options.size))
    options.output.write_bytes(pdf(drawings, f'{options.dictionary} {ids}, {sizes} m'))
    return f'{page}, {drawings[0].width:g} x {drawings[0].height:g} mm{hint}', entries


def _single(options: argparse.Namespace) -> tuple[str, list[Drawing], str, str]:
    """Return the page, a drawing of each marker, the neighbours file, and a hint."""
    if len(options.size) > 1:
        raise ValueError(f'size = {options.size}: several are for --panel')
    (size,) = options.size
    page = choose_page(options.page, options.dictionary, size)
    drawings = [draw(options.dictionary, marker_id, size, page) for marker_id in options.id]
    hint = '' if page == 'A4' else f'; A4 holds up to {largest_on_a4(options.dictionary)} m'
    return page, drawings, snippet(options.dictionary, options.id, size), hint


def _panel(options: argparse.Namespace) -> tuple[str, list[Drawing], str, str]:
    """Return the same of a panel."""
    panel = marker_panel.layout(options.dictionary, options.id, options.size)
    page = marker_panel.choose_page(options.page, panel)
    return page, [marker_panel.draw(panel, page)], marker_panel.snippet(panel), ''


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
    parser.add_argument('--id', type=int, nargs='+', metavar='N',
                        help='of the marker; several make several pages')
    parser.add_argument('--panel', action='store_true',
                        help='all markers on one page, for one leader: seen from far by the large '
                        'one, from near by the small (sizes 0.3 0.06, ids 0 1)')
    parser.add_argument('--dictionary', type=_dictionary, default='DICT_4X4_50',
                        help='one of OpenCV; %(default)s')
    parser.add_argument('--size', type=float, nargs='+', metavar='M',
                        help='side of the black square, m; of a panel one for each id')
    parser.add_argument('--output', type=Path, default=Path('marker.pdf'), metavar='FILE',
                        help='.pdf; %(default)s')
    parser.add_argument('--page', default='auto', metavar='NAME',
                        help=f'{", ".join(PAGES)}, exact (as large as needed), or auto: the '
                        'first of them that holds it; %(default)s')
    return parser


def _dictionary(name: str) -> str:
    try:
        dictionary_size(name)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return name


if __name__ == '__main__':
    sys.exit(main())
