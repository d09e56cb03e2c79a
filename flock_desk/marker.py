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

from flock_desk.runs.console import guarded
from flock_desk.runs.marker_pages import (
    choose_page,
    draw,
    entry,
    largest_on_a4,
    layout,
    PAGES,
    panel_entry,
    pdf,
    SIZES,
)
from flock_follower.perception.markers import dictionary_size, SIDE_LENGTHS
from flock_follower.whole_file import whole_file


def main(args: Sequence[str] | None = None) -> int:
    """Write the file and return the exit code."""
    return guarded(lambda: _write(_parser().parse_args(args)), refused=2)


def _write(options: argparse.Namespace) -> int:
    """Write the file and print the neighbours file."""
    if options.panel:
        options.size = options.size or [*SIZES]
        options.id = options.id or [*range(len(options.size))]
    ids, sizes, dictionary = options.id, options.size, options.dictionary
    if missing := [f'--{name}' for name in ('id', 'size') if not getattr(options, name)]:
        raise ValueError(f'the following arguments are required: {", ".join(missing)}')
    for size in sizes:
        SIDE_LENGTHS.check('size', size)
    if options.output.suffix.lower() != '.pdf':
        raise ValueError(f'output = {options.output}: must end in .pdf')
    if len(set(ids)) < len(ids):
        raise ValueError(f'id = {ids}: must name each marker once')
    if options.panel and (len(ids) != len(sizes) or len(ids) < 2):
        raise ValueError(f'size = {sizes}: a panel takes one for each of at least two ids, {ids}')
    if not options.panel and len(sizes) > 1:
        raise ValueError(f'size = {sizes}: several are for --panel')
    prints = [layout(dictionary, ids, sizes)] if options.panel else [
        layout(dictionary, [marker_id], sizes) for marker_id in ids]
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


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Raise the error: one line, without the usage."""
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
