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


"""The sample bag with odometry of other sources, and with clocks and gyroscopes that are off."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from rewritten_odometry import rewritten_bag, Source, sources

from flock_desk.runs.evaluation import evaluate, Evaluation, STATES
from flock_desk.runs.summary import evaluation_figures
from flock_follower.parameters.files import parse_parameters, read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.planner.modes import State
from flock_follower.system.files import resource

ATTITUDE_NOISE = np.radians(0.3)


class Case(NamedTuple):
    """A source; by how much the images' stamps are off, s, and tremble; what is asked for."""

    source: Source
    offset: float = 0.0
    jitter: float = 0.0
    recall: float = 0.97
    velocity: float = 0.05  # m/s, RMS


CASES = {name: Case(source) for name, source in sources()}
CASES['no twist'] = CASES['no twist']._replace(velocity=0.1)
for slow in ('10 Hz', '10 Hz, 60 ms late'):
    CASES[slow] = CASES[slow]._replace(recall=0.9, velocity=0.1)
# Of the velocity twice what it is without is asked, which is 0.038.
ODD = {'images 20 ms late': Case(Source(), offset=0.02),
       'images 20 ms early': Case(Source(), offset=-0.02),
       'stamps that tremble by 5 ms': Case(Source(), jitter=0.005),
       'a gyroscope 5 ms late': Case(Source(gyro_lag=0.005)),
       'attitudes that tremble': Case(Source(attitude_noise=ATTITUDE_NOISE))}
CASES.update({name: case._replace(recall=0.95, velocity=0.075) for name, case in ODD.items()})


def evaluated(case: Case, folder: Path, seconds: float) -> tuple[Evaluation, dict[str, Any]]:
    bag = rewritten_bag(folder / 'bag', case.source, case.offset, case.jitter, seconds)
    values = read_parameters(resource('config/follower.yaml'), TABLE)
    reported = parse_parameters({'/**': {'ros__parameters': case.source.parameters}}, TABLE)
    for node in values:
        values[node].update({name: reported[node][name] for name in case.source.parameters})
    evaluation = evaluate(bag, values, folder / 'result.mcap')
    return evaluation, evaluation_figures(evaluation)


def worst_second(evaluation: Evaluation) -> float:
    """Return the largest mean error of the velocity, m/s, over a second in TRACK."""
    table = evaluation.tables['leader']
    error = table['velocity']
    ticks = evaluation.ticks
    tracking = ticks[:, 1] == STATES.index(State.TRACK.value)
    worst = []
    for start in np.arange(0.0, evaluation.duration - 1.0, 0.1):
        tick = (ticks[:, 0] >= start) & (ticks[:, 0] <= start + 1.0)
        seen = (table['time'] >= start) & (table['time'] <= start + 1.0) & (
            np.isfinite(error).all(axis=1))
        if tracking[tick].all() and np.count_nonzero(seen) > 3:
            worst.append(float(np.linalg.norm(error[seen].mean(axis=0))))
    assert len(worst) > 5.0 * evaluation.duration
    return max(worst)


#: The others are more cases of the same; late images alone: test/perception/test_time_offset.py.
USUAL = ('IMU axes, twist in odom, no rates, no covariances', '10 Hz, 60 ms late')


@pytest.mark.parametrize(('case', 'seconds'), [
    *(pytest.param(CASES[name], 6.0, id=f'{name}, 6 s') for name in USUAL),
    *(pytest.param(case, 60.0, id=name, marks=pytest.mark.sweep) for name, case in CASES.items())])
def test_the_leader_is_found_and_its_velocity_is_right(
        case: Case, seconds: float, tmp_path: Path) -> None:
    evaluation, summary = evaluated(case, tmp_path, seconds)
    assert summary['recall'] >= case.recall
    assert summary['velocity_rms_m_s'] <= case.velocity
    if not (case.offset or case.jitter):
        assert summary['distance_rms_m'] <= 0.003
    assert worst_second(evaluation) <= 0.15
    assert evaluation.setpoint_kinds['command'] > 16.0 * evaluation.duration
