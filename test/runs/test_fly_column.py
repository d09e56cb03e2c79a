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

from types import SimpleNamespace

import numpy as np
import pytest

from flock_desk.fly import main
from flock_desk.runs.desk_flight import fly, namespaces
from flock_desk.runs.fly_bounds import Usage
from flock_desk.runs.fly_column import column_bounds, spacing, summarize_column
from flock_desk.runs.judge import judge
from flock_desk.runs.processes import Processes
from flock_desk.scenarios.scenario_file import load


class Pretended(Processes):
    """What was started and asked for, without processes."""

    def __init__(self, environment, log_folder):
        super().__init__(environment, log_folder)
        self.started, self.asked = {}, []
        Pretended.last = self

    def start(self, name, module, arguments=(), *, show=False):
        self.started[name] = (module, list(arguments), show)
        codes = iter([None] * 4 + [0] * 99)  # it ends after a while
        self.children[name] = SimpleNamespace(pid=0, returncode=0, poll=lambda: (
            next(codes) if name.endswith('simulator') else None))

    def ask(self, service, *_):
        self.asked.append(service)
        return 'yes'

    def stop_all(self, timeout=2.0):
        return dict.fromkeys(self.children, 0)


def test_each_follower_has_nodes_of_its_own_and_the_one_before_it_as_its_leader(
        tmp_path, monkeypatch):
    monkeypatch.setattr('flock_desk.runs.desk_flight.Processes', Pretended)
    _, exit_codes = fly(load('straight'), 'straight', 7, 1.0, tmp_path, followers=2)
    started, asked = Pretended.last.started, Pretended.last.asked
    assert set(exit_codes) == set(started) == {
        f'follower_{i}/{node}' for i in (1, 2) for node in (
            'recorder', 'simulator', 'relative_pose', 'planner', 'mavlink_bridge')}
    for name, (_, arguments, show) in started.items():
        assert f'__ns:=/{name.partition("/")[0]}' in arguments
        assert show == (name == 'follower_1/simulator')

    def given(name, parameter):
        return [word.partition(':=')[2] for word in started[name][1]
                if word.startswith(f'{parameter}:=')]

    assert given('follower_1/simulator', 'leader_topic') == []
    assert given('follower_2/simulator', 'leader_topic') == ['/follower_1/truth/motion']
    assert given('follower_2/simulator', 'leader_offset') == ['[1.5,0.0,0.0]']
    ports = set()
    for i in (1, 2):
        (link,), (port,) = (given(f'follower_{i}/{node}', 'connection')
                            for node in ('mavlink_bridge', 'simulator'))
        assert link == f'udpin:{port}'
        ports.add(port)
        for node in ('mavlink_bridge', 'simulator'):
            assert given(f'follower_{i}/{node}', 'target_system') == [str(i)]
    assert len(ports) == 2
    # The first one flies off when it is engaged: it is the last to be.
    assert asked == [f'/follower_{i}/{what}' for i in (2, 1) for what in (
        'mavlink_bridge/arm', 'mavlink_bridge/offboard', 'planner/engage')]


def record(began, positions, images=()):
    """Return what the column's figures need of a flight of a second at 50 Hz."""
    times = np.linspace(0.0, 1.0, 51)
    stamps = (np.linspace(began, began + 1.0, 31) * 1e9).astype(np.int64)
    return SimpleNamespace(
        velocity_times=times, velocities=np.zeros((51, 3)), log={
            'began': began, 'ended': began + 1.0, 'position': np.tile(positions, (51, 1)),
            'start': 0.0, 'epoch_ns': 0, 'image_stamp': stamps,
            'leader_position': np.tile(images or (0.0, 0.0, 0.0), (31, 1))})


def test_distances_are_between_places_in_one_frame():
    scenario = load('straight')  # they begin 1.5 m apart
    assert spacing(scenario) == 1.5
    flights = {'follower_1': record(5.0, (0.0, 0.0, 1.5), (1.5, 0.0, 1.5)),
               'follower_2': record(5.2, (0.7, 0.0, 1.5))}
    summary = summarize_column(scenario, flights)
    assert summary['pairs'] == pytest.approx({
        'leader to follower_1': 1.5, 'leader to follower_2': 2.3,
        'follower_1 to follower_2': 0.8}, abs=1e-6)
    assert summary['nearest_m'] == pytest.approx(0.8)
    assert [j.bound.key for j in judge(column_bounds(scenario), summary) if j.fault] == [
        'nearest_m']


def test_each_follower_has_the_cpu_time_of_its_own_processes():
    usage = Usage({'follower_1/planner': 1.0, 'follower_2/planner': 2.0}, 0.0,
                  {'follower_1/planner': 2.0, 'follower_2/planner': 7.0}, 10.0)
    assert usage.of('follower_1/').cores() == {'planner': 0.1}
    assert usage.of('follower_2/').cores() == {'planner': 0.5}
    assert usage.of('') == usage


def test_one_alone_has_no_namespace():
    assert namespaces(1) == ['']
    assert namespaces(3) == ['follower_1', 'follower_2', 'follower_3']


@pytest.mark.parametrize(('arguments', 'said'), [
    (['--followers', '0'], '--followers = 0: must be an integer in [1, 8]'),
    (['--followers', '2', '--autopilot', 'udp:127.0.0.1:14540'], 'not with --autopilot')])
def test_a_column_that_cannot_be_flown_is_refused(arguments, said, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert said in capsys.readouterr().err
