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

"""The figures of simulated flocks: small multiples of one width, told apart in grey too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.axes3d import Axes3D
import numpy as np

from flock_follower.flocks.agents import Simulation

# Okabe and Ito's palette, for the colour-blind, and a dash for each where there is no colour.
AGENTS = (('#0072B2', '-'), ('#D55E00', (0, (5, 1.6))), ('#009E73', (0, (1.2, 1.1))))
INK, PALE = '#333333', '#BBBBBB'
_STYLE = {
    'font.size': 8, 'axes.titlesize': 8.5, 'axes.labelsize': 8, 'legend.fontsize': 8,
    'xtick.labelsize': 7, 'ytick.labelsize': 7, 'axes.titlelocation': 'left',
    'axes.linewidth': 0.6, 'lines.linewidth': 1.3, 'grid.linewidth': 0.4, 'grid.alpha': 0.35,
    'axes.grid': True, 'axes.axisbelow': True, 'axes.spines.top': False,
    'axes.spines.right': False, 'xtick.major.width': 0.6, 'ytick.major.width': 0.6,
    'mathtext.fontset': 'dejavusans',
    # No random names and no dates in an SVG: the same run gives the same bytes.
    'svg.hashsalt': 'flock_follower', 'path.simplify_threshold': 0.05,
}

Runs = Mapping[str, Simulation]
Draw = Callable[[Axes, Simulation], None]


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG and as SVG, beside each other."""
    with matplotlib.rc_context(_STYLE):
        figure.savefig(path.with_suffix('.png'), dpi=300, metadata={'Software': None})
        figure.savefig(path.with_suffix('.svg'), metadata={'Date': None})


def trajectories(runs: Runs, title: str, names: tuple[str, ...], end: float,
                 note: str = '') -> Figure:
    """Return the paths of each model's agents up to a time, s, from start to end."""
    def draw(axis: Axes, run: Simulation) -> None:
        shown = run.time <= end + 1e-9
        x = run.positions[shown]
        for n, style in ((0, ':'), (-1, '-')):
            loop = np.append(np.arange(x.shape[1]), 0)
            axis.plot(*x[n, loop].T, color=PALE, linewidth=0.8, linestyle=style, zorder=1)
        for i, (colour, dash) in enumerate(AGENTS[:x.shape[1]]):
            axis.plot(*x[:, i].T, color=colour, linestyle=dash)
            axis.plot(*x[0, i], 'o', color='white', markeredgecolor=colour, markersize=4)
            axis.plot(*x[-1, i], 'o', color=colour, markersize=4)
            axis.annotate('', x[0, i] + 0.5 * run.velocities[0, i], x[0, i], zorder=3,
                          arrowprops={'arrowstyle': '-|>,head_width=.15,head_length=.3',
                                      'color': colour, 'linewidth': 0.9, 'shrinkA': 0,
                                      'shrinkB': 0})
        axis.margins(0.08)
        axis.set_aspect('equal', adjustable='datalim')

    with matplotlib.rc_context(_STYLE):
        handles: list[Line2D | Patch] = _agent_handles(names)
        handles += [
            Line2D([], [], color=INK, marker='o', markerfacecolor='white', linestyle='',
                   markersize=4, label='start (arrow: 0.5 s at its velocity)'),
            Line2D([], [], color=INK, marker='o', linestyle='', markersize=4,
                   label=f'after {end:g} s'),
            Line2D([], [], color=PALE, linewidth=0.8, label='shape of the flock (dotted: start)')]
        return _panels(runs, title, draw, handles, 'x [m]', 'y [m]', note, height=4.6,
                       share=False)


def speeds(runs: Runs, title: str, names: tuple[str, ...], end: float,
           note: str = '') -> Figure:
    """Return each agent's speed over time, up to a time, s."""
    top = 1.05 * max(np.linalg.norm(run.velocities, axis=2).max() for run in runs.values())

    def draw(axis: Axes, run: Simulation) -> None:
        for i, (colour, dash) in enumerate(AGENTS[:run.positions.shape[1]]):
            axis.plot(run.time, np.linalg.norm(run.velocities[:, i], axis=1), color=colour,
                      linestyle=dash)
        axis.set(xlim=(0.0, end), ylim=(0.0, top))

    with matplotlib.rc_context(_STYLE):
        return _panels(runs, title, draw, _agent_handles(names), 'time [s]', 'speed [m/s]', note)


def distances(runs: Runs, title: str, end: float,
              limits: tuple[float, float], note: str = '') -> Figure:
    """Return the distances between agents up to a time, s, within limits, m, and the bounds."""
    def draw(axis: Axes, run: Simulation) -> None:
        m = run.metrics
        if run.positions.shape[1] > 2:
            axis.fill_between(m.time, np.sqrt(m.min_r2), np.sqrt(m.max_r2), color=AGENTS[0][0],
                              alpha=0.35, linewidth=0)
        axis.plot(m.time, m.mean_distance, color=AGENTS[0][0], linewidth=1.1)
        _bounds(axis, run)
        axis.set(xlim=(0.0, end), ylim=limits)
        last = np.interp(end, m.time, m.mean_distance)
        top = limits[1]
        if last > top:
            leaves = m.time[np.argmax(m.mean_distance > top)]
            axis.annotate(f'{last:.1f} m\nat {end:g} s', (leaves, top), (6, -3), fontsize=7,
                          textcoords='offset points', va='top', color=AGENTS[0][0])

    with matplotlib.rc_context(_STYLE):
        several = next(iter(runs.values())).positions.shape[1] > 2
        label = 'average over the pairs' if several else 'between the two'
        handles: list[Line2D | Patch] = [Line2D([], [], color=AGENTS[0][0], label=label)]
        if several:
            handles.append(Patch(color=AGENTS[0][0], alpha=0.35, linewidth=0,
                                 label='from least to greatest'))
        handles.append(Line2D([], [], color=INK, linestyle='--', linewidth=0.9,
                              label='the bounds $\\sqrt{d_0}$ and $\\sqrt{d_1}$'))
        return _panels(runs, title, draw, handles, 'time [s]', 'distance [m]', note)


def agreement(runs: Runs, title: str, end: float) -> Figure:
    """Return W of the first run, the law's, and how the velocities of all runs come to agree."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(7.2, 2.9), layout='constrained')
        figure.suptitle(title, fontsize=9.5, x=0.01, ha='left', weight='bold')
        left, right = figure.subplots(1, 2)
        law = next(iter(runs.values())).metrics
        shown = law.time <= end
        left.plot(law.time[shown], law.lyapunov[shown], color=INK)
        for n, place, side in ((0, (7, -2), 'left'), (np.flatnonzero(shown)[-1], (0, 6), 'right')):
            left.annotate(f'{law.lyapunov[n]:.4f} at {law.time[n]:g} s',
                          (law.time[n], law.lyapunov[n]), place, fontsize=7, ha=side,
                          textcoords='offset points')
        left.set(title='Lyapunov function $W$ of the law', xlabel='time [s]', ylabel='$W$ [m/s]',
                 xlim=(0.0, end))
        dashes = ['-', (0, (5, 1.6)), (0, (1.2, 1.1)), (0, (5, 1.5, 1.2, 1.5))]
        for (name, run), dash, colour in zip(
                runs.items(), dashes, (INK, AGENTS[0][0], AGENTS[1][0], AGENTS[2][0])):
            m = run.metrics
            right.semilogy(m.time, m.disagreement / m.disagreement[0], color=colour,
                           linestyle=dash, label=name)
        right.axhline(0.01, color=INK, linestyle='--', linewidth=0.7)
        right.annotate('1 %', (end, 0.01), (-2, 2), textcoords='offset points', fontsize=7,
                       ha='right')
        right.set(title='disagreement of the velocities, $\\Lambda(t) / \\Lambda(0)$',
                  xlabel='time [s]', xlim=(0.0, end), ylim=(1e-5, 4.0))
        figure.legend(*right.get_legend_handles_labels(), loc='outside lower center', ncols=4,
                      frameon=False)
        return figure


def flock(run: Simulation, title: str) -> Figure:
    """Return the paths, distances and agreement of a larger flock, in 2-D or 3-D."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(7.2, 4.2), layout='constrained')
        figure.suptitle(title, fontsize=9.5, x=0.01, ha='left', weight='bold')
        grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
        solid = run.positions.shape[2] == 3
        paths = figure.add_subplot(grid[:, 0], projection='3d' if solid else None)
        _draw_paths(paths, run)
        below, agreeing = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
        m = run.metrics
        on_graph = run.graph is not None
        if on_graph or np.sqrt(m.max_r2.max()) < 2.0 * np.sqrt(run.params.d1):
            below.plot(m.time, np.sqrt(m.max_r2), color=AGENTS[1][0], linestyle=AGENTS[1][1],
                       label='longest edge' if on_graph else 'greatest')
        below.plot(m.time, np.sqrt(m.min_r2), color=AGENTS[0][0], label='least of all pairs')
        _bounds(below, run)
        below.set(ylabel='distance [m]', xlim=(0.0, m.time[-1]))
        below.set_ylim(bottom=0.0)
        agreeing.plot(m.time, m.order, color=INK, label='order parameter')
        agreeing.plot(m.time, m.disagreement / m.disagreement[0], color=AGENTS[2][0],
                      linestyle=AGENTS[1][1], label='$\\Lambda(t) / \\Lambda(0)$')
        agreeing.set(xlabel='time [s]', ylabel='agreement', xlim=(0.0, m.time[-1]))
        agreeing.set_ylim(bottom=0.0)
        for axis in (below, agreeing):  # above the axis, where no data can be
            axis.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False,
                        borderaxespad=0.0)
        return figure


def _draw_paths(axis: Axes, run: Simulation) -> None:
    x = run.positions
    # Seen from the flock's own mean, or it would be a bundle of lines a mean velocity long.
    x = x - x.mean(axis=1, keepdims=True)
    if run.graph is not None and len(run.graph.edges) <= 2000:
        for i, j in run.graph.edges:
            axis.plot(*x[-1, [i, j]].T, color=PALE, linewidth=0.5, zorder=1)
    for i in range(min(x.shape[1], 200)):
        axis.plot(*x[:, i].T, color=AGENTS[0][0], linewidth=0.5, alpha=0.55, zorder=2)
    axis.plot(*x[-1].T, 'o', color=INK, markersize=2.5, linestyle='', zorder=3)
    axis.set(title='from the mean position [m]; dots: the end'
             + ('; grey: edges' if run.graph is not None else ''))
    if isinstance(axis, Axes3D):
        axis.set_aspect('equal')
        axis.set_box_aspect(np.ptp(np.reshape(axis.get_w_lims(), (3, 2)), axis=1), zoom=1.0)
        axis.tick_params(pad=0)
    else:
        axis.set_aspect('equal', adjustable='datalim')


def _panels(runs: Runs, title: str, draw: Draw, handles: list[Line2D | Patch], x_label: str,
            y_label: str, note: str, height: float = 3.7, share: bool = True) -> Figure:
    """Return one panel per run, the legend, and a note, in the place of the third of six."""
    figure = Figure(figsize=(7.2, height), layout='constrained')
    figure.suptitle(title, fontsize=9.5, x=0.01, ha='left', weight='bold')
    axes = figure.subplots(2, 3, sharex=share, sharey=share)
    for letter, axis, (name, run) in zip('abcde', axes.flat[[0, 1, 3, 4, 5]], runs.items()):
        axis.set_title(f'({letter}) {name}')
        draw(axis, run)
    for axis in axes[1]:
        axis.set_xlabel(x_label)
    for axis in axes[:, 0]:
        axis.set_ylabel(y_label)
    key = axes[0, 2]
    key.set_axis_off()
    key.legend(handles=handles, loc='upper left', frameon=False, handlelength=2.6,
               labelspacing=0.8, borderaxespad=0.0)
    key.text(0.02, 0.02, note, transform=key.transAxes, fontsize=7, va='bottom')
    return figure


def _agent_handles(names: tuple[str, ...]) -> list[Line2D | Patch]:
    return [Line2D([], [], color=colour, linestyle=dash, label=name)
            for name, (colour, dash) in zip(names, AGENTS)]


def _bounds(axis: Axes, run: Simulation) -> None:
    for bound in np.sqrt([run.params.d0, run.params.d1]):
        axis.axhline(bound, color=INK, linestyle='--', linewidth=0.9, zorder=1.5)
