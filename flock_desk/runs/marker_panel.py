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
Several markers of one leader on a page: large ones for far, small ones for near.

The largest is on top, the others side by side below it, each with a white border of its own. The
panel's origin is the middle of the smallest: the camera has to see that one when it is near, and
then it sees little else, so that it belongs at the height of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from flock_desk.runs.drawing import Drawing
from flock_desk.runs.marker_pages import (
    CAPTION,
    caption_at,
    cells_of,
    corner_marks,
    fitting_page,
    LINE,
    MARGIN,
    outer_side,
    PAGES,
)

#: Sides, m: the first is seen from 1 to 8 m, the second from 0.3 to 2 m (640x480, 611 px).
SIZES = (0.3, 0.06)
TAIL = -0.2  # m on the leader's body: where the print is in config/neighbors.yaml


class Placed(NamedTuple):
    """A marker on a panel: its side, m, and its middle from the panel's top left corner, mm."""

    marker_id: int
    side_length: float
    x: float
    y: float


class Panel(NamedTuple):
    """Markers of a dictionary, and the size of what they are on, mm."""

    dictionary: str
    width: float
    height: float
    markers: tuple[Placed, ...]

    @property
    def origin(self) -> Placed:
        """Return the smallest marker."""
        return min(self.markers, key=lambda marker: marker.side_length)


def layout(dictionary: str, ids: Sequence[int], sizes: Sequence[float]) -> Panel:
    """
    Return a panel of markers of these sides, m, in the order of their ids.

    :raises ValueError: where there are not as many sides as ids, at least two.
    """
    if len(ids) != len(sizes) or len(ids) < 2:
        raise ValueError(f'size = {list(sizes)}: a panel takes one for each of at least two ids, '
                         f'{list(ids)}')
    (first, large), *others = sorted(zip(ids, sizes), key=lambda pair: -pair[1])
    top, *outers = [outer_side(dictionary, size) - 2.0 * LINE
                    for size in (large, *(size for _, size in others))]
    row = sum(outers)
    width = max(top, row) + 2.0 * LINE
    placed = [Placed(first, large, 0.5 * width, LINE + 0.5 * top)]
    left = 0.5 * (width - row)
    for (marker_id, size), outer in zip(others, outers):
        placed.append(Placed(marker_id, size, left + 0.5 * outer, LINE + top + 0.5 * outer))
        left += outer
    return Panel(dictionary, width, top + max(outers) + 2.0 * LINE, tuple(placed))


def choose_page(page: str, panel: Panel) -> str:
    """Return the page for a panel, see ``marker_pages.choose_page``."""
    width, height = _needed(panel)
    sides = ' and '.join(f'{marker.side_length:g}' for marker in panel.markers)
    return fitting_page(page, width, height, f'a panel of {sides} m')


def _needed(panel: Panel) -> tuple[float, float]:
    return (max(panel.width, CAPTION[0]) + 2.0 * MARGIN,
            panel.height + CAPTION[1] + 2.0 * MARGIN)


def draw(panel: Panel, page: str) -> Drawing:
    """
    Return a panel on a page that :func:`choose_page` returned.

    :raises ValueError: for an unknown dictionary or id.
    """
    needed = _needed(panel)
    width, height = needed if page == 'exact' else PAGES[page]
    left, top = 0.5 * (width - panel.width), MARGIN + 0.5 * (height - needed[1])
    sides = [f'{1e3 * marker.side_length:g}' for marker in panel.markers]
    ids = ', '.join(str(marker.marker_id) for marker in panel.markers)
    caption, ruler = caption_at(
        0.5 * (width - CAPTION[0]), top + panel.height,
        f'{panel.dictionary}   ids {ids}   sides {", ".join(sides)} mm',
        'Print at 100 % (actual size); do not fit to page.',
        f'Check: this ruler is 100 mm, the black squares {", ".join(sides)} mm.',
        'Cut at the corner marks, keep it flat: all markers are one print.')
    boxes = [*corner_marks(left, top, panel.width, panel.height), *ruler]
    for marker in panel.markers:
        side = 1e3 * marker.side_length
        boxes += cells_of(panel.dictionary, marker.marker_id, left + marker.x - 0.5 * side,
                          top + marker.y - 0.5 * side, side)
    return Drawing(width, height, tuple(boxes), tuple(caption))


def snippet(panel: Panel) -> str:
    """Return the neighbours file of a leader that carries a panel on its tail."""
    origin = panel.origin
    entries = [f"""\
      - marker_id: {marker.marker_id}
        side_length: {marker.side_length:g}  # m; measure the print
        position: [{TAIL:.4f}, {_metres(origin.x - marker.x)}, {_metres(origin.y - marker.y)}]
        rpy: [1.5707963, 0.0, -1.5707963]"""
               for marker in panel.markers]
    return '\n'.join([
        f'dictionary: {panel.dictionary}', 'neighbors:', '  - name: leader',
        '    # Middles on the body, m: forward, left, up. Upright on the tail, facing backwards;',
        "    # the smallest at [-0.2, 0, 0], where the follower's camera looks when it is near.",
        '    markers:', *entries])


def _metres(millimetres: float) -> str:
    return f'{1e-3 * millimetres + 0.0:.4f}'

