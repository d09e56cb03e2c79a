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

"""The pictures of an evaluation: the flight, errors beside their covariances, and stages."""

from __future__ import annotations

from collections.abc import Mapping
import io

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from flock_follower.geometry import Array
from flock_follower.tools.evaluation import Evaluation, STATES
from flock_follower.tools.frame_errors import STAGES
from flock_follower.tools.report import (
    draw_distance,
    draw_limited,
    draw_path,
    finish_above,
    FOLLOWER,
    LEADER,
    LIMIT,
    tidy,
    VEHICLE,
)

STAGE_COLOURS = {'none': LIMIT, 'track': VEHICLE, 'roi': '#E69F00', 'full': FOLLOWER}
STATE_COLOURS = {'IDLE': '#BBBBBB', 'SEARCH': '#CC79A7', 'TRACK': VEHICLE, 'COAST': '#E69F00',
                 'HOLD': FOLLOWER}
#: Of longer series every so manieth value is drawn.
MOST_POINTS = 3000
#: Across a longer gap no line is drawn, s.
LONGEST_LINE = 0.5

Table = Mapping[str, Array]


def flight_picture(evaluation: Evaluation, name: str) -> bytes:
    """Return the picture of the flight behind a neighbour, PNG."""
    table = _thinned(evaluation.errors.table(name))
    params = evaluation.lockstep.planner_params
    figure = Figure(figsize=(12, 6.6), dpi=110, layout='constrained')
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [['distance', 'acceleration'], ['above', 'speed']])
    draw_distance(axes['distance'], table['time'], table['distance'], table['true_distance'],
                  params.law.d0, params.law.d1)
    axes['distance'].set_title(f'distance to {name}')
    above = axes['above']
    for colour, who, columns in ((LEADER, name, ('neighbor_x', 'neighbor_y')),
                                 (FOLLOWER, 'follower', ('own_x', 'own_y'))):
        draw_path(above, np.stack([table[c] for c in columns], axis=1), colour,
                  f'{who}, in its odometry' if who == 'follower' else f'{who}, estimated')
    finish_above(above)
    setpoints = _every(evaluation.setpoints)
    draw_limited(axes['acceleration'], setpoints[:, 0], setpoints[:, 1], params.a_max,
                 'acceleration setpoint', '‖a‖ [m/s²]', 'a_max')
    own = setpoints[setpoints[:, 2] == 0.0]
    if len(own):
        axes['acceleration'].plot(own[:, 0], own[:, 1], '.', color=FOLLOWER, markersize=4,
                                  label='no command: brake or level')
        axes['acceleration'].legend(loc='lower right', frameon=False, fontsize=9)
    ticks = _every(evaluation.ticks)
    draw_limited(axes['speed'], ticks[:, 0], ticks[:, 3], params.v_max,
                 'speed of the follower in the bag', '‖v‖ [m/s]', 'v_max')
    for key in ('distance', 'acceleration', 'speed'):
        axes[key].set(xlim=(0.0, max(evaluation.duration, 1e-3)),
                      xlabel='time since the first message [s]')
    return _png(figure, axes.values())


def error_picture(evaluation: Evaluation, name: str) -> bytes:
    """Return the picture of the errors and twice their deviations by axis, PNG."""
    table = _thinned(evaluation.errors.table(name))
    figure = Figure(figsize=(12, 6.6), dpi=110, layout='constrained')
    axes = figure.subplots(3, 2, sharex=True)
    for column, (kind, unit) in enumerate((('position', 'cm'), ('velocity', 'cm/s'))):
        # One scale for the three axes: a glance tells which is worse.
        errors = 100 * np.stack([table[f'{kind}_{axis}'] for axis in 'xyz'])
        sigmas = 100 * np.stack([table[f'{kind}_sigma_{axis}'] for axis in 'xyz'])
        limit = 1.15 * _most_of(errors, 2.0 * sigmas)
        for row, (axis, direction) in enumerate(zip('xyz', ('forward', 'left', 'up'))):
            plot: Axes = axes[row, column]
            _draw_error(plot, table['time'], errors[row], sigmas[row])
            plot.set(ylim=(-limit, limit), ylabel=f'{axis}, {direction} [{unit}]')
        axes[0, column].set_title(f'relative {kind}: error, and two deviations')
        axes[2, column].set_xlabel('time since the first message [s]')
    axes[0, 0].set_xlim(0.0, max(evaluation.duration, 1e-3))
    return _png(figure, axes.ravel())


def stage_picture(evaluation: Evaluation) -> bytes:
    """Return the picture of stages, their CPU time, and what the planner made of it, PNG."""
    figure = Figure(figsize=(12, 5.6), dpi=110, layout='constrained')
    stages, cpu, states = figure.subplots(3, 1, sharex=True, height_ratios=[1.0, 1.5, 1.2])
    shown = 0
    for name in evaluation.names:
        table = _thinned(evaluation.errors.table(name))
        for code, stage in enumerate(STAGES):
            at = table['time'][table['stage'] == code]
            stages.plot(at, np.full(len(at), code), '|', color=STAGE_COLOURS[stage],
                        markersize=13, markeredgewidth=1.2)
            shown += len(at)
    stages.set(title='stage that measured the neighbor in each image', ylim=(-0.6, 3.6))
    stages.set_yticks(range(len(STAGES)), STAGES)
    times, spent = np.asarray(evaluation.frames), 1e3 * np.asarray(evaluation.frame_cpu)
    every = max(1, len(times) // MOST_POINTS)
    cpu.plot(times[::every], spent[::every], '.', color=LEADER, markersize=3.5)
    cpu.set(title='CPU time of perception per image', ylabel='[ms]')
    cpu.set_ylim(0.0, 1.25 * float(np.percentile(spent, 99.5)) if len(spent) else 1.0)
    ticks = _every(evaluation.ticks)
    for code, state in enumerate(STATES):
        at = ticks[ticks[:, 1] == code, 0]
        states.plot(at, np.full(len(at), code), '|', color=STATE_COLOURS[state], markersize=13,
                    markeredgewidth=2.5)
    states.set(title='state of the planner at each tick', ylim=(len(STATES) - 0.4, -0.6),
               xlabel='time since the first message [s]')
    states.set_yticks(range(len(STATES)), STATES)
    states.set_xlim(0.0, max(evaluation.duration, 1e-3))
    return _png(figure, (stages, cpu, states))


def _draw_error(axis: Axes, times: Array, errors: Array, sigmas: Array) -> None:
    axis.fill_between(times, -2.0 * sigmas, 2.0 * sigmas, color=LEADER, alpha=0.15, linewidth=0)
    axis.axhline(0.0, color=LIMIT, linewidth=0.6)
    axis.plot(times, errors, color=FOLLOWER, linewidth=0.9)


def _most_of(errors: Array, bounds: Array) -> float:
    """Return what to draw up to: all errors but the wildest, and the usual bounds."""
    finite = np.abs(errors[np.isfinite(errors)])
    usual = bounds[np.isfinite(bounds)]
    return max(float(np.percentile(finite, 99.0)) if len(finite) else 0.0,
               float(np.percentile(usual, 90.0)) if len(usual) else 0.0, 1e-3)


def _stride(rows: Array) -> int:
    return max(1, len(rows) // MOST_POINTS)


def _every(rows: Array) -> Array:
    return rows[::_stride(rows)]


def _thinned(table: Mapping[str, Array]) -> dict[str, Array]:
    """Return fewer rows where there are many, and one of NaN where images are missing."""
    times = table['time']
    breaks = np.flatnonzero(np.diff(_every(times)) > LONGEST_LINE * _stride(times)) + 1
    return {name: np.insert(_every(column), breaks, np.nan) for name, column in table.items()}


def _png(figure: Figure, axes: object) -> bytes:
    tidy(axes)  # type: ignore[arg-type]
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png')
    return buffer.getvalue()
