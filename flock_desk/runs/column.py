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


"""A column of followers as a whole: its tracks, figures and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations, cycle
import math
from typing import Any

import numpy as np

from flock_desk.runs.record import LiveRecord
from flock_desk.runs.report import Chapter, Illustration
from flock_desk.runs.summary import jsonable, most
from flock_desk.scenarios.scenario import Scenario
from flock_follower.geometry import Array

STEP = 0.02  # s between the times at which the vehicles of a column are compared


def spacing(scenario: Scenario) -> float:
    """Return the distance between two vehicles of a column at its start, m: the mean one."""
    return float(np.mean(scenario.start.distance))


def column_tracks(scenario: Scenario, flights: Mapping[str, LiveRecord]
                  ) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """
    Return the motion of a column while all of it flew the scenario, in the first one's frame.

    :returns: times (n,), s; positions (n, 3), m, by vehicle; distances (n,), m, by pair.
    """
    logs = {name: flight.log for name, flight in flights.items()}
    began = max(float(log['began']) for log in logs.values())
    times = np.arange(began, min(float(log['ended']) for log in logs.values()), STEP)
    first = next(iter(logs.values()))
    tracks = {'leader': _at(times, float(first['start']) + (
        first['image_stamp'] - int(first['epoch_ns'])) * 1e-9, first['leader_position'])}
    for i, (name, log) in enumerate(logs.items()):
        tracks[name] = np.array([-i * spacing(scenario), 0.0, 0.0]) + _at(
            times, flights[name].speeds['follower'][0] + float(log['began']), log['position'])
    return times - began, tracks, {
        f'{a} to {b}': np.linalg.norm(tracks[a] - tracks[b], axis=1)
        for a, b in combinations(tracks, 2)}


def _at(times: Array, known: Array, positions: Array) -> Array:
    """Return positions (n, 3) at times (n,); NaN if they are unknown."""
    return np.stack([np.interp(times, known, column, np.nan, np.nan)
                     for column in positions.T], axis=1)


def column_figures(scenario: Scenario, flights: Mapping[str, LiveRecord]) -> dict[str, Any]:
    """
    Return the figures of a column as a whole.

    ``nearest_m`` is the least true distance of any two vehicles, ``pairs`` that of each two.
    """
    _, _, distances = column_tracks(scenario, flights)
    pairs = {pair: float(np.nanmin(distance)) for pair, distance in distances.items()}
    return jsonable({
        'column_of': scenario.name, 'followers': len(flights),
        'nearest_m': min(pairs.values(), default=math.nan), 'pairs': pairs,
        'speed_max_m_s': most(np.concatenate(
            [flight.speeds['follower'][1] for flight in flights.values()]))})


def column_chapters(scenario: Scenario, flights: Mapping[str, LiveRecord]) -> list[Chapter]:
    """Return the page of a column: a picture of the tracks, and the distances of all pairs."""
    from matplotlib.figure import Figure

    from flock_desk.runs import plots
    times, tracks, distances = column_tracks(scenario, flights)
    figure = Figure(figsize=(13, 8), dpi=110, layout='constrained')
    above, apart = figure.subplots(2, 1, height_ratios=[1.2, 1.0])
    plots.draw_map(above, tracks, 'from above (● start, ■ end)')
    law = next(iter(flights.values())).params.law
    apart.axhspan(np.sqrt(law.d0), np.sqrt(law.d1), color=plots.LEADER, alpha=0.08, lw=0)
    for (name, distance), colour in zip(distances.items(), cycle(plots.COLOURS)):
        apart.plot(times, distance, color=colour, linewidth=1.1, label=name)
    apart.set(xlabel=plots.TIME, ylabel='true distance [m]', xlim=(0.0, float(times[-1])))
    apart.set_ylim(bottom=0.0)
    apart.set_title('distances; shaded: the band')
    plots.add_key(apart)
    return [Chapter(
        'The column', 'In the frame of the first follower. Each has a page of its own: '
        + ', '.join(f'{name}/report.html' for name in flights) + '.',
        [Illustration(plots.encoded(figure), 'tracks from above and distances of all pairs')])]
