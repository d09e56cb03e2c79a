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
Pages of black boxes and text in millimetres, written to scale as PDF by matplotlib.

Nothing of a user's matplotlibrc counts here, as a tight bounding box, which would crop the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import NamedTuple

from matplotlib import style
from matplotlib.backends.backend_pdf import Name, PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.transforms import Affine2D
import numpy as np

INCH = 25.4  # mm
POINTS = 72.0 / INCH  # the unit of text sizes, in a millimetre
#: Legible content, whole outlines of its letters.
_STYLE = {'pdf.compression': 0, 'pdf.fonttype': 42}

#: Left, top, width, height, mm, from the page's top-left corner.
Box = tuple[float, float, float, float]


class Text(NamedTuple):
    """A line of text: left end and baseline, mm from the page's top-left corner; its size, mm."""

    x: float
    y: float
    size: float
    text: str


@dataclass(frozen=True)
class Drawing:
    """
    One page, mm.

    The boxes may touch but not overlap: all are filled as a single path, in which edges that two
    of them share do not show, where boxes filled one by one leave hairlines on a screen.
    """

    width: float
    height: float
    boxes: tuple[Box, ...]
    texts: tuple[Text, ...]


def pdf(drawings: Sequence[Drawing], title: str) -> bytes:
    """
    Return a PDF of one page per drawing, uncompressed, without a date.

    It asks viewers to print without scaling, which otherwise is what makes a print wrong.
    """
    out = BytesIO()
    about = {'Title': title, 'CreationDate': None}
    with style.context(['default', _STYLE]), PdfPages(out, metadata=about) as pages:
        for drawing in drawings:
            pages.savefig(_figure(drawing))
        # matplotlib has no option for it: its catalogue is written again, the last one counts.
        file = pages._file
        file.writeObject(file.rootObject, {
            'Type': Name('Catalog'), 'Version': Name('1.6'), 'Pages': file.pagesObject,
            'ViewerPreferences': {'PrintScaling': Name('None')}})
    return out.getvalue()


def _figure(drawing: Drawing) -> Figure:
    figure = Figure((drawing.width / INCH, drawing.height / INCH), facecolor='white')
    to_page = Affine2D().translate(0.0, -drawing.height).scale(1.0 / INCH, -1.0 / INCH)
    transform = to_page + figure.dpi_scale_trans
    corners = [((x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y))
               for x, y, w, h in drawing.boxes]
    box = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    figure.add_artist(PathPatch(
        Path(np.reshape(corners, (-1, 2)), box * len(corners)), transform=transform,
        facecolor='black', linewidth=0.0, snap=False))
    for text in drawing.texts:
        figure.text(text.x, text.y, text.text, transform=transform, size=text.size * POINTS)
    return figure
