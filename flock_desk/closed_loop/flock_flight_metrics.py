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
How well simulated flocks flew: the measures of rows put together run by run, and some more.

In a flock a row is a follower. What holds for the flock is what holds for its worst follower where
safety or a share of runs asks for that, else the mean. One that fails is left out: what it does to
the others is in theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
import math
from typing import Any

import numpy as np

from flock_desk.closed_loop.flight_metrics import RunMetrics
from flock_desk.closed_loop.flights_log import Flights, STATES
from flock_follower.geometry import Array
from flock_follower.planner.modes import State

LOST_AFTER = 5.0  # s without following at the end of a flight, and it counts as lost
STRAYED = 1.25  # times the far edge of the band: with nobody that near it is lost, too

_OF_FOLLOWERS: dict[str, Callable[..., Any]] = {
    'in_band': np.min, 'min_separation': np.min, 'max_separation': np.max,
    'out_of_band': np.max, 'out_of_sight': np.max, 'detection_gap': np.max, 'max_speed': np.max,
    'speed_share': np.max, 'handover_altitude': np.max, 'handover_climb': np.max,
    'altitude_change': np.max, 'unasked_setpoints': np.sum}  # the others: np.mean


@dataclass(frozen=True)
class FlockMetrics:
    """Measures of n runs of a flock, (n,) each."""

    lost: Array
    """How many followers are lost for good: at the end they do not follow, or nobody is near
    from whom others lead to the leader."""
    rms_acceleration: Array
    """Root mean square of the commanded accelerations, m/s^2."""
    tracking: Array
    """Share of the time in TRACK."""
    edges: Array
    """How many each follows, mean."""
    shown: Array
    """How many of the others each sees, mean."""


def of_runs(rows: RunMetrics, flights: Flights) -> RunMetrics:
    """Return the measures of runs, of those of their followers."""
    kept = _kept(flights)
    return RunMetrics(**{f.name: _OF_FOLLOWERS.get(f.name, np.mean)(
        _by_run(getattr(rows, f.name), flights)[:, kept], axis=1) for f in fields(RunMetrics)})


def measure_flock(flights: Flights) -> FlockMetrics:
    """Return the measures that only flocks have."""
    kept = _kept(flights)
    tracking = flights.state == STATES.index(State.TRACK)
    late = flights.times > flights.times[-1] - LOST_AFTER
    strayed = np.stack([_strayed(positions[-1], flights) for positions in flights.positions])
    lost = _by_run(~tracking[:, late].any(axis=1), flights) | strayed
    squares = np.nanmean(np.sum(flights.command ** 2, axis=2), axis=1)
    tracked, edges, shown, squared = (
        _by_run(each, flights)[:, kept].mean(axis=1) for each in (
            tracking.mean(axis=1), flights.edges.mean(axis=1), flights.shown.mean(axis=1),
            squares))
    return FlockMetrics(lost[:, kept].sum(axis=1).astype(float), np.sqrt(squared), tracked,
                        edges, shown)


def joined_flocks(parts: Sequence[FlockMetrics]) -> FlockMetrics:
    """Return the measures of all runs of several parts, in their order."""
    return FlockMetrics(*(np.concatenate([getattr(part, f.name) for part in parts])
                          for f in fields(FlockMetrics)))


def flock_summary(runs: FlockMetrics) -> dict[str, float]:
    """Return the measures of a scenario."""
    return {
        'lost_for_good': float(runs.lost.sum()),
        'rms_acceleration_m_s2': float(np.sqrt(np.mean(runs.rms_acceleration ** 2))),
        'time_tracking': float(runs.tracking.mean()),
        'edges': float(runs.edges.mean()),
        'neighbors_in_sight': float(runs.shown.mean()),
    }


def _by_run(values: Array, flights: Flights) -> Array:
    """Return values of rows (n,) as (runs, m)."""
    return values.reshape(len(flights.positions), -1)


def _kept(flights: Flights) -> Any:
    """Return which followers count (m,): all but the one that fails."""
    flock = flights.scenario.company
    return np.array([flock.fails is None or flock.fails.follower != number
                     for number in range(1, flock.followers + 1)])


def _strayed(positions: Array, flights: Flights) -> Any:
    """Return which followers (m,) nobody leads to from the leader; positions (m + 1, 3), m."""
    apart = np.linalg.norm(positions[:, None] - positions, axis=2)
    near = apart < STRAYED * math.sqrt(flights.scenario.flight.d1)
    near &= np.append(True, _kept(flights))  # who fails leads nobody
    reached = np.arange(len(positions)) == 0
    for _ in positions:
        reached = reached | near[:, reached].any(axis=1)
    return ~reached[1:]
