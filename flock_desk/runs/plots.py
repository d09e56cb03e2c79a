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


"""The pictures of the reports: a flight, errors and their deviations, stages of perception."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import io
from itertools import cycle

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from flock_desk.runs.evaluation import Evaluation
from flock_desk.runs.frame_errors import by_axis, STAGES, Table
from flock_desk.runs.record import Flight, REPLAYED
from flock_desk.runs.report import Chapter, Illustration
from flock_desk.runs.summary import consistency, sight_figures
from flock_follower.geometry import Array

matplotlib.use('Agg')
matplotlib.rcParams.update({
    'axes.grid': True, 'grid.alpha': 0.25, 'grid.linewidth': 0.6, 'axes.spines.top': False,
    'axes.spines.right': False, 'axes.titlelocation': 'left', 'axes.titlesize': 11})

# Okabe and Ito's palette: colour-blind people distinguish the colours; in grey they differ, too.
LEADER, FOLLOWER, VEHICLE, LIMIT = '#0072B2', '#D55E00', '#009E73', '#444444'
_SHADE = '#CC79A7'
COLOURS = (LEADER, FOLLOWER, VEHICLE, _SHADE, '#E69F00', '#56B4E9', '#F0E442', LIMIT)
_SPEED_COLOURS = {'leader': LEADER, REPLAYED: VEHICLE}  # otherwise the follower's
_STAGE_COLOURS = {'none': LIMIT, 'track': VEHICLE, 'roi': '#E69F00', 'full': FOLLOWER}
_STATES = ('IDLE', 'SEARCH', 'HOLD', 'COAST', 'RELATIVE', 'TRACK')  # from bottom to top
LONGEST_LINE = 0.5  # s: across a longer gap no line is drawn
LEAST_SHADED = 0.2  # s: shorter times in which the leader could not be seen are not shaded
PAIR_PERIOD, MOST_PAIRS = 5.0, 24  # s between the lines from follower to leader, at most so many
NARROWEST = 0.35  # of its length, of a map
TIME = 'time [s]'


def evaluation_chapters(evaluation: Evaluation) -> list[Chapter]:
    """Return what the report of ``evaluate`` shows."""
    ticks, setpoints = evaluation.ticks, evaluation.setpoints
    tables = {name: evaluation.errors.table(name) for name in evaluation.names}
    found: list[Chapter] = []
    for name, table in tables.items():
        found += chapters(Flight(
            name=name, duration=evaluation.duration, params=evaluation.flight.planner_params,
            table=table, states=evaluation.states, setpoint_times=setpoints[:, 0],
            setpoints=setpoints[:, 1:4], commanded=setpoints[:, 4] == 1.0,
            paths={f'{name}, estimated': np.stack([table['neighbor_x'], table['neighbor_y']], 1),
                   'follower, own odometry': np.stack([table['own_x'], table['own_y']], 1)},
            speeds={'follower in the bag, which does not fly the setpoints': (
                ticks[:, 0], ticks[:, 3])}))
    return [*found, Chapter('Stages', '', [Illustration(stage_picture(
        tables.values(), np.asarray(evaluation.frames), 1e3 * np.asarray(evaluation.frame_cpu),
        evaluation.duration), 'stages and CPU time')])]


def chapters(flight: Flight, note: str = '') -> list[Chapter]:
    """Return the chapters of a flight behind a neighbour: the flight and, with truth, errors."""
    result = [Chapter(f'Flight: {flight.name}', note, [Illustration(
        flight_picture(flight), 'distance, path, setpoints, speed and state')])]
    if _has_truth(flight.table):
        result.append(Chapter(
            f'Errors against the truth: {flight.name}',
            'Relative to the follower, along its own axes. The band is two standard deviations of '
            'the published covariances: 95 % of the errors should be inside. The NEES is the mean '
            'squared error in units of the covariance: 3 is expected, more is overconfident.',
            [Illustration(error_picture(flight), 'errors and their deviations')]))
    return result


def flight_picture(flight: Flight, title: str = '') -> bytes:
    """Return the picture of a flight, PNG; it shows errors only if there is truth."""
    truth = _has_truth(flight.table)
    figure = Figure(figsize=(13, 9.5), dpi=110, layout='constrained')
    if title:
        figure.suptitle(title, fontsize=14, x=0.01, ha='left', weight='bold')
    left = ['distance', 'acceleration', 'speed', 'state']
    right = ['above', 'above', *(('position', 'velocity') if truth else 2 * ('above',))]
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [list(row) for row in zip(left, right)], width_ratios=[1.45, 1.0],
        height_ratios=[1.2, 1.2, 1.0, 0.8])
    table, params = with_gaps(flight.table), flight.params
    draw_distance(axes['distance'], flight, table)
    draw_above(axes['above'], flight)
    _draw_acceleration(axes['acceleration'], flight)
    _draw_limit(axes['speed'], params.v_max, f'v_max\n{params.v_max:g} m/s')
    for label, (times, speeds) in flight.speeds.items():
        axes['speed'].plot(times, speeds, linewidth=1.1, label=label,
                           color=_SPEED_COLOURS.get(label, FOLLOWER))
    axes['speed'].set(ylabel='speed [m/s]', ylim=(0.0, None))
    add_key(axes['speed'])
    _draw_states(axes['state'], flight)
    if truth:
        figures = sight_figures([flight.table], params.max_velocity_std)
        for kind, unit in (('position', 'cm'), ('velocity', 'cm/s')):
            rms = figures['position_rms_m' if kind == 'position' else 'velocity_rms_m_s']
            errors = 100.0 * _norms(by_axis(table, kind))
            axes[kind].plot(table['time'], errors, color=FOLLOWER, linewidth=0.9)
            axes[kind].set(ylabel=f'{kind} error [{unit}]',
                           ylim=(0.0, 1.2 * _usually(errors, 99.5)))
            if rms is not None:
                axes[kind].set_title(f'error of the relative {kind}: RMS {100 * rms:.2f} {unit}')
    for name, axis in axes.items():
        if name != 'above':
            axis.set_xlim(0.0, max(flight.duration, 1e-3))
        if name not in ('above', 'distance'):
            _shade(axis, flight.blind)
    for name in ('state', 'velocity') if truth else ('state',):
        axes[name].set_xlabel(TIME)
    return encoded(figure)


def error_picture(flight: Flight) -> bytes:
    """Return the picture of the errors and twice their deviations by axis, PNG."""
    table = with_gaps(flight.table)
    figures = sight_figures([flight.table], flight.params.max_velocity_std)
    figure = Figure(figsize=(13, 7), dpi=110, layout='constrained')
    axes = figure.subplots(3, 2, sharex=True)
    for column, (kind, unit) in enumerate((('position', 'cm'), ('velocity', 'cm/s'))):
        # One scale for the three axes, which makes them comparable.
        errors, sigmas = 100.0 * by_axis(table, kind), 100.0 * by_axis(table, f'{kind}_sigma')
        limit = 1.15 * max(_usually(np.abs(errors), 99.0), _usually(2.0 * sigmas, 90.0))
        for row, axis in enumerate(('x, forward', 'y, left', 'z, up')):
            plot: Axes = axes[row, column]
            plot.fill_between(table['time'], -2.0 * sigmas[:, row], 2.0 * sigmas[:, row],
                              color=LEADER, alpha=0.15, linewidth=0)
            plot.axhline(0.0, color=LIMIT, linewidth=0.6)
            plot.plot(table['time'], errors[:, row], color=FOLLOWER, linewidth=0.9)
            plot.set(ylim=(-limit, limit), ylabel=f'error {axis} [{unit}]')
        known = np.isfinite(errors)
        inside = float(np.mean(np.abs(errors[known]) <= 2.0 * sigmas[known])) if (
            known.any()) else 0.0
        nees = figures[f'nees_{kind}']
        verdict = '' if nees is None else f'; NEES {nees:.1f}: {consistency(nees)}'
        axes[0, column].set_title(
            f'relative {kind}: {100.0 * inside:.0f} % within two deviations{verdict}')
        axes[2, column].set_xlabel(TIME)
    axes[0, 0].set_xlim(0.0, max(flight.duration, 1e-3))
    for plot in axes.ravel():
        _shade(plot, flight.blind)
    return encoded(figure)


def stage_picture(tables: Iterable[Table], times: Array, cpu_ms: Array,
                  duration: float) -> bytes:
    """Return the picture of the stage that measured each neighbour, and of CPU times, PNG."""
    figure = Figure(figsize=(13, 4), dpi=110, layout='constrained')
    stages, cpu = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 1.5])
    for table in map(with_gaps, tables):
        for code, stage in enumerate(STAGES):
            at = table['time'][table['stage'] == code]
            stages.plot(at, np.full(len(at), code), '|', color=_STAGE_COLOURS[stage],
                        markersize=13, markeredgewidth=1.2)
    stages.set(ylabel='stage', ylim=(-0.6, 3.6), title='stage that measured the neighbour in '
               'each image, and CPU time of perception')
    stages.set_yticks(range(len(STAGES)), STAGES)
    cpu.plot(times, cpu_ms, '.', color=LEADER, markersize=3.5)
    cpu.set(ylabel='CPU time [ms]', xlabel=TIME, ylim=(0.0, 1.25 * _usually(cpu_ms, 99.5)),
            xlim=(0.0, max(duration, 1e-3)))
    return encoded(figure)


def with_gaps(table: Table) -> Mapping[str, Array]:
    """Return a table with a row of NaN if images are missing, and so no line."""
    breaks = np.flatnonzero(np.diff(table['time']) > LONGEST_LINE) + 1
    return {name: np.insert(column, breaks, np.nan) for name, column in table.items()}


def equal_scales(axis: Axes) -> None:
    """Give both axes one scale, and a box as narrow as the data, within ``NARROWEST``."""
    limits = np.array([axis.get_xlim(), axis.get_ylim()])
    spans = np.ptp(limits, axis=1)
    half = 0.5 * np.maximum(spans, NARROWEST * spans.max())
    (left, bottom), (right, top) = limits.mean(axis=1) - half, limits.mean(axis=1) + half
    axis.set(xlim=(left, right), ylim=(bottom, top))
    axis.set_aspect('equal', adjustable='box')


def draw_distance(axis: Axes, flight: Flight, table: Table) -> None:
    """Draw the estimated and the true distance in the band; the table has rows of gaps."""
    law = flight.params.law
    low, high = np.sqrt(law.d0), np.sqrt(law.d1)
    axis.axhspan(low, high, color=LEADER, alpha=0.08, lw=0)
    _draw_limit(axis, low, f'√d0\n{low:.2f} m')
    _draw_limit(axis, high, f'√d1\n{high:.2f} m')
    axis.plot(table['time'], table['distance'], color=FOLLOWER, linewidth=2.6, alpha=0.6,
              label='estimated')
    if _has_truth(table):  # above the estimate: the difference is often less than a line's width
        axis.plot(table['time'], table['true_distance'], color='black', linewidth=0.9,
                  linestyle=(0, (5, 3)), label='true')
    shown = np.concatenate([table['distance'], table['true_distance']])
    shown = shown[np.isfinite(shown)]
    axis.set(ylabel='distance [m]', title=f'distance to {flight.name}',
             ylim=(min(0.8 * low, 0.9 * np.min(shown, initial=np.inf)),
                   max(1.05 * high, 1.08 * np.max(shown, initial=0.0))))
    _shade(axis, flight.blind, 'leader not visible')
    add_key(axis)


def draw_above(axis: Axes, flight: Flight) -> None:
    """Draw the paths from above, and lines between leader and follower at the same times."""
    times = flight.table['time']
    period = max(PAIR_PERIOD, flight.duration / MOST_PAIRS)
    draw_map(axis, flight.paths, f'from above (● start, ■ end; a line every {period:.0f} s)')
    for k in np.searchsorted(times, np.arange(0.0, flight.duration, period)):
        if k < len(times):
            axis.plot(*np.transpose([path[k, :2] for path in flight.paths.values()]),
                      color=LIMIT, linewidth=0.6, alpha=0.5)


def draw_map(axis: Axes, paths: Mapping[str, Array], title: str) -> None:
    """Draw paths (n, 2) or (n, 3), m, from above, each with its label."""
    for (label, path), colour in zip(paths.items(), cycle(COLOURS)):
        axis.plot(*path[:, :2].T, color=colour, linewidth=1.7, label=label)
        known = np.flatnonzero(np.isfinite(path[:, :2]).all(axis=1))
        for k, marker in zip((*known[:1], *known[-1:]), 'os'):
            axis.plot(*path[k, :2], marker, color=colour, markersize=6)
    axis.set(title=title, xlabel='x [m]', ylabel='y [m]')
    equal_scales(axis)
    axis.set_anchor('N')
    axis.legend(loc='best', fontsize=9)


def _draw_acceleration(axis: Axes, flight: Flight) -> None:
    """Draw the setpoints by axis of odom, and their norm, which a_max limits."""
    times, setpoints = flight.setpoint_times, flight.setpoints
    a_max = flight.params.a_max
    _draw_limit(axis, a_max, f'a_max\n{a_max:g} m/s²')
    for values, colour, label in zip(setpoints.T, (LEADER, FOLLOWER, VEHICLE), 'xyz'):
        axis.plot(times, values, color=colour, linewidth=0.8, label=label)
    norms = _norms(setpoints)
    axis.plot(times, norms, color=LIMIT, linewidth=1.2, label='norm')
    if flight.commanded is not None and not flight.commanded.all():
        idle = ~flight.commanded
        axis.plot(times[idle], norms[idle], '.', color=_SHADE, markersize=5,
                  label='no command: brake or level')
    axis.set(ylabel='acceleration [m/s²]', title='setpoint (odom axes)')
    add_key(axis)


def _draw_states(axis: Axes, flight: Flight) -> None:
    entered = [(max(0.0, time), _STATES.index(state)) for time, state in flight.states]
    if entered:
        times, levels = zip(*entered, (flight.duration, entered[-1][1]))
        axis.step(times, levels, where='post', color=VEHICLE, linewidth=1.5)
    axis.set(ylabel="planner's state", ylim=(-0.3, len(_STATES) - 0.7))
    axis.set_yticks(range(len(_STATES)), _STATES)


def _draw_limit(axis: Axes, value: float, text: str) -> None:
    """Draw a limit, with its name beside the axis, where no data are."""
    axis.axhline(value, color=LIMIT, linestyle='--', linewidth=1)
    axis.annotate(text, (1.0, value), (4, 0), fontsize=8, ha='left', va='center',
                  xycoords=('axes fraction', 'data'), textcoords='offset points')


def _shade(axis: Axes, spans: Sequence[tuple[float, float]], label: str = '') -> None:
    """Shade the times in which the leader could not be seen, but not single images."""
    for begin, end in spans:
        if end - begin >= LEAST_SHADED:
            axis.axvspan(begin, end, color=_SHADE, alpha=0.35, lw=0, zorder=0, label=label)
            label = ''


def add_key(axis: Axes) -> None:
    """Add a legend above the axis, where no data are."""
    axis.legend(loc='lower right', bbox_to_anchor=(1.0, 0.99), ncols=6, frameon=False, fontsize=9,
                borderaxespad=0.0, columnspacing=1.2)


def _has_truth(table: Table) -> bool:
    return bool(np.any(np.isfinite(table['true_distance'])))


def _norms(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=1)


def _usually(values: Array, percentile: float) -> float:
    """Return the upper end of an axis that shows all values but the wildest."""
    finite = values[np.isfinite(values)]
    return max(float(np.percentile(finite, percentile)) if len(finite) else 0.0, 1e-3)


def encoded(figure: Figure, kind: str = 'png') -> bytes:
    """Return a figure as an image file, PNG or JPEG ('jpg')."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, pil_kwargs={'quality': 88} if kind == 'jpg' else None)
    return buffer.getvalue()
