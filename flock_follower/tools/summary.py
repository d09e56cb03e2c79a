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

"""The figures of an evaluation, as they go into summary.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import math
from typing import Any

import numpy as np

from flock_follower.geometry import Array
from flock_follower.tools.evaluation import Evaluation, STATES
from flock_follower.tools.frame_errors import STAGES

#: Keys whose figures are times measured here, and so differ from run to run.
TIMINGS = ('cpu_ms_per_frame', 'realtime_factor', 'timings')
#: Keys under which anything may appear, a count of 0 unless it does.
COUNTERS = ('rejections', 'setpoints.reasons')
#: Attitudes further than this from the truth count as wrong, rad.
WRONG_ATTITUDE = math.radians(20.0)


def summarize(evaluation: Evaluation) -> dict[str, Any]:
    """
    Return the summary: figures by name, those that cannot be known None.

    Images count once for each neighbour. ``recall`` is the share with an estimate, of those in
    which the truth has a marker in view, or of all where there is no truth. Errors are those of
    ``frame_errors``, over all images with an estimate and truth; ``velocity_rms_m_s`` and
    ``velocity_bias_m_s`` leave out estimates that the planner refuses for their uncertainty, as
    the first one of a track, ``velocity_rms_of_all_m_s`` does not. ``nees_`` are means, 3 where
    covariances are right. ``cpu_ms_per_frame`` is the CPU time of perception, decoding apart;
    under ``timings`` it is by the costliest stage an image needed.
    """
    tables = [evaluation.errors.table(name) for name in evaluation.names]
    rows = {column: np.concatenate([table[column] for table in tables]) for column in tables[0]}
    found = np.isfinite(rows['distance'])
    known = np.isfinite(rows['true_distance'])
    pairs = max(evaluation.images * len(tables), 1)
    recall = (_mean(found[rows['visible'] == 1.0]) if np.any(known)
              else np.count_nonzero(found) / pairs)
    position, velocity = _errors(rows, 'position'), _errors(rows, 'velocity')
    usable = _usable(rows, evaluation)
    distance_error = (rows['distance'] - rows['true_distance'])[found & known]
    stages = rows['stage'][found].astype(int)
    cpu = {what: np.asarray(times, dtype=float) for what, times in sorted(evaluation.cpu.items())}
    spent = np.concatenate([cpu[stage] for stage in STAGES if stage in cpu] or [np.zeros(0)])
    summary = {
        'bag': evaluation.bag,
        'duration_s': evaluation.duration,
        'neighbors': evaluation.names,
        'frames': evaluation.images,
        'frames_in_view': int(np.count_nonzero(rows['visible'] == 1.0)) if np.any(known) else None,
        'recall': recall,
        'detections': {
            **{stage: int(np.count_nonzero(stages == STAGES.index(stage)))
               for stage in STAGES if stage != 'none'},
            'none': pairs - int(np.count_nonzero(found))},
        'rejections': dict(sorted(evaluation.rejections.items())),
        'distance_m': _spread(rows['distance'][found]),
        'distance_rms_m': _rms(distance_error),
        'distance_bias_m': _mean(distance_error),
        'position_rms_m': _rms(np.linalg.norm(position, axis=1)),
        'position_bias_m': _by_axis(position),
        'velocity_rms_m_s': _rms(np.linalg.norm(velocity[usable], axis=1)),
        'velocity_rms_of_all_m_s': _rms(np.linalg.norm(velocity, axis=1)),
        'velocity_bias_m_s': _by_axis(velocity[usable]),
        'nees_position': _mean(_finite(rows['nees_position'])),
        'nees_velocity': _mean(_finite(rows['nees_velocity'])),
        'orientation_wrong_share': _mean(_finite(rows['turned']) > WRONG_ATTITUDE),
        'planner': _planner(evaluation),
        'setpoints': {
            **{kind: evaluation.setpoint_kinds[kind]
               for kind in ('command', 'brake', 'level', 'none')},
            'acceleration_max_m_s2': _most(evaluation.setpoints[:, 1]),
            'reasons': dict(sorted(evaluation.brake_reasons.items()))},
        'cpu_ms_per_frame': _mean(1e3 * spent),
        'realtime_factor': evaluation.duration / evaluation.wall_time,
        'timings': {
            'wall_time_s': evaluation.wall_time,
            'cpu_ms': {what: _percentiles(1e3 * cpu.get(what, np.zeros(0)))
                       for what in ('decode', *STAGES, 'planner', 'gate')}},
    }
    return {key: _jsonable(value) for key, value in summary.items()}


def differing(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return a summary without its timings: what two runs have in common."""
    return {key: value for key, value in summary.items() if key not in TIMINGS}


def _planner(evaluation: Evaluation) -> dict[str, Any]:
    ticks = evaluation.ticks
    return {'ticks': len(ticks),
            'commands': int(np.count_nonzero(np.isfinite(ticks[:, 2]))),
            'acceleration_max_m_s2': _most(ticks[:, 2]),
            'states': {state: int(np.count_nonzero(ticks[:, 1] == i))
                       for i, state in enumerate(STATES)}}


def _errors(rows: Mapping[str, Array], kind: str) -> Array:
    """Return the errors (n, 3) of the images where they are known."""
    errors = np.stack([rows[f'{kind}_{axis}'] for axis in 'xyz'], axis=1)
    return errors[np.isfinite(errors).all(axis=1)]


def _usable(rows: Mapping[str, Array], evaluation: Evaluation) -> Any:
    """Return which of the images with known errors have a velocity the planner would use."""
    known = np.isfinite(rows['velocity_x'])
    variance = sum(rows[f'velocity_sigma_{axis}'][known] ** 2 for axis in 'xyz')
    return variance <= evaluation.lockstep.planner_params.max_velocity_std ** 2


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]


def _mean(values: Any) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _most(values: Array) -> float | None:
    finite = _finite(values)
    return float(np.max(finite)) if len(finite) else None


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _spread(values: Array) -> dict[str, float | None]:
    if not len(values):
        return {'min': None, 'mean': None, 'max': None}
    return {'min': float(np.min(values)), 'mean': float(np.mean(values)),
            'max': float(np.max(values))}


def _by_axis(errors: Array) -> dict[str, float | None]:
    return {axis: _mean(errors[:, i]) for i, axis in enumerate('xyz')}


def _percentiles(values: Array) -> dict[str, float | int | None]:
    if not len(values):
        return {'p50': None, 'p99': None, 'count': 0}
    p50, p99 = np.percentile(values, [50, 99])
    return {'p50': float(p50), 'p99': float(p99), 'count': len(values)}


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _jsonable(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def flat(summary: Mapping[str, Any], prefix: str = '') -> Iterable[tuple[str, Any]]:
    """Yield every figure under its dotted name."""
    for key, value in summary.items():
        if isinstance(value, Mapping):
            yield from flat(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value
