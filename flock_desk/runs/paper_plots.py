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
The figures for a paper: simulated flocks, a panel for each model; controllers compared.

Each is one column wide and legible at that width; its lines are distinguishable in gray. The title
belongs to the caption.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
import numpy as np

from flock_desk.flocks.agents import Simulation
from flock_follower.flocking import FlockingParams
from flock_follower.system.whole_file import whole_file

COLUMN_WIDTH = 3.33  # in: a column of the paper's two
# Okabe and Ito's palette, for the color-blind, and a dash for each, for print without color.
COLORS = (('#0072B2', '-'), ('#D55E00', (0, (5, 1.6))), ('#009E73', (0, (1.2, 1.1))))
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
Runs = Mapping[str, Simulation]
Draw = Callable[[Axes, Simulation], None]
#: The ratio of length to width of paths from which on both axes have a scale of their own.
SLIM = 5.0
_TIME = 'time [s]'
#: A legend above the axis, where no data can be.
_ABOVE: dict[str, Any] = {
    'loc': 'lower left', 'bbox_to_anchor': (0.0, 1.0), 'ncols': 3, 'columnspacing': 1.0}


def styled() -> Any:
    """Return a context in which the user's matplotlibrc has no effect."""
    return style.context(['default', _STYLE])


@styled()
def save(figure: Figure, path: Path) -> str:
    """Write a figure in each file format; return the names of the files, as NAME.png/.svg/.pdf."""
    for kind in KINDS:
        with whole_file(path.with_suffix(f'.{kind}')) as file:
            figure.savefig(file, format=kind, dpi=300, metadata=_METADATA[kind])
    return f'{path.name}.' + '/.'.join(KINDS)


def draw_bounds(axis: Axes, params: FlockingParams) -> None:
    """Draw the edges of the band, as distances, m."""
    for bound in np.sqrt([params.d0, params.d1]):
        axis.axhline(bound, color=INK, linestyle='--', linewidth=0.9, zorder=1.5)


@styled()
def trajectories(runs: Runs, names: tuple[str, ...], end: float, note: str = '') -> Figure:
    """Return the paths of each model's agents up to a time, s, from start to end."""
    def draw(axis: Axes, run: Simulation) -> None:
        x = run.positions[run.time <= end + 1e-9]
        for n, line in ((0, ':'), (-1, '-')):
            loop = np.append(np.arange(x.shape[1]), 0)
            axis.plot(*x[n, loop].T, color=PALE, linewidth=0.8, linestyle=line, zorder=1)
        for i, (color, dash) in enumerate(COLORS[:x.shape[1]]):
            axis.plot(*x[:, i].T, color=color, linestyle=dash)
            axis.plot(*x[0, i], 'o', color='white', markeredgecolor=color, markersize=4,
                      zorder=5)
            axis.plot(*x[-1, i], 'o', color=color, markersize=4)
        spans = np.ptp(x, axis=(0, 1))
        axis.margins(0.12)
        if spans.max() > SLIM * spans.min():  # at one scale the panel would be empty
            axis.text(1.03, 0.5, 'x and y scales differ', fontsize=7, rotation=90, va='center',
                      transform=axis.transAxes)
        else:
            axis.set_aspect('equal', adjustable='datalim')

    handles = [*_agent_handles(names), *(
        Line2D([], [], color=INK, marker='o', markerfacecolor=fill, linestyle='', markersize=4,
               label=label) for fill, label in (('white', 'start'), (INK, f'after {end:g} s'))),
               Line2D([], [], color=PALE, linewidth=0.8, label='the flock\n(dotted: start)')]
    return _panels(runs, draw, handles, 'x [m]', 'y [m]', note, height=4.9,
                   share=(False, False))


@styled()
def speeds(runs: Runs, names: tuple[str, ...], end: float, note: str = '') -> Figure:
    """Return each agent's speed over time, up to a time, s."""
    top = 1.05 * max(np.linalg.norm(run.velocities, axis=2).max() for run in runs.values())

    def draw(axis: Axes, run: Simulation) -> None:
        for i, (color, dash) in enumerate(COLORS[:run.positions.shape[1]]):
            axis.plot(run.time, np.linalg.norm(run.velocities[:, i], axis=1), color=color,
                      linestyle=dash)
        axis.set(xlim=(0.0, end), ylim=(0.0, top))

    return _panels(runs, draw, _agent_handles(names), _TIME, 'speed [m/s]', note)


@styled()
def distances(runs: Runs, end: float, note: str = '') -> Figure:
    """Return distances between agents up to a time, s, and the bounds, each with its own scale."""
    def draw(axis: Axes, run: Simulation) -> None:
        m = run.metrics
        last = int(np.searchsorted(m.time, end))
        if run.positions.shape[1] > 2:
            few = slice(0, last + 1, max(1, last // 500))  # of an area a file keeps every point
            axis.fill_between(m.time[few], np.sqrt(m.min_r2[few]), np.sqrt(m.max_r2[few]),
                              color=COLORS[0][0], alpha=0.35, linewidth=0)
        axis.plot(m.time, m.mean_distance, color=COLORS[0][0], linewidth=1.1)
        draw_bounds(axis, run.params)
        shown = np.sqrt(np.append(m.max_r2[:last + 1], run.params.d1))
        axis.set(xlim=(0.0, end), ylim=(0.0, 1.1 * float(shown.max())))

    several = next(iter(runs.values())).positions.shape[1] > 2
    label = 'mean of the pairs' if several else 'between the two'
    handles: list[Handle] = [Line2D([], [], color=COLORS[0][0], label=label)]
    if several:
        handles.append(Patch(color=COLORS[0][0], alpha=0.35, linewidth=0,
                             label='least to greatest'))
    handles.append(Line2D([], [], color=INK, linestyle='--', linewidth=0.9,
                          label='$\\sqrt{d_0}$ and $\\sqrt{d_1}$'))
    return _panels(runs, draw, handles, _TIME, 'distance [m]', note, share=('all', False))


@styled()
def agreement(runs: Runs, end: float) -> Figure:
    """
    Return W of the first run (the law), and the velocities' disagreement in all runs.

    A dot marks the time from which the disagreement stays below 1 % of its first value.
    """
    figure = Figure(figsize=(COLUMN_WIDTH, 3.6), layout='constrained')
    above, below = figure.subplots(2, 1, sharex=True)
    law = next(iter(runs.values())).metrics
    shown = law.time <= end
    above.plot(law.time[shown], law.lyapunov[shown], color=INK)
    above.set(ylabel='$W$ of the law [m/s]')
    above.set_title('$W = \\Lambda + \\frac{1}{2}\\sum_{i>j}\\left[(r_{ij}^2 - d_0)^{-1} + '
                    '(d_1 - r_{ij}^2)^{-1}\\right]$ decreases')
    below.set_title('disagreement $\\Lambda = \\sqrt{\\sum_i |v_i - \\bar{v}|^2}$')
    for (name, run), (color, dash) in zip(runs.items(), ((INK, '-'), *COLORS[:2])):
        m = run.metrics
        below.semilogy(m.time, m.disagreement / m.disagreement[0], color=color,
                       linestyle=dash, label=name)
        below.plot(m.time_to_agree(), 0.01, 'o', color=color, markersize=4)
    below.axhline(0.01, color=INK, linestyle='--', linewidth=0.7)
    below.annotate('1 %', (end, 0.01), (-2, 2), textcoords='offset points', fontsize=7,
                   ha='right')
    below.set(ylabel='$\\Lambda(t) / \\Lambda(0)$', xlabel=_TIME, xlim=(0.0, end),
              ylim=(1e-5, 4.0))
    figure.align_ylabels([above, below])
    figure.legend(*below.get_legend_handles_labels(), loc='outside upper center', ncols=3,
                  columnspacing=1.2, handlelength=1.9)
    return figure


@styled()
def flock(run: Simulation) -> Figure:
    """Return paths from above, distances and agreement of a larger flock on a graph."""
    figure = Figure(figsize=(COLUMN_WIDTH, 5.6), layout='constrained')
    paths, below, agreeing = figure.subplots(3, 1, height_ratios=(2.2, 1.0, 1.0))
    # From the flock's own mean, or it would be a bundle of lines as long as it has flown.
    x = (run.positions - run.positions.mean(axis=1, keepdims=True))[:, :, :2]
    edges = np.empty((0, 2), dtype=int) if run.graph is None else run.graph.edges[:2000]
    paths.plot(*x[-1, edges].transpose(2, 1, 0), color=PALE, linewidth=0.5, zorder=1)
    paths.plot(*x[:, :200].transpose(2, 0, 1), color=COLORS[0][0], linewidth=0.6, alpha=0.7)
    paths.plot(*x[-1].T, 'o', color=INK, markersize=2.5)
    paths.set(xlabel='x from the mean [m]', ylabel='y from the mean [m]')
    paths.set_aspect('equal', adjustable='datalim')
    paths.legend(handles=[
        Line2D([], [], color=COLORS[0][0], linewidth=0.6, label='paths'),
        Line2D([], [], color=INK, marker='o', markersize=2.5, linestyle='',
               label=f'after {run.time[-1]:g} s'),
        Line2D([], [], color=PALE, linewidth=0.5, label='edges')], **_ABOVE)
    m = run.metrics
    below.plot(m.time, np.sqrt(m.max_r2), color=COLORS[1][0], linestyle=COLORS[1][1],
               label='longest edge')
    below.plot(m.time, np.sqrt(m.min_r2), color=COLORS[0][0], label='least of all pairs')
    draw_bounds(below, run.params)
    below.set(ylabel='distance [m]', xlim=(0.0, m.time[-1]), ylim=(0.0, None))
    agreeing.plot(m.time, m.order, color=INK, label='order parameter')
    agreeing.plot(m.time, m.disagreement / m.disagreement[0], color=COLORS[2][0],
                  linestyle=COLORS[1][1], label='disagreement $\\Lambda(t) / \\Lambda(0)$')
    agreeing.set(xlabel=_TIME, ylabel='agreement', xlim=(0.0, m.time[-1]), ylim=(0.0, None))
    for axis in (below, agreeing):
        axis.legend(**_ABOVE)
    figure.align_ylabels([below, agreeing])
    return figure


def _panels(runs: Runs, draw: Draw, handles: list[Handle], x_label: str,
            y_label: str, note: str, height: float = 4.3,
            share: tuple[Any, Any] = ('all', 'all')) -> Figure:
    """Return a panel for each of five runs, the legend in the second place, a note below."""
    figure = Figure(figsize=(COLUMN_WIDTH, height), layout=ConstrainedLayoutEngine(wspace=0.07))
    axes = figure.subplots(3, 2, sharex=share[0], sharey=share[1])
    for letter, axis, (name, run) in zip('abcde', axes.flat[[0, 2, 3, 4, 5]], runs.items()):
        axis.set_title(f'({letter}) {name}'.replace(', ', ',\n'))
        draw(axis, run)
    for axis in axes[2]:
        axis.set_xlabel(x_label)
        axis.xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))
    for axis in axes[:, 0]:
        axis.set_ylabel(y_label)
    key = axes[0, 1]
    key.set_axis_off()
    # It may not make the panels below narrower.
    key.legend(handles=handles, loc='upper left', handlelength=1.9).set_in_layout(False)
    if note:
        figure.supxlabel(note, fontsize=7, x=0.01, ha='left')
    return figure


def _agent_handles(names: tuple[str, ...]) -> list[Handle]:
    return [Line2D([], [], color=color, linestyle=dash, label=name)
            for name, (color, dash) in zip(names, COLORS)]


@styled()
def controllers(results: Mapping[float, Mapping[str, tuple[float, float]]]) -> Figure:
    """
    Return the share of runs that kept the band against the jerk, a panel for each ``v_max``, m/s.

    :param results: by ``v_max``, the jerk, m/s^3, and the share of each controller.
    """
    figure = Figure(figsize=(COLUMN_WIDTH, 2.4), layout='constrained')
    axes: list[Axes] = list(figure.subplots(1, len(results), sharey=True, squeeze=False)[0])
    for axis, (v_max, points) in zip(axes, results.items()):
        for (name, (jerk, share)), marker in zip(points.items(), 'os^Dv'):
            axis.plot(jerk, 100.0 * share, marker, markersize=5, label=name,
                      color=COLORS[1][0] if name == 'law and guard' else INK,
                      markerfacecolor=None if name == 'law and guard' else 'white')
        axis.set(title=f'$v_{{max}}$ = {v_max:g} m/s', xlabel='jerk [m/s$^3$]', ylim=(-5, 105))
        axis.set_xlim(left=0.0)
    axes[0].set_ylabel('runs in the band [%]')
    figure.legend(*axes[0].get_legend_handles_labels(), loc='outside upper center', ncols=3,
                  columnspacing=1.0, handlelength=1.0)
    return figure
