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

"""The report of a live flight: one HTML file with its table, plots and some of its images."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from io import BytesIO

import cv2
import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from flock_follower.geometry import Array
from flock_follower.tools.fly_record import LiveRecord
from flock_follower.tools.report import Check, FOLLOWER, LEADER, LIMIT, VEHICLE

matplotlib.use('Agg')

STATES = ('IDLE', 'SEARCH', 'HOLD', 'COAST', 'TRACK')  # from bottom to top
_OUTAGE = '#CC79A7'
_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1180px; color: #222; }}
h1 {{ font-size: 1.5em; margin-bottom: 0; }} p {{ margin-top: 0.2em; color: #555; }}
table {{ border-collapse: collapse; margin: 1em 0; }}
td, th {{ padding: 0.15em 1em 0.15em 0; text-align: left; border-bottom: 1px solid #e4e4e4; }}
td:nth-child(2) {{ text-align: right; }} td.ok {{ color: #007a3d; }}
td.failed {{ color: #c00; font-weight: bold; }}
img {{ max-width: 100%; }} figure {{ display: inline-block; width: 31%; margin: 0 1% 1em 0; }}
figcaption {{ color: #555; font-size: 0.9em; }}
</style></head><body>
<h1>{title}</h1><p>{summary}</p>
<table><tr><th></th><th></th><th>bound</th><th></th></tr>
{rows}
</table>
<p>Shaded: the scenario hides the leader, or withholds the odometry to place it with.</p>
<img alt="plots of the flight" src="data:image/png;base64,{plots}">
<h2>What the follower's camera saw</h2>
{pictures}
</body></html>
"""


def html(flight: LiveRecord, checks: Sequence[Check]) -> str:
    """Return the page."""
    return _PAGE.format(
        title=escape(f'flock_follower on the desk: {flight.scenario.name}'),
        summary=escape(flight.scenario.summary), rows='\n'.join(_row(c) for c in checks),
        plots=base64.b64encode(_plots(flight)).decode(), pictures='\n'.join(_pictures(flight)))


def _row(check: Check) -> str:
    verdict = {True: 'ok', False: 'failed', None: ''}[check.passed]
    return (f'<tr><td>{escape(check.name)}</td><td>{escape(check.value)}</td>'
            f'<td>{escape(check.bound)}</td><td class="{verdict}">{verdict}</td></tr>')


def _pictures(flight: LiveRecord) -> list[str]:
    figures = []
    epoch = int(flight.log['image_stamp'][0]) - round(float(flight.times[0]) * 1e9)
    for stamp, image in zip(flight.log['picture_stamp'], flight.log['picture']):
        time = (int(stamp) - epoch) * 1e-9
        data = base64.b64encode(cv2.imencode('.jpg', image)[1].tobytes()).decode()
        figures.append(f'<figure><img alt="" src="data:image/jpeg;base64,{data}">'
                       f'<figcaption>{time:.1f} s</figcaption></figure>')
    return figures


def _plots(flight: LiveRecord) -> bytes:
    """Return the plots as PNG."""
    figure = Figure(figsize=(13, 11), dpi=110, layout='constrained')
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [['distance', 'above'], ['acceleration', 'above'], ['speed', 'above'],
         ['state', 'position error'], ['parts', 'velocity error']],
        width_ratios=[1.45, 1.0], height_ratios=[1.2, 1, 1, 0.8, 1])
    log = flight.log
    times = log['state_time'] - log['began']
    _distance(axes['distance'], flight)
    _above(axes['above'], flight)
    _limited(axes['acceleration'], flight.setpoint_times, _norms(flight.setpoints),
             flight.scenario.flight.a_max, 'acceleration setpoint on the wire', '‖a‖ [m/s²]',
             'a_max')
    speed = axes['speed']
    _limited(speed, times, _norms(log['velocity']), flight.scenario.flight.v_max, 'speed',
             '‖v‖ [m/s]', 'v_max', 'follower')
    speed.plot(flight.times, _norms(log['leader_velocity']), color=LEADER, linewidth=1.0,
               label='leader')
    speed.set_ylim(0.0, 1.25 * max(flight.scenario.flight.v_max, float(np.max(
        _norms(log['leader_velocity'])))))
    speed.legend(loc='upper left', ncols=2, frameon=False, fontsize=9)
    _states(axes['state'], flight)
    parts = axes['parts']
    for k, (name, colour) in enumerate((('east', LEADER), ('north', FOLLOWER), ('up', VEHICLE))):
        parts.plot(flight.setpoint_times, flight.setpoints[:, k], color=colour, linewidth=0.9,
                   label=name)
    parts.set(title='acceleration setpoint by axis', ylabel='[m/s²]', xlabel='time [s]')
    parts.legend(loc='upper left', ncols=3, frameon=False, fontsize=9)
    for what, unit, vectors, colour in (
            ('position', 'cm', flight.errors.position, FOLLOWER),
            ('velocity', 'cm/s', flight.errors.velocity, LEADER)):
        axis = axes[f'{what} error']
        values = 100 * _norms(vectors)
        axis.plot(*_broken(flight.error_times, values), color=colour, linewidth=0.9)
        highest = float(np.percentile(values, 99.5)) if len(values) else 1.0
        axis.set(title=f'error of the relative {what}', ylabel=f'[{unit}]',
                 ylim=(0.0, 1.4 * highest))
    axes['velocity error'].set_xlabel('time [s]')
    for name, axis in axes.items():
        axis.grid(alpha=0.25, linewidth=0.6)
        axis.spines[['top', 'right']].set_visible(False)
        if name != 'above':
            axis.set_xlim(0.0, flight.duration)
            _mark_outages(axis, flight)
    stream = BytesIO()
    figure.savefig(stream, format='png')
    return stream.getvalue()


def _norms(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=1)


def _broken(times: Array, values: Array) -> tuple[Array, Array]:
    """Return a line with a break where nothing was estimated for more than 0.2 s."""
    gaps = np.flatnonzero(np.diff(times) > 0.2) + 1
    return np.insert(times, gaps, np.nan), np.insert(values, gaps, np.nan)


def _mark_outages(axis: Axes, flight: LiveRecord) -> None:
    """Shade when the leader could not be seen, or not be placed."""
    blind = np.concatenate([[False], ~flight.log['image_usable'].astype(bool), [False]])
    edges = np.flatnonzero(np.diff(blind.astype(int)))
    for begin, end in zip(edges[::2], edges[1::2]):
        axis.axvspan(flight.times[begin], flight.times[min(end, len(flight.times) - 1)],
                     color=_OUTAGE, alpha=0.15, lw=0)


def _distance(axis: Axes, flight: LiveRecord) -> None:
    low, high = (float(np.sqrt(d)) for d in (flight.scenario.flight.d0, flight.scenario.flight.d1))
    axis.axhspan(low, high, color=LEADER, alpha=0.08, lw=0)
    for bound, name in ((low, '√d0'), (high, '√d1')):
        axis.axhline(bound, color=LIMIT, linestyle='--', linewidth=1)
        axis.annotate(f'{name} = {bound:.2f} m', (1.0, bound), (-4, 3), fontsize=8, ha='right',
                      xycoords=('axes fraction', 'data'), textcoords='offset points')
    axis.plot(flight.distance_times, flight.distance, color=LIMIT, linewidth=3, alpha=0.35,
              label='truth')
    axis.plot(*_broken(flight.error_times, flight.errors.distance), color=FOLLOWER, linewidth=1.0,
              label='estimated')
    top = max(1.1 * high, 1.05 * float(flight.distance.max()))
    axis.set(title='distance to the leader', ylabel='[m]',
             ylim=(min(0.6 * low, 0.9 * float(flight.distance.min())), top))
    axis.legend(loc='lower left', ncols=2, frameon=False, fontsize=9)


def _above(axis: Axes, flight: LiveRecord) -> None:
    for name, label, colour in (('leader', 'leader', LEADER), ('follower', 'follower', FOLLOWER)):
        path = flight.log[f'{name}_position'][:, :2]
        axis.plot(*path.T, color=colour, linewidth=1.6, label=label)
        axis.plot(*path[0], 'o', color=colour, markersize=6)
        axis.plot(*path[-1], 's', color=colour, markersize=6)
    pairs = [int(np.searchsorted(flight.times, t)) for t in np.arange(0, flight.duration, 5.0)]
    for k in pairs:  # who was where at the same time
        if k < len(flight.times):
            ends = np.stack([flight.log[f'{name}_position'][k, :2]
                             for name in ('leader', 'follower')])
            axis.plot(*ends.T, color=LIMIT, linewidth=0.6, alpha=0.5)
    axis.set(title='from above (● start, ■ end; lines every 5 s)', xlabel='x, east [m]',
             ylabel='y, north [m]')
    axis.set_aspect('equal', adjustable='datalim')
    axis.legend(loc='best', frameon=False, fontsize=9)


def _limited(axis: Axes, times: Array, values: Array, limit: float, title: str, label: str,
             name: str, series: str | None = None) -> None:
    axis.axhline(limit, color=LIMIT, linestyle='--', linewidth=1)
    axis.annotate(f'{name} = {limit:g}', (1.0, limit), (-4, 3), fontsize=8, ha='right',
                  xycoords=('axes fraction', 'data'), textcoords='offset points')
    axis.plot(times, values, color=FOLLOWER, linewidth=1.0, label=series)
    axis.set(title=title, ylabel=label, ylim=(0.0, 1.25 * limit))


def _states(axis: Axes, flight: LiveRecord) -> None:
    times = [t for t, _ in flight.states] + [flight.duration]
    levels = [STATES.index(s) for _, s in flight.states]
    axis.step(times, [*levels, levels[-1]], where='post', color=VEHICLE, linewidth=1.5)
    axis.set(title="the planner's state", yticks=range(len(STATES)), yticklabels=STATES,
             ylim=(-0.3, len(STATES) - 0.7))
