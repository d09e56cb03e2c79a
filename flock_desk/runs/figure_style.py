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
The style of the figures for a paper: one column wide, told apart in grey too.

They have no title, which is the caption's, and every font is legible at that width.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np

from flock_follower.flocking import FlockingParams

WIDTH = 3.33  # in: a column of the paper's two
# Okabe and Ito's palette, for the colour-blind, and a dash for each where there is no colour.
COLOURS = (('#0072B2', '-'), ('#D55E00', (0, (5, 1.6))), ('#009E73', (0, (1.2, 1.1))))
INK, PALE = '#333333', '#BBBBBB'
KINDS = ('png', 'svg', 'pdf')
#: No names by chance and no dates: the same run gives the same bytes.
_METADATA = {'png': {'Software': None}, 'svg': {'Date': None}, 'pdf': {'CreationDate': None}}
_STYLE = {
    'font.size': 7.5, 'axes.titlesize': 7.5, 'axes.labelsize': 7.5, 'legend.fontsize': 7.5,
    'xtick.labelsize': 7, 'ytick.labelsize': 7, 'axes.titlelocation': 'left',
    'axes.titlepad': 4, 'axes.labelpad': 2.5, 'axes.linewidth': 0.6, 'lines.linewidth': 1.2,
    'axes.grid': True, 'axes.axisbelow': True, 'axes.spines.top': False,
    'axes.spines.right': False, 'xtick.major.width': 0.6, 'ytick.major.width': 0.6,
    'xtick.major.size': 2.5, 'ytick.major.size': 2.5, 'grid.linewidth': 0.4, 'grid.alpha': 0.35,
    'legend.frameon': False, 'legend.handlelength': 2.4, 'legend.borderaxespad': 0.0,
    'svg.hashsalt': 'flock_follower', 'path.simplify_threshold': 0.05,
    'pdf.fonttype': 42}  # whole outlines of its letters, as publishers ask for

Handle = Line2D | Patch


def styled() -> AbstractContextManager[None]:
    """Return the context to make a figure in; nothing of a user's matplotlibrc counts there."""
    return style.context(['default', _STYLE])


def save(figure: Figure, path: Path) -> str:
    """Write a figure in every kind, beside each other, and return the names in one."""
    with styled():
        for kind in KINDS:
            figure.savefig(path.with_suffix(f'.{kind}'), dpi=300, metadata=_METADATA[kind])
    return f'{path.name}.' + '/.'.join(KINDS)


def draw_bounds(axis: Axes, params: FlockingParams) -> None:
    """Draw the edges of the band, as distances, m."""
    for bound in np.sqrt([params.d0, params.d1]):
        axis.axhline(bound, color=INK, linestyle='--', linewidth=0.9, zorder=1.5)


def bounds_handle(label: str) -> Handle:
    """Return the edges of the band, for a legend."""
    return Line2D([], [], color=INK, linestyle='--', linewidth=0.9, label=label)
