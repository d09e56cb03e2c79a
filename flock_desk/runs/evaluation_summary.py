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

from collections.abc import Mapping
from typing import Any

import numpy as np

from flock_desk.runs.evaluation import Evaluation, STATES
from flock_desk.runs.frame_errors import STAGES
from flock_desk.runs.summary import (
    hold_figures,
    holds,
    jsonable,
    mean,
    most,
    sight_figures,
)
from flock_follower.checks.findings import ERROR, WARNING
from flock_follower.geometry import Array

#: Keys whose figures are times measured here, and so differ from run to run.
TIMINGS = ('cpu_ms_per_frame', 'realtime_factor', 'timings')


def summarize(evaluation: Evaluation) -> dict[str, Any]:
    """
    Return the summary: figures by name, those that cannot be known None.

    Those of sight and errors are :func:`flock_desk.runs.summary.sight_figures`.
    ``cpu_ms_per_frame`` is the CPU time of perception, decoding apart; under ``timings`` it is by
    the costliest stage an image needed. ``planner.hold_count`` counts its HOLDs, ``hold_s`` is the
    time spent in them, ``holds`` tells each with its reason. ``own_speed_max_m_s`` is that of the
    follower in the bag, ``faster_than_v_max_share`` the share of ticks in which it was too fast.
    ``check`` holds the errors and the warnings of the rules of ``check``, a line each.
    """
    tables = [evaluation.errors.table(name) for name in evaluation.names]
    stages = np.concatenate([np.where(np.isfinite(table['distance']), table['stage'], 0.0)
                             for table in tables])
    cpu = {what: np.asarray(times, dtype=float) for what, times in sorted(evaluation.cpu.items())}
    spent = np.concatenate([cpu[stage] for stage in STAGES if stage in cpu] or [np.zeros(0)])
    faster = evaluation.ticks[:, 3] > evaluation.flight.planner_params.v_max
    held = hold_figures(holds(evaluation.states, evaluation.reasons, evaluation.duration))
    summary = {
        'bag': evaluation.bag,
        'duration_s': evaluation.duration,
        'check': {f'{level}s': [finding.line for finding in evaluation.findings
                                if finding.level == level] for level in (ERROR, WARNING)},
        'neighbors': evaluation.names,
        'frames': evaluation.images,
        **sight_figures(tables, evaluation.flight.planner_params.max_velocity_std),
        'own_speed_max_m_s': most(_known(evaluation.ticks[:, 3])),
        'faster_than_v_max_share': mean(faster),
        'detections': {stage: int(np.count_nonzero(stages == STAGES.index(stage)))
                       for stage in (*STAGES[1:], STAGES[0])},
        'rejections': dict(sorted(evaluation.rejections.items())),
        'planner': {**_planner(evaluation), **held['planner']},
        'holds': held['holds'],
        'setpoints': {
            **{kind: evaluation.setpoint_kinds[kind]
               for kind in ('command', 'brake', 'level', 'none')},
            'acceleration_max_m_s2': most(np.linalg.norm(evaluation.setpoints[:, 1:4], axis=1)),
            'reasons': dict(sorted(evaluation.brake_reasons.items()))},
        'cpu_ms_per_frame': mean(1e3 * spent),
        'realtime_factor': evaluation.duration / evaluation.wall_time,
        'timings': {
            'wall_time_s': evaluation.wall_time,
            'cpu_ms': {what: _percentiles(1e3 * cpu.get(what, np.zeros(0)))
                       for what in ('decode', *STAGES, 'planner', 'gate')}},
    }
    return {key: jsonable(value) for key, value in summary.items()}


def differing(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return a summary without its timings: what two runs have in common."""
    return {key: value for key, value in summary.items() if key not in TIMINGS}


def _planner(evaluation: Evaluation) -> dict[str, Any]:
    ticks = evaluation.ticks
    return {'ticks': len(ticks),
            'commands': int(np.count_nonzero(np.isfinite(ticks[:, 2]))),
            'acceleration_max_m_s2': most(_known(ticks[:, 2])),
            'states': {state: int(np.count_nonzero(ticks[:, 1] == i))
                       for i, state in enumerate(STATES)}}


def _known(values: Array) -> Array:
    """Return the values of the ticks that have one: of the others it is NaN."""
    return values[~np.isnan(values)]


def _percentiles(values: Array) -> dict[str, float | int | None]:
    if not len(values):
        return {'p50': None, 'p99': None, 'count': 0}
    p50, p99 = np.percentile(values, [50, 99])
    return {'p50': float(p50), 'p99': float(p99), 'count': len(values)}
