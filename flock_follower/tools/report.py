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

"""The report of one replayed flight: a table of figures beside their bounds, and a picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
import sys
from typing import NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from flock_follower.geometry import Array
from flock_follower.tools.metrics import RelativeErrors, States

matplotlib.use('Agg')

# Okabe and Ito's palette: told apart by the colour-blind, and by lightness in grey.
LEADER, FOLLOWER, VEHICLE, LIMIT = '#0072B2', '#D55E00', '#009E73', '#444444'


class Check(NamedTuple):
    """One line of the table; ``passed`` is None for a figure without a bound."""

    name: str
    value: str
    bound: str
    passed: bool | None


def within(name: str, value: float, unit: str, low: float | None, high: float | None,
           digits: int = 2) -> Check:
    """Return a line for a value that must lie in [low, high]; None leaves a side open."""
    text = f'{value:.{digits}f} {unit}'.rstrip()
    ends = [f'≥ {low:g}' if low is not None else '', f'≤ {high:g}' if high is not None else '']
    bound = ', '.join(end for end in ends if end)
    passed = np.isfinite(value) and (low is None or value >= low) and (high is None
                                                                       or value <= high)
    return Check(name, text, f'{bound} {unit}'.strip(), bool(passed))


def table(checks: Sequence[Check]) -> str:
    """Return the lines aligned in columns, failures marked."""
    widths = [max(map(len, column)) for column in zip(*(c[:3] for c in checks))]
    marks = {True: 'ok', False: 'FAILED', None: ''}
    lines = [f'  {c.name:<{widths[0]}}  {c.value:>{widths[1]}}  {c.bound:<{widths[2]}}  '
             f'{marks[c.passed]}'.rstrip() for c in checks]
    return '\n'.join(lines)


def verdict(checks: Sequence[Check], shown: str, logs: Path) -> int:
    """
    Print the table, and what failed; return the exit code.

    :param shown: where more is to be seen.
    :param logs: the folder of the logs.
    """
    print(f'\n{table(checks)}\n\n{shown}')
    failed = [check.name for check in checks if check.passed is False]
    if failed:
        print(f'FAILED: {", ".join(failed)}; logs in {logs}', file=sys.stderr)
    return 1 if failed else 0


@dataclass(frozen=True)
class Flight:
    """
    What the picture shows; times in s from the first image, n estimates, m log rows.

    ``errors`` are the estimates against truth; ``leader`` and ``follower`` the true states;
    ``setpoint_times`` (k,) and ``setpoints`` (k, 3) the accelerations on the wire, m/s^2;
    ``vehicle_times`` (m,), ``vehicle_positions`` and ``vehicle_velocities`` (m, 3) the embedded
    autopilot's vehicle, ENU.
    """

    errors: RelativeErrors
    leader: States
    follower: States
    start: int
    setpoint_times: Array
    setpoints: Array
    vehicle_times: Array
    vehicle_positions: Array
    vehicle_velocities: Array
    d0: float
    d1: float
    a_max: float
    v_max: float


def draw(flight: Flight, path: Path, title: str) -> None:
    """Write the picture to a PNG file."""
    figure = Figure(figsize=(13, 8.4), dpi=110, layout='constrained')
    figure.suptitle(title, fontsize=14, x=0.01, ha='left', weight='bold')
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [['distance', 'above'], ['acceleration', 'above'], ['speed', 'error']],
        width_ratios=[1.45, 1.0])
    _draw_distance(axes['distance'], flight)
    _draw_above(axes['above'], flight)
    draw_limited(axes['acceleration'], flight.setpoint_times,
                 np.linalg.norm(flight.setpoints, axis=1), flight.a_max,
                 'acceleration setpoint on the wire', '‖a‖ [m/s²]', 'a_max')
    draw_limited(axes['speed'], flight.vehicle_times,
                 np.linalg.norm(flight.vehicle_velocities, axis=1), flight.v_max,
                 'speed of the vehicle that flew it', '‖v‖ [m/s]', 'v_max')
    axes['speed'].set_xlabel('time since the first image [s]')
    _draw_error(axes['error'], flight)
    end = (flight.leader.stamps[-1] - flight.start) * 1e-9
    for name in ('distance', 'acceleration', 'speed'):
        axes[name].set_xlim(0.0, end)
    tidy(axes.values())
    figure.savefig(path)


def tidy(axes: Iterable[Axes]) -> None:
    """Give axes a faint grid and take away the frame."""
    for axis in axes:
        axis.grid(alpha=0.25, linewidth=0.6)
        axis.spines[['top', 'right']].set_visible(False)


def _seconds(flight: Flight) -> Array:
    return np.asarray((flight.errors.stamps - flight.start) * 1e-9)


def _draw_distance(axis: Axes, flight: Flight) -> None:
    draw_distance(axis, _seconds(flight), flight.errors.distance, flight.errors.true_distance,
                  flight.d0, flight.d1)


def draw_distance(axis: Axes, times: Array, distance: Array, true_distance: Array, d0: float,
                  d1: float) -> None:
    """Draw estimated and true distance (n,), m, in the law's band; NaN leaves a gap."""
    low, high = np.sqrt(d0), np.sqrt(d1)
    axis.axhspan(low, high, color=LEADER, alpha=0.08, lw=0)
    for bound, name in ((low, '√d0'), (high, '√d1')):
        axis.axhline(bound, color=LIMIT, linestyle='--', linewidth=1)
        axis.annotate(f'{name} = {bound:.2f} m', (1.0, bound), (-4, 3), fontsize=8, ha='right',
                      xycoords=('axes fraction', 'data'), textcoords='offset points')
    if np.any(np.isfinite(true_distance)):
        axis.plot(times, true_distance, color=LIMIT, linewidth=3, alpha=0.35, label='truth')
    axis.plot(times, distance, color=FOLLOWER, linewidth=1.1, label='estimated')
    shown = np.concatenate([distance, true_distance])
    shown = shown[np.isfinite(shown)]
    axis.set(title='distance to the leader', ylabel='[m]',
             ylim=(min(0.6 * low, 0.9 * np.min(shown, initial=np.inf)),
                   max(1.08 * high, 1.08 * np.max(shown, initial=0.0))))
    axis.legend(loc='lower left', ncols=2, frameon=False, fontsize=9)


def _draw_above(axis: Axes, flight: Flight) -> None:
    for states, colour, name in ((flight.leader, LEADER, 'leader'),
                                 (flight.follower, FOLLOWER, 'follower in the bag')):
        draw_path(axis, states.positions[:, :2], colour, name)
    # Its own motion changes nothing the bag shows: drawn from the follower's start, it drifts off.
    offset = flight.follower.positions[0] - flight.vehicle_positions[0]
    axis.plot(*(flight.vehicle_positions + offset)[:, :2].T, color=VEHICLE, linewidth=1.5,
              linestyle=(0, (4, 2)), label='vehicle that flew the\ncommands, open loop')
    finish_above(axis)


def draw_path(axis: Axes, path: Array, colour: str, name: str) -> None:
    """Draw a path (n, 2), m, from its first to its last known place."""
    known = path[np.isfinite(path).all(axis=1)]
    axis.plot(*path.T, color=colour, linewidth=1.8, label=name)
    axis.plot(*known[:1].T, 'o', color=colour, markersize=6)
    axis.plot(*known[-1:].T, '>', color=colour, markersize=7)


def finish_above(axis: Axes) -> None:
    """Label a picture from above."""
    axis.set(title='from above (● start, ▸ end)', xlabel='x [m]', ylabel='y [m]')
    axis.set_aspect('equal', adjustable='datalim')
    axis.legend(loc='best', frameon=False, fontsize=9)


def draw_limited(axis: Axes, times: Array, values: Array, limit: float, title: str, label: str,
                 name: str) -> None:
    """Draw values (n,) below a limit, which is a line with a name."""
    axis.axhline(limit, color=LIMIT, linestyle='--', linewidth=1)
    axis.annotate(f'{name} = {limit:g}', (1.0, limit), (-4, 3), fontsize=8, ha='right',
                  xycoords=('axes fraction', 'data'), textcoords='offset points')
    axis.plot(times, values, color=VEHICLE, linewidth=1.2)
    most = float(np.nanmax(values, initial=0.0))
    axis.set(title=title, ylabel=label, ylim=(0.0, max(1.25 * limit, 1.08 * most)))


def _draw_error(axis: Axes, flight: Flight) -> None:
    times = _seconds(flight)
    axis.plot(times, 100 * np.linalg.norm(flight.errors.position, axis=1), color=FOLLOWER,
              linewidth=1.1, label=f'position [cm], RMS {100 * flight.errors.position_rms:.1f}')
    axis.plot(times, 100 * np.linalg.norm(flight.errors.velocity, axis=1), color=LEADER,
              linewidth=1.1, label=f'velocity [cm/s], RMS {100 * flight.errors.velocity_rms:.1f}')
    axis.set(title='error of the relative estimate', xlabel='time since the first image [s]')
    # Not the first estimate's velocity, which no motion has told yet and the planner refuses.
    shown = 100 * np.linalg.norm(
        np.concatenate([flight.errors.position, flight.errors.velocity[3:]]), axis=1)
    axis.set_ylim(0.0, 1.6 * float(np.max(shown, initial=1.0)))
    axis.legend(loc='upper right', frameon=False, fontsize=9)
