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

"""The paper's figures of a flight: where leader and follower were, and how far apart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np

from flock_desk.runs.figure_style import (
    bounds_handle,
    COLOURS,
    draw_bounds,
    Handle,
    INK,
    PALE,
    styled,
    WIDTH,
)
from flock_desk.runs.fly_record import LiveRecord
from flock_desk.runs.plots import thinned
from flock_follower.geometry import Array

LEADER, FOLLOWER = COLOURS[:2]
_TRUTH: dict[str, Any] = {'linewidth': 3.2, 'alpha': 0.3, 'solid_capstyle': 'butt', 'zorder': 1.8}
_TIME = 'time [s]'


def positions(flight: LiveRecord) -> Figure:
    """
    Return x and y of leader and follower over time, m in odom.

    As in the paper they are what the follower knew: its own odometry, and where it saw the leader.
    The true ones, in a frame without drift, are beneath.
    """
    table = _table(flight)
    with styled():
        figure = Figure(figsize=(WIDTH, 3.1), layout='constrained')
        axes: list[Axes] = list(figure.subplots(2, 1, sharex=True))
        for axis, name in zip(axes, 'xy'):
            for who, (colour, dash), known in (('leader', LEADER, f'neighbor_{name}'),
                                               ('follower', FOLLOWER, f'own_{name}')):
                axis.plot(table['time'], table[f'{who}_{name}'], color=colour, **_TRUTH)
                axis.plot(table['time'], table[known], color=colour, linestyle=dash)
            axis.set_ylabel(f'{name} [m]')
        axes[1].set(xlabel=_TIME, xlim=(0.0, flight.duration))
        figure.align_ylabels(axes)
        handles: list[Handle] = [
            Line2D([], [], color=colour, linestyle=dash, label=who)
            for who, (colour, dash) in (('leader', LEADER), ('follower', FOLLOWER))]
        figure.legend(handles=[*handles, _truth_handle('their true places')],
                      loc='outside upper center', ncols=3)
        return figure


def distance(flight: LiveRecord) -> Figure:
    """Return the distance over time, m, as the follower knew it and as it was, in the band."""
    table, law = _table(flight), flight.params.law
    with styled():
        figure = Figure(figsize=(WIDTH, 2.2), layout='constrained')
        axis: Axes = figure.subplots()
        for begin, end in flight.blind:
            axis.axvspan(begin, end, color=PALE, alpha=0.6, linewidth=0)
        axis.plot(table['time'], table['true_distance'], color=INK, **_TRUTH)
        axis.plot(table['time'], table['distance'], color=LEADER[0], linewidth=1.0)
        draw_bounds(axis, law)
        top = max(1.12 * np.sqrt(law.d1), 1.05 * _greatest(table))
        axis.set(xlabel=_TIME, ylabel='distance [m]', xlim=(0.0, flight.duration),
                 ylim=(0.0, top))
        handles: list[Handle] = [
            Line2D([], [], color=LEADER[0], linewidth=1.0, label='estimated'),
            _truth_handle('true'), bounds_handle('$\\sqrt{d_0}$, $\\sqrt{d_1}$')]
        if flight.blind:
            handles.append(Patch(color=PALE, alpha=0.6, linewidth=0, label='hidden'))
        figure.legend(handles=handles, loc='outside upper center', ncols=len(handles),
                      columnspacing=1.2, handlelength=1.8)
        return figure


def _table(flight: LiveRecord) -> Mapping[str, Array]:
    """Return the columns drawn; NaN where images are missing, and so no line."""
    true = {f'{who}_{name}': column
            for who, places in (('leader', flight.leader), ('follower', flight.follower))
            for name, column in zip('xy', places.T)}
    return thinned({**flight.table, **true})


def _greatest(table: Mapping[str, Array]) -> float:
    apart = np.concatenate([table['distance'], table['true_distance']])
    return float(np.max(apart[np.isfinite(apart)], initial=0.0))


def _truth_handle(label: str) -> Handle:
    return Line2D([], [], color=INK, linewidth=_TRUTH['linewidth'], alpha=_TRUTH['alpha'],
                  label=label)
