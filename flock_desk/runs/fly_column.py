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

"""What a column of followers did on the desk: the tracks of all, and who came how near to whom."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations
import math
from typing import Any

import numpy as np

from flock_desk.runs.fly_bounds import SAFE
from flock_desk.runs.fly_record import LiveRecord
from flock_desk.runs.judge import FigureBound
from flock_desk.runs.report import Chapter, Illustration
from flock_desk.runs.summary import jsonable, most
from flock_desk.scenarios.scenario import Scenario
from flock_follower.geometry import Array

STEP = 0.02  # s between the moments that are compared


def spacing(scenario: Scenario) -> float:
    """Return how far apart they begin, m: as far as the first one from its leader on average."""
    return float(np.mean(scenario.start.distance))


def summarize_column(scenario: Scenario, flights: Mapping[str, LiveRecord]) -> dict[str, Any]:
    """
    Return the figures of the column as a whole.

    ``nearest_m`` is the least true distance of any two vehicles, ``pairs`` that of each two.
    """
    _, tracks = _tracks(scenario, flights)
    pairs = {f'{a} to {b}': float(np.nanmin(_apart(tracks[a], tracks[b])))
             for a, b in combinations(tracks, 2)}
    return jsonable({
        'column_of': scenario.name, 'followers': len(flights),
        'nearest_m': min(pairs.values(), default=math.nan), 'pairs': pairs,
        'speed_max_m_s': most(np.concatenate(
            [np.linalg.norm(flight.velocities, axis=1) for flight in flights.values()]))})


def column_bounds(scenario: Scenario) -> list[FigureBound]:
    """Return what the column must keep."""
    return [FigureBound('nearest_m', least=round(SAFE * math.sqrt(scenario.flight.d0), 3))]


def column_chapters(scenario: Scenario, flights: Mapping[str, LiveRecord]) -> Iterator[Chapter]:
    """Yield what the page of the column shows."""
    from flock_desk.runs import plots
    times, tracks = _tracks(scenario, flights)
    params = next(iter(flights.values())).params
    yield Chapter(
        'The column', 'In the frame of the first follower. Each has a page of its own: '
        + ', '.join(f'{name}/report.html' for name in flights) + '.',
        [Illustration(plots.column_picture(times, tracks, {
            f'{a} to {b}': _apart(tracks[a], tracks[b]) for a, b in combinations(tracks, 2)},
            params), 'tracks from above, and the distances of all pairs')])


def _tracks(scenario: Scenario,
            flights: Mapping[str, LiveRecord]) -> tuple[Array, dict[str, Array]]:
    """Return times (n,), s, and who was where (n, 3), m, while all of them flew the scenario."""
    began = max(float(flight.log['began']) for flight in flights.values())
    ended = min(float(flight.log['ended']) for flight in flights.values())
    times = np.arange(began, ended, STEP)
    tracks: dict[str, Array] = {}
    for i, (name, flight) in enumerate(flights.items()):
        log, behind = flight.log, np.array([-i * spacing(scenario), 0.0, 0.0])
        if i == 0:
            seen = float(log['start']) + (log['image_stamp'] - int(log['epoch_ns'])) * 1e-9
            tracks['leader'] = _at(times, seen, log['leader_position'])
        tracks[name] = behind + _at(
            times, flight.velocity_times + float(log['began']), log['position'])
    return times - began, tracks


def _at(times: Array, known: Array, positions: Array) -> Array:
    """Return positions (n, 3) at times (n,); NaN where they are not known."""
    return np.stack([np.interp(times, known, column, np.nan, np.nan)
                     for column in positions.T], axis=1)


def _apart(a: Array, b: Array) -> Array:
    distances: Array = np.linalg.norm(a - b, axis=1)
    return distances
