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

"""What check says of a system or a bag as a whole."""

from __future__ import annotations

from observed import healthy, Observed
from observed_faults import delayed, kept, machine, NO_CALIBRATION, OTHER_ODOMETRY
import pytest

from flock_follower.check import main
from flock_follower.checks.findings import ERROR, OK, ready, still_needed, UNMEASURED, WARNING
from flock_follower.checks.observations import NodeStatus, Observations
from flock_follower.checks.processor import Load
from flock_follower.checks.recorded_system import judge_all


@pytest.mark.parametrize(('load', 'late', 'fault', 'code', 'last'), [
    (0.2, 0.0, False, 0, 'ready to fly'), (0.2, 0.3, False, 0, 'ready to fly'),
    (0.7, 0.0, False, 3, 'too busy: for 70% of the worst 2 s'),
    (0.7, 0.3, True, 1, 'not ready to fly'), (0.01, 0.3, False, 1, 'not ready to fly')])
def test_exit_code_is_3_only_if_busy_computer_prevents_flight(
        monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], load: float,
        late: float, fault: bool, code: int, last: str) -> None:
    seen = healthy(True)
    delayed('odom', late)(seen)
    machine(load=Load(load, 1.5, 2))(seen)
    if fault:
        seen.nodes.remove('/planner')
    monkeypatch.setattr('flock_follower.check._observe', lambda _: (seen, seen.judged()))
    assert main([]) == code
    assert capsys.readouterr().out.splitlines()[-1].startswith(last)


def test_an_empty_graph_is_one_line() -> None:
    (finding,) = judge_all(Observations())
    assert finding.level == ERROR and 'no node is seen on domain 0' in finding.measured
    assert 'ROS_DOMAIN_ID' in finding.advice


@pytest.mark.parametrize('live', [True, False])
def test_what_is_not_measured_is_never_ok(live: bool) -> None:
    known = healthy(live)
    seen = Observations(live=live, names=known.names, nodes=known.nodes)
    assert {finding.what for finding in judge_all(seen) if finding.level == OK} == (
        {'nodes'} if live else set())
    # Of the autopilot nothing is ok by a value that the bridge did not report.
    seen = healthy(True)
    seen.statuses['mavlink_bridge'].values = {'link': 'alive'}
    autopilot = {'autopilot', 'answers', 'ready to arm', 'ready for offboard'}
    found = {finding.what: finding.level for finding in seen.judged()}
    assert {found[what] for what in autopilot} == {UNMEASURED}


def rows(seen: Observed) -> dict[str, str]:
    return {finding.what: finding.level for finding in seen.judged()}


def test_one_cause_has_one_row() -> None:
    seen = healthy()
    NO_CALIBRATION(seen)
    seen.sightings = []  # without a calibration a marker has no place
    seen.statuses['relative_pose'] = NodeStatus(
        2, 'no image processed for 4 s: no usable camera_info')
    seen.statuses['planner'] = NodeStatus(1, 'no neighbor: relative_pose processes no image')
    left = rows(healthy()).keys() - rows(seen).keys()
    assert left == {'calibration', 'odom ahead', 'camera time offset', 'focal length',
                    'marker size', 'camera mounting', 'relative_pose status',
                    'planner status'}
    assert [what for what, level in rows(seen).items() if level != OK] == ['camera_info']

    seen = healthy()
    OTHER_ODOMETRY(seen)
    assert [what for what in rows(seen) if 'odom' in what] == ['odom']
    assert not {'marker size', 'camera mounting', 'camera time offset'} & rows(seen).keys()


def test_faults_of_recorded_nodes_do_not_spoil_a_bag() -> None:
    seen = healthy(live=False)
    seen.statuses = {'planner': NodeStatus(2, 'no /odom for 4 s: no publisher')}
    assert rows(seen)['planner status'] == WARNING and ready(seen.judged())
    kept('odom', slice(2))(seen)
    assert still_needed(seen.judged()) == ['odom rate'] and not ready(seen.judged())
