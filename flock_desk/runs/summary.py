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
The figures that ``evaluate``, ``demo`` and ``fly`` have in common, each defined once, here.

A summary is a mapping of figures by name, groups of them nested; None is not known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from flock_desk.runs.frame_errors import Table
from flock_follower.geometry import Array
from flock_follower.whole_file import whole_file

#: Attitudes further than this from the truth count as wrong, rad.
WRONG_ATTITUDE = math.radians(20.0)


def sight_figures(tables: Sequence[Table], max_velocity_std: float) -> dict[str, Any]:
    """
    Return how often and how well neighbours were seen, from the tables of ``frame_errors``.

    Images count once for each neighbour. ``recall`` is the share with an estimate, of those in
    which the truth has a marker in view, or of all where there is no truth. Errors are over all
    images with an estimate and truth; ``velocity_rms_m_s`` and ``velocity_bias_m_s`` leave out
    estimates whose velocity is more uncertain than ``max_velocity_std``, m/s, as the first one of
    a track: the planner refuses them. ``velocity_rms_of_all_m_s`` does not. ``nees_`` are means,
    3 where covariances are right.
    """
    rows = {column: np.concatenate([table[column] for table in tables]) for column in tables[0]}
    found, known = np.isfinite(rows['distance']), np.isfinite(rows['true_distance'])
    in_view = rows['visible'] == 1.0
    position, velocity = _errors(rows, 'position'), _errors(rows, 'velocity')
    usable = _usable(rows, max_velocity_std)
    distance_error = (rows['distance'] - rows['true_distance'])[found & known]
    return {
        'frames_in_view': int(np.count_nonzero(in_view)) if np.any(known) else None,
        'recall': mean(found[in_view]) if np.any(known) else (mean(found) or 0.0),
        'distance_m': spread(rows['distance'][found]),
        'true_distance_m': spread(rows['true_distance'][known]),
        'distance_rms_m': rms(distance_error),
        'distance_bias_m': mean(distance_error),
        'position_rms_m': rms(np.linalg.norm(position, axis=1)),
        'position_bias_m': _by_axis(position),
        'velocity_rms_m_s': rms(np.linalg.norm(velocity[usable], axis=1)),
        'velocity_rms_of_all_m_s': rms(np.linalg.norm(velocity, axis=1)),
        'velocity_bias_m_s': _by_axis(velocity[usable]),
        'nees_position': mean(_finite(rows['nees_position'])),
        'nees_velocity': mean(_finite(rows['nees_velocity'])),
        'orientation_wrong_share': mean(_finite(rows['turned']) > WRONG_ATTITUDE)}


def holds(states: Sequence[tuple[float, str]], reasons: Sequence[tuple[float, str]],
          end: float) -> list[tuple[float, float, str]]:
    """
    Return every HOLD of the planner from time 0 to an end, s: when, for how long and why.

    :param states: that it entered, each with its time.
    :param reasons: that it gave, each with its time; the first told during a HOLD is that one's.
    """
    found = []
    for (begin, state), (until, _) in zip(states, [*states[1:], (end, '')]):
        begin, until = max(begin, 0.0), min(until, end)
        if state == 'HOLD' and begin < until:
            why = next((reason for t, reason in reasons if begin <= t <= until and reason), '')
            found.append((begin, until - begin, why))
    return found


def hold_figures(held: Sequence[tuple[float, float, str]]) -> dict[str, dict[str, Any]]:
    """Return how often and how long it held, and a line for each time."""
    unknown = 'too short for its reason to be on /diagnostics'
    return {'planner': {'hold_count': len(held), 'hold_s': float(sum(s for _, s, _ in held))},
            'holds': {f'at_{begin:.1f}_s': f'{span:.1f} s: {why or unknown}'
                      for begin, span, why in held}}


def write_summary(summary: Mapping[str, Any], path: Path) -> None:
    """
    Write a summary as JSON.

    :raises OSError: where it cannot be written.
    """
    with whole_file(path) as file:
        file.write((json.dumps(summary, indent=2, ensure_ascii=False) + '\n').encode())


def jsonable(value: Any) -> Any:
    """Return a summary with None for what is NaN or infinite, which JSON does not know."""
    if isinstance(value, dict):
        return {key: jsonable(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def mean(values: Any) -> float | None:
    """Return the mean, or None of nothing."""
    return float(np.mean(values)) if len(values) else None


def rms(values: Array) -> float | None:
    """Return the root mean square, or None of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def most(values: Array) -> float | None:
    """Return the greatest value, or None of nothing or if a value is NaN or infinite."""
    return float(np.max(values)) if len(values) and np.isfinite(values).all() else None


def spread(values: Array) -> dict[str, float | None]:
    """Return least, mean and greatest finite value."""
    values = _finite(values)
    if not len(values):
        return {'min': None, 'mean': None, 'max': None}
    return {'min': float(np.min(values)), 'mean': float(np.mean(values)),
            'max': float(np.max(values))}


def rate(times: Array) -> float:
    """Return the mean rate, Hz, of events at the given times (n,), s; 0 for fewer than two."""
    return float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else 0.0


def _errors(rows: Table, kind: str) -> Array:
    """Return the errors (n, 3) of the images where they are known."""
    errors = np.stack([rows[f'{kind}_{axis}'] for axis in 'xyz'], axis=1)
    return errors[np.isfinite(errors).all(axis=1)]


def _usable(rows: Table, max_velocity_std: float) -> Any:
    """Return which of the images with known errors have a velocity the planner would use."""
    known = np.isfinite(rows['velocity_x'])
    variance = sum(rows[f'velocity_sigma_{axis}'][known] ** 2 for axis in 'xyz')
    return variance <= max_velocity_std ** 2


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]


def _by_axis(errors: Array) -> dict[str, float | None]:
    return {axis: mean(errors[:, i]) for i, axis in enumerate('xyz')}
