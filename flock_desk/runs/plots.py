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

"""The pictures of a flight: what it did, errors beside their deviations, stages of perception."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import io
from itertools import cycle
from typing import NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

from flock_desk.runs.frame_errors import STAGES, Table
from flock_desk.runs.report import Chapter, Illustration
from flock_desk.runs.summary import sight_figures
from flock_follower.geometry import Array
from flock_follower.planner.params import PlannerParams

matplotlib.use('Agg')

# Okabe and Ito's palette: told apart by the colour-blind, and by lightness in grey.
LEADER, FOLLOWER, VEHICLE, LIMIT = '#0072B2', '#D55E00', '#009E73', '#444444'
_SHADE = '#CC79A7'
_STAGE_COLOURS = {'none': LIMIT, 'track': VEHICLE, 'roi': '#E69F00', 'full': FOLLOWER}
_STATES = ('IDLE', 'SEARCH', 'HOLD', 'COAST', 'TRACK')  # from bottom to top
#: Of longer series every so manieth value is drawn.
MOST_POINTS = 3000
#: Across a longer gap no line is drawn, s.
LONGEST_LINE = 0.5
#: Shorter times in which the leader could not be seen are not shaded, s.
LEAST_SHADED = 0.2
#: Where leader and follower were at the same time is shown this often, s, but not more often than
#: so many times.
PAIR_PERIOD, MOST_PAIRS = 5.0, 24
_TIME = 'time [s]'


class Curve(NamedTuple):
    """A line of a picture, x and y (n,); NaN leaves a gap."""

    label: str
    colour: str
    x: Array
    y: Array


@dataclass(frozen=True, eq=False)
class PlottedFlight:
    """
    What the pictures of a flight behind one neighbour show, times in s from its beginning.

    ``table`` is that of ``frame_errors``; ``paths`` are seen from above, m, the leader's and the
    follower's first, at the table's times; ``speeds`` are m/s over time. ``setpoints`` (k, 3),
    m/s^2, were sent at ``setpoint_times`` (k,), for want of a command where ``commanded`` (k,) is
    False. ``states`` are the planner's, with when it entered them. ``blind`` holds when the leader
    could not be seen, from and to.
    """

    name: str
    duration: float
    table: Table
    params: PlannerParams
    paths: Sequence[Curve]
    speeds: Sequence[Curve]
    setpoint_times: Array
    setpoints: Array
    commanded: Array
    states: Sequence[tuple[float, str]]
    blind: Sequence[tuple[float, float]] = ()


def flight_picture(flight: PlottedFlight, title: str = '') -> bytes:
    """Return the picture of a flight, PNG; it shows errors only where there is truth."""
    truth = bool(np.any(np.isfinite(flight.table['true_distance'])))
    figure = Figure(figsize=(13, 11), dpi=110, layout='constrained')
    if title:
        figure.suptitle(title, fontsize=14, x=0.01, ha='left', weight='bold')
    right = ['above', 'above', 'above', *(('position', 'velocity') if truth else 2 * ('above',))]
    left = ['distance', 'acceleration', 'speed', 'state', 'axes']
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [list(row) for row in zip(left, right)], width_ratios=[1.45, 1.0],
        height_ratios=[1.2, 1.0, 1.0, 0.8, 1.0])
    table, params = thinned(flight.table), flight.params
    _draw_distance(axes['distance'], flight, table)
    _draw_above(axes['above'], flight)
    every = _stride(flight.setpoint_times)
    times, setpoints = flight.setpoint_times[::every], flight.setpoints[::every]
    _draw_limited(axes['acceleration'], [Curve('', VEHICLE, times, _norms(setpoints))],
                  params.a_max, 'a_max')
    axes['acceleration'].set(title='acceleration setpoint', ylabel='‖a‖ [m/s²]')
    own = ~flight.commanded[::every].astype(bool)
    if own.any():
        axes['acceleration'].plot(times[own], _norms(setpoints[own]), '.', color=FOLLOWER,
                                  markersize=4, label='no command: brake or level')
        _key(axes['acceleration'], 'upper left')
    _draw_limited(axes['speed'], flight.speeds, params.v_max, 'v_max')
    axes['speed'].set(title='speed', ylabel='‖v‖ [m/s]')
    _key(axes['speed'], 'upper left', 3)
    _draw_states(axes['state'], flight)
    for k, (name, colour) in enumerate((('x', LEADER), ('y', FOLLOWER), ('z', VEHICLE))):
        axes['axes'].plot(times, setpoints[:, k], color=colour, linewidth=0.9, label=name)
    axes['axes'].margins(y=0.25)  # room for the key
    axes['axes'].set(title='acceleration setpoint by axis of odom', ylabel='[m/s²]', xlabel=_TIME)
    _key(axes['axes'], 'upper left', 3)
    if truth:
        figures = sight_figures([flight.table], params.max_velocity_std)
        _draw_error(axes['position'], table, 'position', 'cm', figures['position_rms_m'])
        _draw_error(axes['velocity'], table, 'velocity', 'cm/s', figures['velocity_rms_m_s'])
        axes['velocity'].set_xlabel(_TIME)
    for name, axis in axes.items():
        if name != 'above':
            axis.set_xlim(0.0, max(flight.duration, 1e-3))
        if name not in ('above', 'distance'):
            _shade(axis, flight.blind)
    return _png(figure, axes.values())


def error_picture(flight: PlottedFlight) -> bytes:
    """Return the picture of the errors and twice their deviations by axis, PNG."""
    table = thinned(flight.table)
    figure = Figure(figsize=(13, 7), dpi=110, layout='constrained')
    axes = figure.subplots(3, 2, sharex=True)
    for column, (kind, unit) in enumerate((('position', 'cm'), ('velocity', 'cm/s'))):
        # One scale for the three axes: a glance tells which is worse.
        errors = 100 * np.stack([table[f'{kind}_{axis}'] for axis in 'xyz'])
        sigmas = 100 * np.stack([table[f'{kind}_sigma_{axis}'] for axis in 'xyz'])
        limit = 1.15 * max(_usually(np.abs(errors), 99.0), _usually(2.0 * sigmas, 90.0))
        for row, (axis, direction) in enumerate(zip('xyz', ('forward', 'left', 'up'))):
            plot: Axes = axes[row, column]
            plot.fill_between(table['time'], -2.0 * sigmas[row], 2.0 * sigmas[row], color=LEADER,
                              alpha=0.15, linewidth=0)
            plot.axhline(0.0, color=LIMIT, linewidth=0.6)
            plot.plot(table['time'], errors[row], color=FOLLOWER, linewidth=0.9)
            plot.set(ylim=(-limit, limit), ylabel=f'{axis}, {direction} [{unit}]')
        axes[0, column].set_title(f'relative {kind}: error, and two deviations')
        axes[2, column].set_xlabel(_TIME)
    axes[0, 0].set_xlim(0.0, max(flight.duration, 1e-3))
    for plot in axes.ravel():
        _shade(plot, flight.blind)
    return _png(figure, axes.ravel())


def stage_picture(tables: Iterable[Table], times: Array, cpu_ms: Array,
                  duration: float) -> bytes:
    """Return the picture of what stage measured each neighbour, and the images' CPU time, PNG."""
    figure = Figure(figsize=(13, 4), dpi=110, layout='constrained')
    stages, cpu = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 1.5])
    for table in map(thinned, tables):
        for code, stage in enumerate(STAGES):
            at = table['time'][table['stage'] == code]
            stages.plot(at, np.full(len(at), code), '|', color=_STAGE_COLOURS[stage],
                        markersize=13, markeredgewidth=1.2)
    stages.set(title='stage that measured the neighbor in each image', ylim=(-0.6, 3.6))
    stages.set_yticks(range(len(STAGES)), STAGES)
    every = _stride(times)
    cpu.plot(times[::every], cpu_ms[::every], '.', color=LEADER, markersize=3.5)
    cpu.set(title='CPU time of perception per image', ylabel='[ms]', xlabel=_TIME,
            ylim=(0.0, 1.25 * _usually(cpu_ms, 99.5)), xlim=(0.0, max(duration, 1e-3)))
    return _png(figure, (stages, cpu))


def portrait(image: NDArray[np.uint8], flight: PlottedFlight) -> bytes:
    """Return what one saw beside where both went and how far apart they were, JPEG."""
    figure = Figure(figsize=(12, 4.4), dpi=100, layout='constrained')
    axes: dict[str, Axes] = figure.subplot_mosaic([['seen', 'above'], ['seen', 'distance']],
                                                  width_ratios=[1.3, 1.0],
                                                  height_ratios=[1.3, 1.0])
    axes['seen'].imshow(image, cmap='gray', vmin=0, vmax=255)
    axes['seen'].set(title="the follower's camera", xticks=[], yticks=[])
    _draw_above(axes['above'], flight)
    _draw_distance(axes['distance'], flight, thinned(flight.table))
    axes['distance'].set(xlim=(0.0, flight.duration), xlabel=_TIME)
    for axis in (axes['above'], axes['distance']):
        axis.grid(alpha=0.25, linewidth=0.6)
        axis.spines[['top', 'right']].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format='jpg', pil_kwargs={'quality': 88})
    return buffer.getvalue()


def column_picture(times: Array, tracks: Mapping[str, Array], distances: Mapping[str, Array],
                   params: PlannerParams) -> bytes:
    """
    Return the picture of several vehicles, PNG.

    :param tracks: (n, 3) of each, m; :param distances: (n,) of each two, m.
    """
    figure = Figure(figsize=(13, 8), dpi=110, layout='constrained')
    above, apart = figure.subplots(2, 1, height_ratios=[1.2, 1.0])
    colours = [LEADER, FOLLOWER, VEHICLE, _SHADE, '#E69F00', '#56B4E9', '#F0E442', LIMIT]
    every = _stride(times)
    for (name, track), colour in zip(tracks.items(), cycle(colours)):
        known = track[np.isfinite(track[:, 0])][::every]
        above.plot(known[:, 0], known[:, 1], color=colour, linewidth=1.5, label=name)
        for k, marker in ((0, 'o'), (-1, 's')):
            above.plot(known[k, 0], known[k, 1], marker, color=colour, markersize=6)
    above.set(title='from above (● start, ■ end)', xlabel='x [m]', ylabel='y [m]')
    above.set_aspect('equal', adjustable='datalim')
    _key(above, 'best')
    apart.axhspan(np.sqrt(params.law.d0), np.sqrt(params.law.d1), color=LEADER, alpha=0.08, lw=0)
    for (name, distance), colour in zip(distances.items(), cycle(colours)):
        apart.plot(times[::every], distance[::every], color=colour, linewidth=1.1, label=name)
    apart.set(title='true distances; shaded: the band of each and the one before it',
              xlabel=_TIME, ylabel='[m]', xlim=(0.0, float(times[-1])))
    apart.set_ylim(bottom=0.0)
    _key(apart, 'lower left', 3)
    return _png(figure, (above, apart))


def chapters(flight: PlottedFlight, *, truth: bool = True, note: str = '') -> list[Chapter]:
    """Return the chapters of a flight behind a neighbour: what it did and, with truth, errors."""
    result = [Chapter(f'Flight: {flight.name}', note, [Illustration(
        flight_picture(flight), 'distance, path, setpoints, speed and state')])]
    if truth:
        result.append(Chapter(
            f'Errors against the truth: {flight.name}',
            'Relative to the follower, along its own axes. The band is twice the deviation that '
            'follows from the published covariances: 95 % of the errors should be inside.',
            [Illustration(error_picture(flight), 'errors and their deviations')]))
    return result


def thinned(table: Table) -> Mapping[str, Array]:
    """Return fewer rows where there are many, and one of NaN where images are missing."""
    times = table['time']
    every = _stride(times)
    breaks = np.flatnonzero(np.diff(times[::every]) > LONGEST_LINE * every) + 1
    return {name: np.insert(column[::every], breaks, np.nan) for name, column in table.items()}


def _shade(axis: Axes, spans: Sequence[tuple[float, float]], label: str = '') -> None:
    """Shade when the leader could not be seen; single images that miss it are no outage."""
    for begin, end in spans:
        if end - begin >= LEAST_SHADED:
            axis.axvspan(begin, end, color=_SHADE, alpha=0.35, lw=0, zorder=0, label=label)
            label = ''


def _draw_distance(axis: Axes, flight: PlottedFlight, table: Table) -> None:
    params = flight.params
    low, high = np.sqrt(params.law.d0), np.sqrt(params.law.d1)
    axis.axhspan(low, high, color=LEADER, alpha=0.08, lw=0)
    for bound, text in ((low, '√d0'), (high, '√d1')):
        _draw_limit(axis, bound, f'{text} = {bound:.2f} m')
    if np.any(np.isfinite(table['true_distance'])):
        axis.plot(table['time'], table['true_distance'], color=LIMIT, linewidth=3, alpha=0.35,
                  label='truth')
    axis.plot(table['time'], table['distance'], color=FOLLOWER, linewidth=1.1, label='estimated')
    shown = np.concatenate([table['distance'], table['true_distance']])
    shown = shown[np.isfinite(shown)]
    axis.set(title=f'distance to {flight.name}; light blue: the band', ylabel='[m]',
             ylim=(min(0.6 * low, 0.9 * np.min(shown, initial=np.inf)),
                   max(1.1 * high, 1.08 * np.max(shown, initial=0.0))))
    _shade(axis, flight.blind, 'cannot be seen, or placed')
    _key(axis, 'lower left', 3)


def _draw_above(axis: Axes, flight: PlottedFlight) -> None:
    for path in flight.paths:
        axis.plot(path.x, path.y, color=path.colour, linewidth=1.7, label=path.label)
        known = np.flatnonzero(np.isfinite(path.x) & np.isfinite(path.y))
        for k, marker in zip((*known[:1], *known[-1:]), 'os'):
            axis.plot(path.x[k], path.y[k], marker, color=path.colour, markersize=6)
    times = flight.table['time']
    period = max(PAIR_PERIOD, flight.duration / MOST_PAIRS)
    for k in np.searchsorted(times, np.arange(0.0, flight.duration, period)):
        if k < len(times):
            axis.plot([path.x[k] for path in flight.paths[:2]],
                      [path.y[k] for path in flight.paths[:2]],
                      color=LIMIT, linewidth=0.6, alpha=0.5)
    axis.set(title=f'from above (● start, ■ end; a line every {period:.0f} s)', xlabel='x [m]',
             ylabel='y [m]')
    axis.set_aspect('equal', adjustable='datalim')
    _key(axis, 'best')


def _draw_limited(axis: Axes, curves: Sequence[Curve], limit: float, name: str) -> None:
    _draw_limit(axis, limit, f'{name} = {limit:g}')
    top = limit
    for curve in curves:
        axis.plot(curve.x, curve.y, color=curve.colour, linewidth=1.1, label=curve.label)
        top = max(top, 0.9 * float(np.nanmax(curve.y, initial=0.0)))
    axis.set_ylim(0.0, 1.25 * top)


def _draw_limit(axis: Axes, value: float, text: str) -> None:
    axis.axhline(value, color=LIMIT, linestyle='--', linewidth=1)
    axis.annotate(text, (1.0, value), (-4, 3), fontsize=8, ha='right',
                  xycoords=('axes fraction', 'data'), textcoords='offset points')


def _draw_states(axis: Axes, flight: PlottedFlight) -> None:
    entered = [(max(0.0, time), _STATES.index(state)) for time, state in flight.states]
    if entered:
        times, levels = zip(*entered, (flight.duration, entered[-1][1]))
        axis.step(times, levels, where='post', color=VEHICLE, linewidth=1.5)
    axis.set(title="the planner's state", ylim=(-0.3, len(_STATES) - 0.7))
    axis.set_yticks(range(len(_STATES)), _STATES)


def _draw_error(axis: Axes, table: Table, kind: str, unit: str, rms: float | None) -> None:
    errors = 100 * _norms(np.stack([table[f'{kind}_{axis_}'] for axis_ in 'xyz'], axis=1))
    axis.plot(table['time'], errors, color=FOLLOWER if kind == 'position' else LEADER,
              linewidth=0.9)
    told = '' if rms is None else f', RMS {100 * rms:.2f} {unit}'
    axis.set(title=f'error of the relative {kind}{told}', ylabel=f'[{unit}]',
             ylim=(0.0, 1.4 * _usually(errors, 99.5)))


def _key(axis: Axes, place: str, columns: int = 1) -> None:
    axis.legend(loc=place, ncols=columns, frameon=False, fontsize=9)


def _norms(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=1)


def _usually(values: Array, percentile: float) -> float:
    """Return what to draw up to: all values but the wildest."""
    finite = values[np.isfinite(values)]
    return max(float(np.percentile(finite, percentile)) if len(finite) else 0.0, 1e-3)


def _stride(rows: Array) -> int:
    return max(1, len(rows) // MOST_POINTS)


def _png(figure: Figure, axes: Iterable[Axes]) -> bytes:
    for axis in axes:
        axis.grid(alpha=0.25, linewidth=0.6)
        axis.spines[['top', 'right']].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png')
    return buffer.getvalue()
