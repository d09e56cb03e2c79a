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
How well flights went, from what really happened in them: every measure is defined here.

Each is taken run by run, from engaging on; ``summary`` puts the runs of a scenario together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
import math
from typing import Any, NamedTuple

import numpy as np

from flock_desk.closed_loop.flights_log import Flights, STATES
from flock_follower.geometry import Array

FIRST_TICKS = 10  # 1 s, in which a handover must not change the altitude
TOO_FAST = 1.05  # times v_max: runs that are ever faster count as too fast
SETTLED = 20.0  # s at the end of a flight over which its final distance is averaged


@dataclass(frozen=True)
class RunMetrics:
    """Measures of n runs, (n,) each."""

    in_band: Array
    """1 where sqrt(d0) < r < sqrt(d1) throughout, else 0."""
    min_separation: Array
    """Least distance, m."""
    max_separation: Array
    """Greatest distance, m."""
    out_of_band: Array
    """Time out of the band, s."""
    time_in_band: Array
    """Share of the time in the band."""
    guard_active: Array
    """Share of the planner's ticks in which the guard altered the command."""
    jerk: Array
    """Root mean square of the commanded acceleration's change from tick to tick, m/s^3."""
    tracking_error: Array
    """Root mean square of r - sqrt((d0 + d1) / 2), m."""
    velocity_error: Array
    """Root mean square of |v_F - v_L|, m/s."""
    in_sight: Array
    """Share of the time in which the camera has the marker in view, from its front."""
    out_of_sight: Array
    """Longest time in which it has not, in whole ticks, s; what hides the marker counts not."""
    detection_gap: Array
    """Longest time without an image that showed the leader, in whole ticks, s."""
    final_distance: Array
    """Mean distance over the last 20 s, m."""
    max_speed: Array
    """Greatest speed of the follower while it flies setpoints, m/s."""
    speed_share: Array
    """The same as a share of v_max."""
    handover_altitude: Array
    """Greatest change of altitude in the second after the vehicle begins to fly setpoints, m."""
    handover_climb: Array
    """Greatest vertical speed while it flies setpoints, from a second after that on, m/s."""
    altitude_change: Array
    """Greatest change of altitude while the vehicle flies setpoints, m."""
    unasked_setpoints: Array
    """Setpoints that left though nobody had called offboard."""


def measure(flights: Flights) -> RunMetrics:
    """Return the measures of every run."""
    band = flights.scenario.flight
    distance = np.linalg.norm(flights.leader - flights.follower, axis=2)
    period = float(flights.times[1] - flights.times[0])
    middle = math.sqrt((band.d0 + band.d1) / 2.0)
    handovers = np.array([_handovers(*run) for run in zip(
        flights.obeying, flights.follower[:, :, 2], flights.velocity[:, :, 2])])
    fastest = (np.linalg.norm(flights.velocity, axis=2) * flights.obeying).max(axis=1)
    steps = np.linalg.norm(np.diff(flights.command, axis=1), axis=2) / period
    return RunMetrics(
        in_band=(flights.outside.sum(axis=1) == 0.0).astype(float),
        min_separation=flights.nearest.min(axis=1),
        max_separation=flights.farthest.max(axis=1),
        out_of_band=flights.outside.sum(axis=1),
        time_in_band=1.0 - flights.outside.sum(axis=1) / (period * len(flights.times)),
        guard_active=flights.guarded.mean(axis=1),
        jerk=np.sqrt(np.nanmean(steps ** 2, axis=1)),
        tracking_error=_rms(distance - middle),
        velocity_error=_rms(np.linalg.norm(
            flights.velocity - flights.leader_velocity, axis=2)),
        in_sight=flights.in_sight.mean(axis=1),
        out_of_sight=np.array([period * _longest(~seen) for seen in flights.in_sight]),
        detection_gap=np.array([period * _longest(~seen) for seen in flights.seen]),
        final_distance=distance[:, flights.times > flights.times[-1] - SETTLED].mean(axis=1),
        max_speed=fastest, speed_share=fastest / band.v_max,
        handover_altitude=handovers[:, 0], handover_climb=handovers[:, 1],
        altitude_change=handovers[:, 2],
        unasked_setpoints=flights.unasked[:, -1].astype(float))


class BandExit(NamedTuple):
    """The first time that a follower left the band."""

    row: int
    time: float
    """s."""
    distance: float
    """m: the least or the greatest of the 0.1 s."""
    near: bool
    """Whether it came too near; else it fell back too far."""
    state: str
    """Of its planner."""
    unseen: float
    """Time since the last image that showed the leader, in whole ticks, s."""

    def __str__(self) -> str:
        """Return when, and why as far as the flight shows it."""
        sight = f'leader not seen for {self.unseen:.1f} s' if self.unseen else 'leader seen'
        return (f'at {self.time:.1f} s too {"near" if self.near else "far"}, '
                f'{self.distance:.2f} m; {self.state}, {sight}')


def band_exits(flights: Flights) -> list[BandExit]:
    """Return the first exit of each row that left the band, in the order of the rows."""
    band, exits = flights.scenario.flight, []
    period = float(flights.times[1] - flights.times[0])
    for row in np.flatnonzero(flights.outside.sum(axis=1) > 0.0).tolist():
        k = int(np.flatnonzero(flights.outside[row] > 0.0)[0])
        near = bool(flights.nearest[row, k] ** 2 <= band.d0)
        seen = np.flatnonzero(flights.seen[row, :k + 1])
        exits.append(BandExit(
            row, float(flights.times[k]), float((
                flights.nearest if near else flights.farthest)[row, k]), near,
            STATES[int(flights.state[row, k])].value,
            period * (k - int(seen[-1]) if len(seen) else k + 1)))
    return exits


def joined(parts: Sequence[RunMetrics]) -> RunMetrics:
    """Return the measures of all runs of several parts, in their order."""
    return RunMetrics(*(np.concatenate([getattr(part, f.name) for part in parts])
                        for f in fields(RunMetrics)))


def summary(runs: RunMetrics) -> dict[str, float]:
    """Return the measures of a scenario: extremes where safety asks for them, else means."""
    return {
        'runs': len(runs.in_band),
        'in_band': float(runs.in_band.mean()),
        'min_separation_m': float(runs.min_separation.min()),
        'max_separation_m': float(runs.max_separation.max()),
        'out_of_band_s': float(runs.out_of_band.mean()),
        'time_in_band': float(runs.time_in_band.mean()),
        'time_in_sight': float(runs.in_sight.mean()),
        'longest_out_of_sight_s': float(runs.out_of_sight.max()),
        'guard_active': float(runs.guard_active.mean()),
        'jerk_m_s3': float(runs.jerk.mean()),
        'tracking_error_m': float(runs.tracking_error.mean()),
        'velocity_error_m_s': float(runs.velocity_error.mean()),
        'longest_detection_gap_s': float(runs.detection_gap.max()),
        'final_distance_m': float(runs.final_distance.mean()),
        'final_distance_lowest_m': float(runs.final_distance.min()),
        'final_distance_highest_m': float(runs.final_distance.max()),
        'max_speed_m_s': float(runs.max_speed.max()),
        'max_speed_share': float(runs.speed_share.max()),
        'too_fast': float((runs.speed_share > TOO_FAST).mean()),
        'handover_altitude_m': float(runs.handover_altitude.max()),
        'handover_climb_m_s': float(runs.handover_climb.max()),
        'altitude_change_m': float(runs.altitude_change.max()),
        'unasked_setpoints': float(runs.unasked_setpoints.sum()),
    }


def _handovers(obeying: Any, height: Array, climb: Array) -> tuple[float, float, float]:
    """
    Return the greatest of all handovers of a run, (k,) each.

    They are the change of height in the first second, the vertical speed after it, and the change
    of height until the vehicle flies setpoints no longer.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], obeying, [False]]).astype(int)))
    early = late = change = 0.0
    for begin, end in edges.reshape(-1, 2).tolist():
        first, changes = min(begin + FIRST_TICKS, end), np.abs(height[begin:end] - height[begin])
        early = max(early, float(changes[:FIRST_TICKS].max()))
        late = max(late, float(np.abs(climb[first:end]).max(initial=0.0)))
        change = max(change, float(changes.max()))
    return early, late, change


def _rms(values: Array) -> Array:
    return np.sqrt(np.mean(values ** 2, axis=1))


def _longest(missing: Array) -> int:
    """Return the greatest number of True in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(int)))
    return int(np.max(edges[1::2] - edges[::2], initial=0))
