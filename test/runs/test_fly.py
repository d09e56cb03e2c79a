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


"""`make fly`: figures and bounds of a flight, requests to the nodes, refusals before it begins."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flock_desk.fly import cautions, column_figures, main, scenario_bounds
from flock_desk.runs.flight import (
    ended_by_bridge,
    External,
    fly,
    links,
    namespaces,
    own,
    parameters_of_nodes,
    spacing,
    start_view,
    usual_truth,
)
from flock_desk.runs.judge import flat, judge
from flock_desk.runs.processes import free_udp_port, LateError, Processes
from flock_desk.runs.record import LiveFlight, read_flown
from flock_desk.runs.summary import scenario_figures
from flock_desk.runs.yardstick import REFERENCE, Yardstick
from flock_desk.scenarios.scenario import Outage, Scenario
from flock_desk.scenarios.scenario_file import load
from flock_follower.checks.processor import Load

COUNT = 300  # images
TIMES = np.arange(COUNT) / 30  # s


def synthetic(distance=2.0, speed=0.3, missing=(), states=((0.0, 'TRACK'),), outages=(),
              usable=None, leader_speed=0.0, warning='', heights=(0.0, 0.0), external=None,
              along=1.0, estimate_ms=90.0):
    """
    Return 10 s of a flight at one distance; images ``missing`` have no estimate.

    :param heights: of leader and follower, m, numbers or (300,).
    :param external: what the log of a flight by an external autopilot holds otherwise.
    :param along: share of commands along the law.
    """
    ahead = np.tile([1.0, 0.0, 0.0], (COUNT, 1))
    table = {column: np.zeros(COUNT) for column in ('nees_position', 'nees_velocity', 'turned')}
    table |= {column: np.zeros((COUNT, 3)) for column in ('position', 'velocity',
                                                          'velocity_sigma')}
    table |= {'time': TIMES, 'distance': np.full(COUNT, distance),
              'true_distance': np.full(COUNT, distance),
              'visible': np.ones(COUNT) if usable is None else usable.astype(float)}
    table['distance'][list(missing)] = np.nan
    scenario = Scenario('test', 'for a test', outages=tuple(outages))
    values = [SimpleNamespace(key='warnings', value=warning)]
    late = [SimpleNamespace(key='stamp_to_estimate_p50_ms', value=estimate_ms)]
    status = SimpleNamespace(status=[SimpleNamespace(name='planner', values=values, level=0),
                                     SimpleNamespace(name='relative_pose', values=late, level=0)])
    leader, follower = (np.outer(np.broadcast_to(height, COUNT), [0.0, 0.0, 1.0])
                        for height in heights)
    elsewhere = {} if external is None else {
        'pose_source': 'HIL_STATE_QUATERNION', 'clock': np.array([[0.0, 0.0], [10.0, 10.0]])}
    return LiveFlight(
        duration=10.0, params=scenario.flight.planner(True), table=table,
        paths={'leader': leader, 'follower': follower},
        speeds={'follower': (TIMES, np.full(COUNT, speed)),
                'leader': (TIMES, np.broadcast_to(leader_speed, COUNT))},
        distance=np.full(COUNT, distance), setpoint_times=TIMES, setpoints=0.1 * ahead,
        along_law=np.arange(100) < 100 * along,
        states=list(states), diagnostics=[(1.0, status)], scenario=scenario, log={
            'skipped_images': 0, 'pose_source': '', 'pose_source_of_leader': '',
            'duration': 10.0, 'ended_early': '', **elsewhere, **(external or {})})


def judged(flight, cores={'planner': 0.1}, speed=1.0):  # noqa: B006
    """Return the figures, and what is wrong with them, each by key."""
    summary = scenario_figures(flight, cores, {'planner': 0}, speed=speed)
    faults = {j.bound.key: j.fault for j in judge(scenario_bounds(flight, summary), summary)}
    return dict(flat(summary)), faults


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
    for unknown in ({'cores': {}}, {'speed': None}):
        assert 'not measured' in judged(synthetic(), **unknown)[1]['cpu_cores.at_reference']
    assert scenario_figures(synthetic(), {}, {})['cpu_speed'] is None


@pytest.mark.parametrize(('cores', 'speed', 'ok'), [
    (1.4, 1.0, True), (1.6, 1.0, False), (1.6, 0.5, True), (3.1, 0.5, False), (1.4, 1.1, False)])
def test_processor_time_is_judged_at_one_speed(cores, speed, ok):
    """1.6 cores failed good flights on a machine of half the speed."""
    figures, faults = judged(synthetic(), {'planner': cores}, speed)
    assert figures['cpu_cores.total'] == cores and figures['cpu_speed'] == speed
    assert bool(faults['cpu_cores.at_reference']) is not ok


def test_the_yardstick_is_the_speed_without_programs_beside():
    yardstick = Yardstick()
    assert yardstick.speed is None
    for now in (0.0, 0.5, 1.0):
        yardstick.sample(now)
    assert len(yardstick.times) == 2 and min(yardstick.times) > 0.0
    yardstick.times = [2.0 * REFERENCE] * 5 + [9.0 * REFERENCE] * 5
    assert yardstick.speed == pytest.approx(0.5)


def test_commands_against_law_and_late_camera_fail_when_busy():
    flight = synthetic(along=0.04, estimate_ms=391.0, speed=0.3)
    summary = scenario_figures(flight, {'planner': 0.1}, {'planner': 0}, Load(0.5, 1.5, 2))
    verdicts = {j.bound.key: j.verdict for j in judge(scenario_bounds(flight, summary), summary,
                                                      busy=True)}
    assert verdicts['planner.along_law_share'] == 'FAILED'
    assert verdicts['latency_ms.estimate_p50'] == 'FAILED'
    assert summary['machine'] == {'waited_share': 0.5, 'others': 1.5}


@pytest.mark.parametrize(('speed', 'verdict'), [(0.5, 'ok'), (2.9, 'not judged'), (3.1, 'FAILED')])
def test_late_setpoints_explain_speed_of_1_s_acceleration(speed, verdict):
    flight = synthetic(speed=speed)
    summary = scenario_figures(flight, {'planner': 0.1}, {'planner': 0})
    (found,) = (j for j in judge(scenario_bounds(flight, summary), summary, busy=True)
                if j.bound.key == 'speed_max_m_s')
    assert found.verdict == verdict


@pytest.mark.parametrize(('seconds', 'outrun'), [(0.9, False), (1.3, True)])
def test_outrun_follower_warns_instead_of_keeping_band(seconds, outrun):
    since = TIMES - 1.0
    speeds = np.where((since >= 0.0) & (since < seconds), 0.8, 0.3)  # a gust is shorter
    figures, faults = judged(synthetic(3.0, leader_speed=speeds))
    assert figures['leader_speed_max_m_s'] == 0.8
    assert figures['leader_faster_than_v_max'] == outrun
    assert ('time_in_band_share' in faults) == (not outrun)
    if outrun:
        assert faults['planner.warnings']
        figures, faults = judged(synthetic(leader_speed=speeds, warning='cannot keep up'))
        assert figures['planner.warning'] == 'cannot keep up' and not faults['planner.warnings']


def test_gaps_count_only_while_the_leader_can_be_seen():
    assert judged(synthetic())[0]['longest_gap_in_view_s'] == 0.0
    figures, faults = judged(synthetic(missing=range(60, 90)))
    assert figures['longest_gap_in_view_s'] == pytest.approx(1.0)
    assert figures['recall'] == pytest.approx(0.9) and faults['longest_gap_in_view_s']
    usable = (np.arange(COUNT) < 60) | (np.arange(COUNT) >= 80)
    figures, faults = judged(synthetic(missing=range(60, 90), usable=usable))
    assert figures['longest_gap_in_view_s'] == pytest.approx(1.0 / 3.0)
    assert not faults['longest_gap_in_view_s']


CLIMB = np.linspace(2.5, 4.5, COUNT)
HIDDEN = (TIMES < 3.0) | (TIMES >= 5.0)  # hidden from 3 to 5 s
AWAY = np.where((TIMES >= 3.0) & (TIMES < 7.8), 1.0, 0.0)


@pytest.mark.parametrize(('heights', 'usable', 'leader_from', 'off'), [
    ((CLIMB, CLIMB - 0.18), None, '', 0.18), ((CLIMB, 2.5), None, '', 2.0),
    # Not judged while the leader is hidden and shortly after.
    ((AWAY, 0.0), HIDDEN, '', 0.0),
    ((AWAY + np.where((TIMES >= 7.9) & (TIMES < 8.2), 0.4, 0.0), 0.0), HIDDEN, '', 0.4),
    # Only a leader flown elsewhere may begin at another height.
    ((np.where(TIMES < 2.0, 0.5, 0.0), 0.0), None, '', 0.5),
    ((np.where(TIMES < 2.0, 0.5, 0.0), 0.0), None, 'HIL_STATE_QUATERNION', 0.0)])
def test_the_height_is_judged_against_that_of_a_leader_in_view(heights, usable, leader_from, off):
    figures, faults = judged(synthetic(heights=heights, usable=usable, external={
        'pose_source_of_leader': leader_from}))
    assert figures['altitude_off_m'] == pytest.approx(off)
    assert bool(faults['altitude_off_m']) == (off > 0.3)


def test_a_flight_that_the_bridge_ended_fails_with_its_reason():
    figures, faults = judged(synthetic(external={}))
    assert figures['external.ended_early'] is None and not faults['duration_s']
    flight = synthetic(external={'duration': 60.0, 'ended_early': 'TAKEN_OVER: by the pilot'})
    figures, faults = judged(flight)
    assert figures['external.ended_early'] == 'TAKEN_OVER: by the pilot'
    assert faults['duration_s'] == 'duration_s = 10: must be at least 59.9'
    (warning,) = cautions(scenario_figures(flight, {}, {}))
    assert warning == 'the flight ended after 10.0 s: TAKEN_OVER: by the pilot'


def test_an_outage_demands_hold_in_time_and_following_again():
    lost, key = [Outage('vio', 3.0, 2.0)], 'outages.vio_at_3_s'
    states = [(0.0, 'TRACK'), (3.2, 'HOLD'), (5.3, 'TRACK')]
    figures, faults = judged(synthetic(states=states, outages=lost))
    assert not faults[f'{key}.hold_after_s'] and not faults[f'{key}.track_after_s']
    assert figures[f'{key}.track_after_s'] == pytest.approx(0.3)
    assert faults[f'{key}.reasons']
    _, faults = judged(synthetic(states=[(0.0, 'TRACK'), (3.5, 'HOLD')], outages=lost))
    assert faults[f'{key}.hold_after_s'] and faults[f'{key}.track_after_s']


def test_a_machine_that_did_not_keep_up_is_a_warning():
    assert cautions({'skipped_images': 4, 'frames': 1796, 'external': None}) == []
    (warning,) = cautions({'skipped_images': 283, 'frames': 917, 'external': None})
    assert warning == '24 % of the images were not rendered in time'


def record(began, position, leader=(0.0, 0.0, 0.0)):
    """Return what the column's figures need of a flight of a second at 50 Hz."""
    stamps = (np.linspace(began, began + 1.0, 31) * 1e9).astype(np.int64)
    return SimpleNamespace(
        speeds={'follower': (np.linspace(0.0, 1.0, 51), np.zeros(51))}, log={
            'began': began, 'ended': began + 1.0, 'position': np.tile(position, (51, 1)),
            'start': 0.0, 'epoch_ns': 0, 'image_stamp': stamps,
            'leader_position': np.tile(leader, (31, 1))})


def test_column_distances_are_between_positions_in_one_frame():
    scenario = load('straight')  # they begin 1.5 m apart
    assert spacing(scenario) == 1.5
    summary = column_figures(scenario, {
        'follower_1': record(5.0, (0.0, 0.0, 1.5), (1.5, 0.0, 1.5)),
        'follower_2': record(5.2, (0.7, 0.0, 1.5))})
    assert summary['pairs'] == pytest.approx({
        'leader to follower_1': 1.5, 'leader to follower_2': 2.3,
        'follower_1 to follower_2': 0.8}, abs=1e-6)
    assert summary['nearest_m'] == pytest.approx(0.8)


class Pretended(Processes):
    """What was started and requested, without processes."""

    refusal = ''
    bridge_says = ''

    def __init__(self, environment, log_folder):
        super().__init__(environment, log_folder)
        self.started, self.asked = {}, []
        Pretended.last = self

    def start(self, name, module, arguments=(), *, show=False, ends=False):
        self.started[name] = (module, list(arguments), show)
        codes = iter([None] * 4 + [0] * 99)  # it ends after a while
        (self.log_folder / f'{name}.log').write_text(
            self.bridge_says if name == 'mavlink_bridge' else '')
        self.children[name] = SimpleNamespace(pid=0, returncode=0, poll=lambda: (
            next(codes) if name.endswith('simulator') else None))

    def ask(self, service, *_, **__):
        self.asked.append(service)
        if service.endswith('takeoff'):
            self.children['takeoff'] = SimpleNamespace(pid=0, returncode=0, poll=lambda: 0)
        if self.refusal and service == 'mavlink_bridge/arm':
            raise RuntimeError(self.refusal)
        return 'yes'

    def stop_all(self, timeout=2.0):
        codes = dict.fromkeys(self.children, 0)
        self.children.clear()
        return codes


@pytest.fixture
def pretended(monkeypatch):
    monkeypatch.setattr('flock_desk.runs.flight.Processes', Pretended)
    return monkeypatch


def test_each_follower_has_own_nodes_and_leads_the_next(
        tmp_path, pretended):
    exit_codes = fly(load('straight'), 'straight', 7, 1.0, tmp_path, followers=2).exit_codes
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
    assert namespaces(1) == [''] and own({'follower_1/planner': 1, 'follower_2/planner': 2},
                                         'follower_2') == {'planner': 2}


def test_failed_flight_ends_with_reason_and_no_process_left(tmp_path, pretended):
    pretended.setattr(Pretended, 'refusal', 'arm refused: compass')
    with pytest.raises(RuntimeError, match='^arm refused: compass$'):
        fly(load('hover'), 'hover', 0, 1.0, tmp_path)
    assert Pretended.last.children == {}


@pytest.mark.parametrize(('busy', 'judged', 'code'), [(True, 0, 3), (True, 1, 1), (False, 0, 1)])
def test_a_flight_that_is_too_late_is_judged_by_what_was_flown(
        tmp_path, pretended, busy, judged, code):
    pretended.setattr('flock_desk.runs.flight.PATIENCE', -1.0)
    pretended.setattr('flock_desk.runs.flight.COUNTER_PERIOD', 0.0)
    load = SimpleNamespace(busy=busy)
    pretended.setattr(Pretended, 'load', property(
        lambda _: SimpleNamespace(worst=lambda *_: load, sample=lambda _: None),
        lambda *_: None), raising=False)
    pretended.setattr('flock_desk.fly.conclude', lambda *_: judged)
    assert main(['--scenario', 'hover', '--duration', '0.1', '--output', str(tmp_path)]) == code


def test_on_an_external_autopilot_it_takes_off_and_lands(tmp_path, pretended):
    pretended.setattr('flock_desk.runs.flight.MARGIN', -0.5)
    fly(load('hover'), 'hover', 0, 0.6, tmp_path, External('tcp:a:1', 'tcp:a:3', True))
    assert Pretended.last.asked == [
        'mavlink_bridge/arm', 'mavlink_bridge/takeoff', 'mavlink_bridge/offboard',
        'planner/engage', 'planner/engage', 'mavlink_bridge/offboard', 'mavlink_bridge/land']


def test_flight_taken_from_bridge_ends_with_reason_and_lands(
        tmp_path, pretended, capsys):
    pretended.setattr(Pretended, 'bridge_says', ''.join(
        f'[INFO] [17.4] [mavlink_bridge]: state: {state}\n'
        for state in ('ACTIVE', 'TAKEN_OVER: the pilot took over')))
    fly(load('hover'), 'hover', 0, 60.0, tmp_path, External('tcp:a:1', 'tcp:a:3', True))
    assert Pretended.last.asked == [
        'mavlink_bridge/arm', 'mavlink_bridge/takeoff', 'mavlink_bridge/offboard',
        'planner/engage', 'mavlink_bridge/land']
    assert ('the bridge has ended the flight: TAKEN_OVER: the pilot took over\n'
            in capsys.readouterr().out)


@pytest.mark.parametrize(('states', 'ended'), [
    (['READY: waiting for offboard mode', 'ACTIVE'], ''),
    (['ACTIVE', 'NO_AUTOPILOT: lost, ACTIVE before'], ''),
    (['ACTIVE', 'NO_AUTOPILOT: lost, ACTIVE before', 'INACTIVE: it has rebooted'],
     'INACTIVE: it has rebooted'),
    (['INACTIVE: offboard was not requested', 'ACTIVE', 'READY: giving back: land requested',
      'INACTIVE: given back (land requested)'], 'READY: giving back: land requested')])
def test_bridge_ends_flight_with_first_state_after_active(states, ended):
    between = '[WARN] [17.5] [mavlink_bridge]: autopilot: state: unknown\n'
    assert ended_by_bridge(between.join(
        f'[INFO] [17.4] [mavlink_bridge]: state: {state}\n' for state in states)) == ended


@pytest.mark.parametrize(('autopilot', 'expected'), [
    ('udp:127.0.0.1:14988', 'udpin:127.0.0.1:19410'),
    ('tcp:127.0.0.1:5760', 'tcp:127.0.0.1:5762')])
def test_the_truth_comes_on_the_usual_link_of_each_simulator(autopilot, expected):
    assert usual_truth(autopilot) == expected


def test_no_two_links_have_one_port():
    autopilot, truth = (f'udpin:127.0.0.1:{free_udp_port()}' for _ in range(2))
    assert links(autopilot, truth, False)[:2] == (autopilot, truth)
    with pytest.raises(OSError, match='in use'):
        links(autopilot, autopilot, False)


def test_estimate_is_refused_as_truth_if_odometry_is_forwarded(tmp_path):
    for forward in (False, True):
        nodes = parameters_of_nodes(
            load('hover'), 'hover', 0, 4.0, tmp_path,
            External('tcp:127.0.0.1:5760', 'tcp:127.0.0.1:5762', forward, 'tcp:127.0.0.1:5772'))
        value = str(forward).lower()
        assert f'forward_odometry:={value}' in nodes['mavlink_bridge']
        assert {f'require_truth:={value}',
                'leader_truth_connection:=tcp:127.0.0.1:5772'} <= {*nodes['simulator']}
    embedded = parameters_of_nodes(load('hover'), 'hover', 0, 4.0, tmp_path, None)
    assert not any('external' in value for value in embedded['simulator'])


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--scenario', 'outdor'], "scenario = 'outdor': must be one of approach, "),
    (['--scenario', 'nowhere.yaml'], 'nowhere.yaml: cannot be read'),
    (['--scenario', 'handover'],
     "scenario = 'handover': its operations can be flown in lock step only: "
     'flights --scenario handover\n'),
    (['--autopilot', '127.0.0.1:14540'], "connection = '127.0.0.1:14540': must be udpin:"),
    (['--autopilot', 'tcp:127.0.0.1:5760', '--truth', 'tcp:127.0.0.1'], 'must be udpin:'),
    (['--autopilot', 'tcp:127.0.0.1:5760', '--leader-truth', '5772'],
     "connection = '5772': must be udpin:"),
    (['--autopilot', 'tcp:127.0.0.1:5760', '--truth', 'udp:127.0.0.1:14991', '--leader-truth',
      'udp:127.0.0.1:14991'], 'cannot listen there: Address already in use')])
def test_impossible_flight_is_refused_before_start(
        arguments, message, tmp_path, capsys):
    assert main([*arguments, '--output', str(tmp_path / 'out')]) == 1
    error = capsys.readouterr().err
    assert error.startswith('error: ') and error.count('\n') == 1 and message in error
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--seed', '-1'], '--seed: the value = -1: must be an integer in [0, 2147483647]'),
    (['--duration', '-3'], '--duration: the value = -3.0: must be a number in [0, 3600] s'),
    (['--followers', '0'], '--followers: the value = 0: must be an integer in [1, 8]'),
    (['--followers', '2', '--autopilot', 'udp:127.0.0.1:14540'], 'not with --autopilot'),
    (['--truth', 'tcp:127.0.0.1:5762'], 'only with --autopilot'),
    (['--forward-odometry'], 'only with --autopilot'),
    (['--leader-truth', 'udp:127.0.0.1:19411'], 'only with --autopilot')])
def test_options_that_do_not_fit_are_refused(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def test_scenario_shorter_than_duration_is_flown_to_its_end(
        tmp_path, monkeypatch, capsys):
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


def test_a_flight_without_a_record_is_late(tmp_path):
    with pytest.raises(LateError, match='before it had written'):
        read_flown(load('indoor'), Path(tmp_path))


def test_a_flight_that_never_began_is_an_error(tmp_path):
    np.savez(tmp_path / 'flight.npz', began=np.nan, ended=np.nan)
    with pytest.raises(RuntimeError, match='never began'):
        read_flown(load('indoor'), Path(tmp_path))


@pytest.mark.parametrize(('variable', 'starts'), [('no', False), ('yes', True), ('', True)])
def test_a_flight_starts_the_live_page_unless_view_is_no(monkeypatch, variable, starts):
    started = []

    class Group:
        def start(self, *arguments, **options):
            started.append((arguments, options))

    monkeypatch.setenv('VIEW', variable)
    start_view(Group(), 'one')
    arguments = ['--ros-args', '-r', '__ns:=/one']
    assert started == [(('view', 'flock_follower.nodes.view', arguments),
                        {'show': True, 'ends': True})][:starts]
