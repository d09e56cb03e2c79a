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

"""`make demo`: the figures of a recorded flight, and the bounds on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from bag_excerpts import excerpt
import numpy as np
import pytest

from flock_desk.demo import demo_bounds, flown
from flock_desk.runs.evaluation import evaluate
from flock_desk.runs.judge import judge
from flock_desk.runs.plots import chapters
from flock_desk.runs.record import Flight, read_replayed
from flock_desk.runs.summary import evaluation_figures, replay_figures
from flock_follower.bags.bag import open_bag
from flock_follower.bags.message_types import typestore
from flock_follower.bags.writer import BagWriter
from flock_follower.messages import NANOSECONDS
from flock_follower.parameters.files import read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.system.files import resource

pytestmark = pytest.mark.slow

SECONDS = 5.0  # of the sample bag
PARAMS = flown()
BOUNDS = demo_bounds(PARAMS)
LATER = 5.0  # s from the bag's clock to that of the logs, but for the bag's start
COUNTED = {'relative_pose': {'images_processed': str(round(30 * SECONDS)),
                             'stamp_to_estimate_p50_ms': '20.0'},
           'planner': {'missed_ticks': '0'},
           'mavlink_bridge': {f'latency_p{p}_ms': '40.0' for p in (50, 95, 99)}}


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return excerpt(tmp_path_factory.mktemp('bags') / 'short', SECONDS)


@pytest.fixture(scope='module')
def evaluated(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return what the nodes would publish of the bag, and its summary."""
    path = tmp_path_factory.mktemp('out') / 'result.mcap'
    values = read_parameters(resource('config/follower.yaml'), TABLE)
    return path, evaluation_figures(evaluate(bag, values, path))


@pytest.fixture(scope='module')
def flight(bag: Path, evaluated: tuple[Path, dict[str, Any]],
           tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Return the flight of a record made of that: nothing late, nothing lost."""
    out = tmp_path_factory.mktemp('record')
    with open_bag(evaluated[0]) as result, BagWriter(out / 'record') as record:
        for m in result.messages(['/neighbors', '/planner/state', '/command/trajectory']):
            record.write(m.topic, m.msgtype, m.stamp_ns + round(LATER * NANOSECONDS), m.data)
            end = m.stamp_ns
        record.write('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray',
                     end + round(LATER * NANOSECONDS), diagnostics())
    count = round(20 * SECONDS)
    times = end / NANOSECONDS + LATER - np.arange(count)[::-1] / 20
    along = np.tile([1.0, 0.0, 0.0], (count, 1))
    np.savez(out / 'autopilot.npz', state_time=times, position=0 * along, velocity=0.5 * along,
             setpoint_time=times, setpoint_acceleration=np.tile([0.0, 0.0, 0.3], (count, 1)))
    return read_replayed(bag, out, PARAMS)


def diagnostics() -> Any:
    types = typestore().types
    header = types['std_msgs/msg/Header'](types['builtin_interfaces/msg/Time'](0, 0), '')
    status, pair = (types[f'diagnostic_msgs/msg/{name}'] for name in (
        'DiagnosticStatus', 'KeyValue'))
    return types['diagnostic_msgs/msg/DiagnosticArray'](header, [
        status(0, node, '', '', [pair(*item) for item in values.items()])
        for node, values in COUNTED.items()])


def test_its_figures_are_those_of_evaluate(
        evaluated: tuple[Path, dict[str, Any]], flight: Flight) -> None:
    mine, theirs = replay_figures(flight, {}), evaluated[1]
    for key in ('frames', 'frames_in_view', 'recall'):
        assert mine[key] == theirs[key]
    for key in ('distance_rms_m', 'distance_bias_m', 'position_rms_m', 'velocity_rms_m_s',
                'velocity_rms_of_all_m_s', 'nees_position', 'orientation_wrong_share',
                'distance_m', 'true_distance_m', 'position_bias_m', 'velocity_bias_m_s'):
        assert mine[key] == pytest.approx(theirs[key], rel=1e-6, abs=1e-9), key
    assert mine['planner']['rate_hz'] == pytest.approx(10.0)
    assert mine['setpoints'] == pytest.approx(
        {'sent': len(flight.setpoints), 'rate_hz': 20.0, 'opposed_share': 0.0,
         'acceleration_max_m_s2': 0.3})


def test_a_good_flight_keeps_every_bound_and_each_can_be_broken(flight: Flight) -> None:
    summary = replay_figures(flight, {'planner': 0, 'replay': 0})
    assert [j.fault for j in judge(BOUNDS, summary) if j.fault] == []
    ended_badly = replay_figures(flight, {'planner': None, 'replay': 1})
    assert [j.fault for j in judge(BOUNDS, ended_badly) if j.fault] == [
        'failed_processes = 2: must be at most 0']
    broken = {key: dict.fromkeys(value, 1000.0) if isinstance(value, dict) else 1e3
              for key, value in summary.items()}
    least = {b.key for b in BOUNDS if b.most is None}
    assert {j.bound.key for j in judge(BOUNDS, broken) if not j.fault} == least
    assert all(j.fault for j in judge(BOUNDS, {}))


def test_commands_and_law_agree_unless_a_sign_is_turned(flight: Flight) -> None:
    share = replay_figures(flight, {})['planner']['along_law_share']
    # Here the planner brakes the bag's follower, which is faster than 0.5 m/s, against the law.
    assert len(flight.along_law) > 40 and share > 0.6
    turned = replace(flight, along_law=~flight.along_law)
    broken = [j for j in judge(BOUNDS, replay_figures(turned, {}), busy=True)
              if j.verdict == 'FAILED']
    assert [j.bound.key for j in broken] == ['planner.along_law_share']
    # Of too few commands nothing is known; a busy machine explains that.
    few = replace(flight, along_law=flight.along_law[:9])
    assert replay_figures(few, {})['planner']['along_law_share'] is None


def test_a_flight_without_a_command_is_judged_by_what_is_known(
        bag: Path, tmp_path: Path) -> None:
    times = np.arange(600) / 20
    with BagWriter(tmp_path / 'record') as record:
        record.write('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray',
                     round(29.0 * NANOSECONDS), diagnostics())
    np.savez(tmp_path / 'autopilot.npz', state_time=times, setpoint_time=times[:20],
             velocity=np.outer(np.linspace(0.0, 6.0, 600), [1.0, 0.0, 0.0]),
             setpoint_acceleration=np.zeros((20, 3)))
    summary = replay_figures(read_replayed(bag, tmp_path, PARAMS), {})
    judgments = judge(BOUNDS, summary)
    assert {j.bound.key for j in judgments if j.fault} > {
        'planner.rate_hz', 'planner.along_law_share', 'recall_of_processed', 'setpoints.sent'}
    # A vehicle that runs away is none of a busy machine.
    excused = judge(BOUNDS, summary, busy=True)
    assert [j.fault for j in excused if j.verdict == 'FAILED' and 'recall' not in j.fault] == [
        'speed_max_m_s = 6: must be at most 2']


def test_process_cut_off_while_waiting_is_late_not_failed(flight: Flight) -> None:
    summary = replay_figures(flight, {'planner': 0, 'replay': 3, 'recorder': -9})
    assert (summary['failed_processes'], summary['late_processes']) == (1, 1)


def test_the_report_shows_the_flight_and_its_errors(flight: Flight) -> None:
    flown, errors = chapters(flight)
    assert [len(chapter.illustrations) for chapter in (flown, errors)] == [1, 1]
