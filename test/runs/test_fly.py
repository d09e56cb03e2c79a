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

"""`make fly`: the loop through the real nodes, its bounds, its report, and how it ends."""

import base64
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

from full_disk import disk_of
import numpy as np
import pytest

from flock_desk.fly import cautions, main
from flock_desk.runs.desk_flight import ended_by_bridge, fly, processes_cpu
from flock_desk.runs.flight_folder import clear
from flock_desk.runs.fly_bounds import bounds, summarize, Usage
from flock_desk.runs.fly_record import chapters, LiveRecord, read
from flock_desk.runs.frame_errors import COLUMNS
from flock_desk.runs.judge import flat, judge
from flock_desk.runs.processes import free_udp_port, Processes, wait_until
from flock_desk.runs.report import write_report
from flock_desk.scenarios.scenario import Outage, Scenario
from flock_desk.scenarios.scenario_file import load


@pytest.mark.slow
@pytest.mark.ros
def test_a_flight_through_the_real_nodes_is_safe_and_its_report_complete(tmp_path):
    scenario = load('hover')
    usage, exit_codes = fly(scenario, 'hover', 0, 4.0, tmp_path)
    assert set(exit_codes.values()) == {0}
    flight = read(scenario, tmp_path)
    assert flight.duration == pytest.approx(4.0, abs=0.02)
    # Whatever else this machine is doing: nothing unsafe is sent or flown, and it follows.
    assert flight.distance.min() > 1.0 and flight.distance.max() < np.sqrt(8.0)
    assert np.linalg.norm(flight.setpoints, axis=1).max() <= 2.5
    assert np.linalg.norm(flight.log['velocity'], axis=1).max() <= 0.55
    summary = summarize(flight, usage, exit_codes)
    assert summary['setpoints']['sent'] > 40 and summary['frames'] * summary['recall'] > 20
    assert summary['position_rms_m'] < 0.05
    assert 'TRACK' in [state for _, state in flight.states]
    assert set(flight.log['mode']) == {'OFFBOARD'}
    for name in ('relative_pose', 'planner', 'mavlink_bridge', 'recorder'):
        assert 'Traceback' not in (tmp_path / f'{name}.log').read_text()

    judgements = judge(bounds(flight, summary), summary)
    faults = {judgement.bound.key: judgement.fault for judgement in judgements}
    assert not faults['time_in_band_share']
    assert not faults['setpoints.acceleration_max_m_s2']
    assert {'simulator', 'planner'} <= set(summary['cpu_cores']) or not Path('/proc').exists()
    write_report(tmp_path / 'report.html', 'hover', '', summary, judgements,
                 lambda: chapters(flight))
    page = (tmp_path / 'report.html').read_text()
    assert 'http' not in re.sub(r'base64,[^"]*', '', page)  # it needs nothing from elsewhere
    pictures = re.findall(r'data:image/(png|jpeg);base64,([^"]+)', page)
    assert [kind for kind, _ in pictures][:3] == ['png', 'png', 'jpeg']
    assert base64.b64decode(pictures[0][1])[:4] == b'\x89PNG'
    for key in faults:
        assert f'<code>{key}</code>' in page


@pytest.mark.parametrize(('arguments', 'said'), [
    (['--scenario', 'outdor'], "scenario = 'outdor': must be one of approach, "),
    (['--scenario', 'nowhere.yaml'], 'nowhere.yaml: cannot be read'),
])
def test_a_wrong_scenario_is_told_before_anything_starts(arguments, said, tmp_path, capsys):
    assert main([*arguments, '--output', str(tmp_path / 'out')]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(('arguments', 'said'), [
    (['--seed', '-1'], '--seed = -1: must be an integer in [0, 2147483647]'),
    (['--duration', '-3'], '--duration = -3.0: must be a number in [0, 3600] s')])
def test_a_number_out_of_range_is_refused(arguments, said, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.ros
def test_ctrl_c_ends_every_process(tmp_path):
    child = subprocess.Popen(
        [sys.executable, '-m', 'flock_desk.fly', '--output', str(tmp_path / 'out')],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True)
    # Ctrl-C while a process still imports its modules has Python print a traceback.
    log = tmp_path / 'out' / 'mavlink_bridge.log'
    wait_until(lambda: log.exists() and 'state: INACTIVE' in log.read_text(), 40.0, 'a vehicle')
    started = descendants(child.pid)
    assert len(started) >= 5
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=20.0)
    assert child.returncode == 130
    assert 'interrupted' in errors and 'Traceback' not in errors
    wait_until(lambda: not any(running(pid) for pid in started), 5.0, 'every process to end')


def test_only_what_an_earlier_flight_left_is_removed(tmp_path):
    (tmp_path / 'record').mkdir()
    for name in ('record/record.mcap', 'flight.npz', 'report.html', 'summary.json', 'mine.txt'):
        (tmp_path / name).write_text('x')
    clear(tmp_path)
    clear(tmp_path / 'nowhere')
    assert [path.name for path in tmp_path.iterdir()] == ['mine.txt']


def test_a_scenario_with_operations_is_refused_not_flown_without_them(tmp_path, capsys):
    assert main(['--scenario', 'handover', '--output', str(tmp_path)]) == 1
    assert capsys.readouterr().err == (
        "error: scenario = 'handover': its operations are obeyed in lock step only: "
        'flights --scenario handover\n')


def test_a_full_disk_is_one_line_and_leaves_no_half_a_report(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr('flock_desk.fly.fly', lambda *_: (Usage({}, 0.0), {}))
    monkeypatch.setattr('flock_desk.fly.read', lambda *_: None)
    monkeypatch.setattr('flock_desk.fly.summarize', lambda *_: {'x': 'x' * 5_000_000})
    monkeypatch.setattr('flock_desk.fly.bounds', lambda *_: [])
    with disk_of(100_000):
        assert main(['--scenario', 'hover', '--output', str(tmp_path)]) == 1
    summary = tmp_path / 'summary.json'
    assert capsys.readouterr().err == (
        f'error: {summary}: File too large; the logs of every process are in {tmp_path}\n')
    assert [path.name for path in tmp_path.iterdir()] == ['.lock']


def test_a_recorder_that_fails_ends_the_flight_with_its_reason(tmp_path, monkeypatch):
    class Ended(Processes):
        """All of them have ended, the recorder badly."""

        def start(self, name, module, arguments=(), *, show=False):
            (self.log_folder / f'{name}.log').write_text(f'hm\nerror: {name} is full\n')
            self.children[name] = SimpleNamespace(
                pid=0, returncode=1, poll=lambda: None if name == 'simulator' else 1)

        def ask(self, *_):
            return 'yes'

        def stop_all(self, timeout=2.0):
            return {}
    monkeypatch.setattr('flock_desk.runs.desk_flight.Processes', Ended)
    with pytest.raises(RuntimeError, match='^the recorder ended early: error: recorder is full$'):
        fly(load('hover'), 'hover', 0, 1.0, tmp_path)


@pytest.mark.ros
def test_a_log_that_cannot_be_written_is_one_line_of_the_simulator(tmp_path):
    log = tmp_path / 'nowhere' / 'flight.npz'
    script = (
        'import sys; sys.argv = ["flock_follower/simulator", *sys.argv[1:]]\n'
        'from flock_desk.closed_loop.real_time_flight import RealTimeFlight\n'
        'RealTimeFlight.time = property(lambda self: 1e9)  # flown already\n'
        'from flock_desk.simulator_node import main; sys.exit(main())')
    ended = subprocess.run(
        [sys.executable, '-c', script, '--ros-args', '-p', f'log:={log}', '-p', 'scenario:=hover',
         '-p', f'connection:=127.0.0.1:{free_udp_port()}'],
        capture_output=True, text=True, timeout=40.0)
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1] == f'error: {log}: No such file or directory'
    assert 'Traceback' not in ended.stderr


def descendants(parent):
    children = Path(f'/proc/{parent}/task/{parent}/children')
    return [int(pid) for pid in children.read_text().split()]


def running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def synthetic(distance=2.0, speed=0.3, missing=(), states=((0.0, 'TRACK'),), outages=(),
              usable=None, leader_speed=0.0, said='', heights=(0.0, 0.0), external=None):
    """
    Return 10 s of a flight at one distance; images ``missing`` have no estimate.

    :param heights: of leader and follower, m, numbers or (300,).
    :param external: what the log of a flight on an autopilot elsewhere says otherwise.
    """
    count = 300
    times = np.arange(count) / 30
    along = np.tile([1.0, 0.0, 0.0], (count, 1))
    table = {column: np.zeros(count) for column in COLUMNS}
    table |= {'time': times, 'distance': np.full(count, distance),
              'true_distance': np.full(count, distance),
              'visible': np.ones(count) if usable is None else usable.astype(float)}
    table['distance'][list(missing)] = np.nan
    scenario = Scenario('test', 'for a test', outages=tuple(outages))
    values = [SimpleNamespace(key='warnings', value=said)]
    status = SimpleNamespace(status=[SimpleNamespace(name='planner', values=values, level=0)])
    leader, follower = (np.outer(np.broadcast_to(height, count), [0.0, 0.0, 1.0])
                        for height in heights)
    elsewhere = {} if external is None else {
        'pose_source': 'HIL_STATE_QUATERNION', 'clock': np.array([[0.0, 0.0], [10.0, 10.0]])}
    return LiveRecord(
        10.0, scenario.flight.planner(True), table, leader, follower,
        np.full(count, distance), times, 0.1 * along, times, speed * along, list(states),
        [(1.0, status)], scenario, {
            'leader_velocity': leader_speed * along, 'skipped_images': 0, 'pose_source': '',
            'pose_source_of_leader': '', 'duration': 10.0, 'ended_early': '', **elsewhere,
            **(external or {})})


USAGE = Usage({'planner': 1.0}, 0.0, {'planner': 2.0}, 10.0)


def judged(flight, usage=USAGE):
    """Return the figures, and what is wrong with them, each by key."""
    summary = summarize(flight, usage, {'planner': 0})
    faults = {j.bound.key: j.fault for j in judge(bounds(flight, summary), summary)}
    return dict(flat(summary)), faults


def test_a_machine_that_did_not_keep_up_is_told():
    assert cautions({'skipped_images': 4, 'frames': 1796, 'external': None}) == []
    (told,) = cautions({'skipped_images': 283, 'frames': 917, 'external': None})
    assert told.startswith('this machine was too busy: 24 % of the images')


def test_the_bounds_are_those_of_band_and_limits():
    figures, faults = judged(synthetic())
    assert figures['time_in_band_share'] == 1.0 and figures['cpu_cores.total'] == 0.1
    # Nobody has counted the planner's ticks; all else holds.
    assert [key for key, fault in faults.items() if fault] == ['planner.missed_ticks_share']
    near = judged(synthetic(0.95))[1]
    assert near['time_in_band_share'] and not near['true_distance_m.min']
    assert judged(synthetic(0.85))[1]['true_distance_m.min']
    assert judged(synthetic(3.0))[1]['true_distance_m.max']
    assert judged(synthetic(speed=0.6))[1]['speed_max_m_s']


@pytest.mark.parametrize('wrong', [np.nan, np.inf, -np.inf])
def test_a_single_figure_that_is_no_number_fails_its_bound(wrong):
    flight = synthetic(external={})
    flight.setpoints[7, 1] = flight.velocities[7, 1] = flight.follower[200, 2] = wrong
    figures, faults = judged(flight)
    for key in ('setpoints.acceleration_max_m_s2', 'speed_max_m_s', 'altitude_off_m'):
        assert figures[key] is None and 'not known' in faults[key]


def test_cpu_time_that_was_not_measured_fails_its_bound():
    for usage in (Usage({}, 0.0), Usage({'planner': 1.0}, 0.0)):
        figures, faults = judged(synthetic(), usage)
        assert figures['cpu_cores.total'] is None
        assert 'was not measured' in faults['cpu_cores.total']


def test_whom_the_leader_outruns_has_to_say_so_instead_of_holding_the_band():
    figures, faults = judged(synthetic(3.0, leader_speed=0.8))
    assert figures['leader_faster_than_v_max']
    assert faults['planner.warnings'] and 'time_in_band_share' not in faults
    figures, faults = judged(synthetic(3.0, leader_speed=0.8, said='cannot keep up'))
    assert figures['planner.warning'] == 'cannot keep up' and not faults['planner.warnings']


def test_a_leader_that_is_fast_for_a_moment_outruns_nobody():
    for seconds, outrun in ((0.9, False), (1.3, True)):
        flight = synthetic()
        times = flight.table['time']
        speeds = np.where((times >= 1.0) & (times < 1.0 + seconds), 0.8, 0.3)
        flight.log['leader_velocity'] = np.outer(speeds, [1.0, 0.0, 0.0])
        figures, faults = judged(flight)
        assert figures['leader_speed_max_m_s'] == 0.8
        assert figures['leader_faster_than_v_max'] == outrun
        assert ('time_in_band_share' in faults) == (not outrun)


def test_where_the_leader_is_not_known_to_be_in_the_band_it_is_not():
    flight = synthetic()
    flight.distance[::10] = np.nan
    figures, faults = judged(flight)
    assert figures['time_in_band_share'] == pytest.approx(0.9) and faults['time_in_band_share']
    assert figures['true_distance_m.min'] == figures['true_distance_m.max']  # of what is known


def test_gaps_count_only_where_the_leader_can_be_seen():
    assert judged(synthetic())[0]['longest_gap_in_view_s'] == 0.0
    gone = range(60, 90)
    figures, faults = judged(synthetic(missing=gone))
    assert figures['longest_gap_in_view_s'] == pytest.approx(1.0)
    assert figures['recall'] == pytest.approx(0.9) and faults['longest_gap_in_view_s']
    hidden = np.ones(300, dtype=bool)
    hidden[60:80] = False
    figures, faults = judged(synthetic(missing=gone, usable=hidden))
    assert figures['longest_gap_in_view_s'] == pytest.approx(1.0 / 3.0)
    assert not faults['longest_gap_in_view_s']


def test_the_height_is_judged_against_that_of_the_leader():
    climb = np.linspace(2.5, 4.5, 300)
    figures, faults = judged(synthetic(heights=(climb, climb - 0.18), external={}))
    assert figures['altitude_off_m'] == pytest.approx(0.18) and not faults['altitude_off_m']
    figures, faults = judged(synthetic(heights=(climb, 2.5), external={}))
    assert figures['altitude_off_m'] == pytest.approx(2.0) and faults['altitude_off_m']


def test_the_height_is_not_judged_while_the_leader_is_hidden_and_shortly_after():
    hidden = np.ones(300)
    hidden[90:150] = 0.0  # from 3 to 5 s
    away = np.zeros(300)
    away[90:235] = 1.0  # it is at its height again at 7.8 s
    figures, faults = judged(synthetic(heights=(away, 0.0), usable=hidden, external={}))
    assert figures['altitude_off_m'] == 0.0 and not faults['altitude_off_m']
    away[235:250] = 0.4
    assert judged(synthetic(heights=(away, 0.0), usable=hidden, external={}))[1]['altitude_off_m']


@pytest.mark.parametrize(('source', 'off'), [('', 0.5), ('HIL_STATE_QUATERNION', 0.0)])
def test_only_a_leader_flown_elsewhere_may_begin_at_another_height(source, off):
    heights = np.where(np.arange(300) < 60, 0.5, 0.0)
    figures, _ = judged(synthetic(heights=(heights, 0.0),
                                  external={'pose_source_of_leader': source}))
    assert figures['altitude_off_m'] == off


def test_a_flight_that_the_bridge_ended_fails_with_its_reason():
    figures, faults = judged(synthetic(external={}))
    assert figures['external.ended_early'] is None and not faults['duration_s']
    flight = synthetic(external={'duration': 60.0, 'ended_early': 'TAKEN_OVER: by the pilot'})
    figures, faults = judged(flight)
    assert figures['external.ended_early'] == 'TAKEN_OVER: by the pilot'
    assert faults['duration_s'] == 'duration_s = 10: must be at least 59.9'
    (told,) = cautions({'skipped_images': 0, 'frames': 300, 'duration_s': 10.0, 'external': {
        'ended_early': 'TAKEN_OVER: by the pilot'}})
    assert told == 'the flight ended after 10.0 s: TAKEN_OVER: by the pilot'


@pytest.mark.parametrize(('states', 'ended'), [
    (['READY: waiting for offboard mode', 'ACTIVE'], ''),
    (['ACTIVE', 'NO_AUTOPILOT: lost, ACTIVE before'], ''),
    (['ACTIVE', 'NO_AUTOPILOT: lost, ACTIVE before', 'INACTIVE: it has rebooted'],
     'INACTIVE: it has rebooted'),
    (['INACTIVE: offboard was not requested', 'ACTIVE', 'READY: giving back: land requested',
      'INACTIVE: given back (land requested)'], 'READY: giving back: land requested')])
def test_why_the_bridge_ended_the_flight_is_what_it_said_first(states, ended):
    said = '[WARN] [17.5] [mavlink_bridge]: autopilot: state: unknown\n'
    assert ended_by_bridge(said.join(
        f'[INFO] [17.4] [mavlink_bridge]: state: {state}\n' for state in states)) == ended


def test_a_scenario_shorter_than_the_duration_asked_for_is_told(tmp_path, monkeypatch, capsys):
    flown = []

    def fly_no_more(*arguments):
        flown.append(arguments[3])
        raise RuntimeError('enough')
    monkeypatch.setattr('flock_desk.fly.fly', fly_no_more)
    for duration in ('120', '20'):
        main(['--scenario', 'indoor', '--duration', duration, '--output', str(tmp_path)])
    assert flown == [60.0, 20.0]
    assert capsys.readouterr().out.count(
        'indoor lasts 60 s: it is flown for so long, not for --duration = 120 s\n') == 1


def test_an_outage_asks_for_hold_in_time_and_for_following_again():
    lost, key = [Outage('vio', 3.0, 2.0)], 'outages.vio_at_3_s'
    states = [(0.0, 'TRACK'), (3.2, 'HOLD'), (5.3, 'TRACK')]
    figures, faults = judged(synthetic(states=states, outages=lost))
    assert not faults[f'{key}.hold_after_s'] and not faults[f'{key}.track_after_s']
    assert figures[f'{key}.track_after_s'] == pytest.approx(0.3)
    assert faults[f'{key}.reasons']
    _, faults = judged(synthetic(states=[(0.0, 'TRACK'), (3.5, 'HOLD')], outages=lost))
    assert faults[f'{key}.hold_after_s'] and faults[f'{key}.track_after_s']


def test_time_that_a_process_used_before_the_flight_does_not_count():
    usage = Usage({'a': 5.0, 'b': 1.0}, 100.0)
    usage = usage.until({'a': 6.0, 'b': 2.0, 'late': 9.0}, 105.0).until({'a': 8.0}, 110.0)
    assert usage.cores() == {'a': pytest.approx(0.3), 'b': pytest.approx(0.1)}


def test_a_flight_that_never_began_is_told(tmp_path):
    np.savez(tmp_path / 'flight.npz', began=np.nan)
    with pytest.raises(RuntimeError, match='never began'):
        read(load('indoor'), tmp_path)


def test_a_processes_time_is_read_from_proc():
    me = SimpleNamespace(children={'me': SimpleNamespace(pid=os.getpid())})
    before = processes_cpu(me)
    deadline = time.process_time() + 0.05
    while time.process_time() < deadline:
        pass
    used = processes_cpu(me)['me'] - before['me']
    assert 0.02 <= used <= 1.0
