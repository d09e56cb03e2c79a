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


"""The pictures of the reports: flights, errors and their deviations, columns of followers."""

from __future__ import annotations

from collections.abc import Mapping
import io

import cv2
import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from flock_desk.runs.evaluation import Evaluation
from flock_desk.runs.frame_errors import Table
from flock_desk.runs.record import Flight, LiveFlight, REPLAYED
from flock_desk.runs.report import Chapter, Illustration
from flock_desk.runs.summary import consistency, norms, sight_figures
from flock_follower.geometry import Array

matplotlib.use('Agg')
matplotlib.rcParams.update({
    'axes.grid': True, 'grid.alpha': 0.25, 'grid.linewidth': 0.6, 'axes.spines.top': False,
    'axes.spines.right': False, 'axes.titlelocation': 'left', 'axes.titlesize': 11})

# Okabe and Ito's palette: color-blind people distinguish the colors; in gray they differ, too.
LEADER, FOLLOWER, VEHICLE, LIMIT = '#0072B2', '#D55E00', '#009E73', '#444444'
_SHADE = '#CC79A7'
_STATES = ('IDLE', 'SEARCH', 'HOLD', 'COAST', 'RELATIVE', 'TRACK')  # from bottom to top
MAX_LINE_GAP = 0.5  # s: across a longer gap no line is drawn
LEAST_SHADED = 0.2  # s: shorter times in which the leader could not be seen are not shaded
PAIR_PERIOD = 5.0  # s between the lines from follower to leader
MAX_PAIRS = 24  # lines from follower to leader
NARROWEST = 0.35  # of its length, of a map
TIME = 'time [s]'


def evaluation_chapters(evaluation: Evaluation) -> list[Chapter]:
    """Return the chapters of ``evaluate``: flight and errors of each neighbor."""
    ticks, setpoints = evaluation.ticks, evaluation.setpoints
    return [chapter for name, table in evaluation.tables.items() for chapter in chapters(Flight(
        name=name, duration=evaluation.duration, params=evaluation.params,
        table=table, states=evaluation.states, setpoint_times=setpoints[:, 0],
        setpoints=setpoints[:, 1:4], commanded=setpoints[:, 4] == 1.0,
        paths={f'{name}, estimated': table['neighbor'], 'follower, own odometry': table['own']},
        speeds={'follower in the bag, which does not fly the setpoints': (
            ticks[:, 0], ticks[:, 3])}))]


def scenario_chapters(flight: LiveFlight) -> list[Chapter]:
    """Return the chapters of ``fly``: plots, and images of the follower's camera."""
    log = flight.log
    epoch = int(log['image_stamp'][0]) - round(float(flight.table['time'][0]) * 1e9)
    return [
        *chapters(flight, 'Shaded: the scenario hides the leader, or withholds the odometry to '
                  'place it with.'),
        Chapter("Images of the follower's camera", '', [
            Illustration(cv2.imencode('.jpg', image)[1].tobytes(), '',
                         f'{(int(stamp) - epoch) * 1e-9:.1f} s')
            for stamp, image in zip(log['picture_stamp'], log['picture'])])]


def chapters(flight: Flight, note: str = '') -> list[Chapter]:
    """Return the chapters of a flight behind a neighbor: the flight and, with truth, errors."""
    result = [Chapter(f'Flight: {flight.name}', note, [_flight_picture(flight)])]
    if np.isfinite(flight.table['true_distance']).any():
        result.append(Chapter(
            f'Errors against the truth: {flight.name}',
            'Relative to the follower, along its own axes. The band is two standard deviations of '
            'the published covariances: 95 % of the errors should be inside. The NEES is the mean '
            'squared error in units of the covariance: 3 is expected, more is overconfident.',
            [_error_picture(flight)]))
    return result


def _with_gaps(table: Table) -> Mapping[str, Array]:
    """Return a table with a row of NaN in each gap of the images: no line crosses the gap."""
    breaks = np.flatnonzero(np.diff(table['time']) > MAX_LINE_GAP) + 1
    return {name: np.insert(column, breaks, np.nan, axis=0) for name, column in table.items()}


def _flight_picture(flight: Flight) -> Illustration:
    """Return distance, setpoints, speeds and states over time, and the paths from above."""
    figure = Figure(figsize=(13, 8), dpi=110, layout='constrained')
    names = ['distance', 'setpoint', 'speed', 'state']
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [['distance', 'above'], ['setpoint', 'speed'], ['state', 'state']],
        height_ratios=[1.2, 1.2, 0.7])
    draw_above(axes['above'], flight)
    draw_distance(axes['distance'], flight)
    _draw_setpoints(axes['setpoint'], flight)
    v_max = flight.params.v_max
    _draw_limit(axes['speed'], v_max, f'v_max\n{v_max:g} m/s')
    colors = {'leader': LEADER, REPLAYED: VEHICLE}
    for label, (times, speeds) in flight.speeds.items():
        axes['speed'].plot(times, speeds, linewidth=1.1, label=label,
                           color=colors.get(label, FOLLOWER))
    axes['speed'].set(ylabel='speed [m/s]', ylim=(0.0, None))
    _draw_states(axes['state'], flight)
    for name in names:
        axes[name].set(xlim=(0.0, max(flight.duration, 1e-3)), xlabel=TIME)
        _shade(axes[name], flight, 'leader not visible' if name == 'distance' else '')
    for name in names[:3]:
        _add_key(axes[name])
    return _illustration(figure, 'distance, path, setpoints, speed and state')


def _error_picture(flight: Flight) -> Illustration:
    """Return the errors and twice their deviations by axis."""
    table = _with_gaps(flight.table)
    figures = sight_figures([flight.table], flight.params.max_velocity_std)
    figure = Figure(figsize=(13, 7), dpi=110, layout='constrained')
    axes = figure.subplots(3, 2, sharex=True)
    for column, (kind, unit) in enumerate((('position', 'cm'), ('velocity', 'cm/s'))):
        # One scale for the three axes, which makes them comparable.
        errors, two_sigmas = 100.0 * table[kind], 200.0 * table[f'{kind}_sigma']
        limit = 1.15 * max(_usually(np.abs(errors), 99.0), _usually(two_sigmas, 90.0))
        for row, axis in enumerate(('x, forward', 'y, left', 'z, up')):
            plot: Axes = axes[row, column]
            plot.fill_between(table['time'], -two_sigmas[:, row], two_sigmas[:, row],
                              color=LEADER, alpha=0.15, linewidth=0)
            plot.axhline(0.0, color=LIMIT, linewidth=0.6)
            plot.plot(table['time'], errors[:, row], color=FOLLOWER, linewidth=0.9)
            plot.set(ylim=(-limit, limit), ylabel=f'error {axis} [{unit}]')
            _shade(plot, flight)
        known = np.isfinite(errors)
        inside = np.count_nonzero(np.abs(errors[known]) <= two_sigmas[known]) / max(known.sum(), 1)
        rms = 100.0 * (figures['position_rms_m' if column == 0 else 'velocity_rms_m_s'] or 0.0)
        nees = figures[f'nees_{kind}']
        verdict = '' if nees is None else f'; NEES {nees:.1f}: {consistency(nees)}'
        axes[0, column].set_title(f'relative {kind}: RMS {rms:.2f} {unit}\n{100 * inside:.0f} % '
                                  f'within two deviations{verdict}')
        axes[2, column].set_xlabel(TIME)
    axes[0, 0].set_xlim(0.0, max(flight.duration, 1e-3))
    return _illustration(figure, 'errors and their deviations')


def draw_distance(axis: Axes, flight: Flight) -> None:
    """Draw the estimated and the true distance in the band."""
    table, law = _with_gaps(flight.table), flight.params.law
    low, high = np.sqrt(law.d0), np.sqrt(law.d1)
    axis.axhspan(low, high, color=LEADER, alpha=0.08, lw=0)
    _draw_limit(axis, low, f'√d0\n{low:.2f} m')
    _draw_limit(axis, high, f'√d1\n{high:.2f} m')
    axis.plot(table['time'], table['distance'], color=FOLLOWER, linewidth=2.6, alpha=0.6,
              label='estimated')
    if np.isfinite(table['true_distance']).any():
        # Above the estimate: the difference is often less than a line's width.
        axis.plot(table['time'], table['true_distance'], color='black', linewidth=0.9,
                  linestyle=(0, (5, 3)), label='true')
    shown = np.concatenate([table['distance'], table['true_distance']])
    shown = shown[np.isfinite(shown)]
    axis.set(ylabel='distance [m]', title=f'distance to {flight.name}',
             ylim=(min(0.8 * low, 0.9 * np.min(shown, initial=np.inf)),
                   max(1.05 * high, 1.08 * np.max(shown, initial=0.0))))


def draw_above(axis: Axes, flight: Flight) -> None:
    """
    Draw the paths from above, and lines between leader and follower at the same times.

    Both axes have one scale, and a box as narrow as the data, within ``NARROWEST``.
    """
    times, paths = flight.table['time'], [path[:, :2] for path in flight.paths.values()]
    period = max(PAIR_PERIOD, flight.duration / MAX_PAIRS)
    for label, path, color in zip(flight.paths, paths, (LEADER, FOLLOWER)):
        axis.plot(*path.T, color=color, linewidth=1.7, label=label)
        known = path[np.isfinite(path).all(axis=1)]
        for end, marker in zip((known[:1], known[-1:]), 'os'):
            axis.plot(*end.T, marker, color=color, markersize=6)
    # Of another clock, the stamps may be years after the bag's end.
    for k in np.searchsorted(times, np.arange(0.0, min(times[-1], flight.duration), period)):
        pair = np.transpose([path[k] for path in paths])
        axis.plot(*pair, color=LIMIT, linewidth=0.6, alpha=0.5)
    low, high = np.transpose([axis.get_xlim(), axis.get_ylim()])
    half = 0.5 * np.maximum(high - low, NARROWEST * np.max(high - low))
    (left, bottom), (right, top) = (0.5 * (low + high) + side * half for side in (-1.0, 1.0))
    axis.set(title=f'from above (● start, ■ end; a line every {period:.0f} s)', xlabel='x [m]',
             ylabel='y [m]', xlim=(left, right), ylim=(bottom, top))
    axis.set_aspect('equal', adjustable='box', anchor='N')
    axis.legend(loc='best', fontsize=9)


def _draw_setpoints(axis: Axes, flight: Flight) -> None:
    """Draw the setpoints by axis of odom, and their norm, which a_max limits."""
    times, setpoints, a_max = flight.setpoint_times, flight.setpoints, flight.params.a_max
    _draw_limit(axis, a_max, f'a_max\n{a_max:g} m/s²')
    for values, color, label in zip(setpoints.T, (LEADER, FOLLOWER, VEHICLE), 'xyz'):
        axis.plot(times, values, color=color, linewidth=0.8, label=label)
    axis.plot(times, norms(setpoints), color=LIMIT, linewidth=1.2, label='norm')
    if flight.commanded is not None and not flight.commanded.all():
        idle = ~flight.commanded
        axis.plot(times[idle], norms(setpoints)[idle], '.', color=_SHADE, markersize=5,
                  label='no command: brake or level')
    axis.set(ylabel='setpoint, odom axes [m/s²]')


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


def _shade(axis: Axes, flight: Flight, label: str = '') -> None:
    """Shade the times in which the leader could not be seen, but not single images."""
    for begin, end in flight.blind:
        if end - begin >= LEAST_SHADED:
            axis.axvspan(begin, end, color=_SHADE, alpha=0.35, lw=0, zorder=0, label=label)
            label = ''


def _add_key(axis: Axes) -> None:
    """Add a legend above the axis, where no data are."""
    axis.legend(loc='lower right', bbox_to_anchor=(1.0, 0.99), ncols=6, frameon=False, fontsize=9,
                borderaxespad=0.0, columnspacing=1.2)


def _usually(values: Array, percentile: float) -> float:
    """Return the upper end of an axis that shows all values but the wildest."""
    finite = values[np.isfinite(values)]
    return max(float(np.percentile(finite, percentile)) if len(finite) else 0.0, 1e-3)


def _illustration(figure: Figure, description: str) -> Illustration:
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png')
    return Illustration(buffer.getvalue(), description)
