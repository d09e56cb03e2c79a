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

"""`make fly AUTOPILOT=...`: on an autopilot that runs already, played by the embedded one."""

import json
import math
from pathlib import Path
import socket
import subprocess
import sys
import threading
import time

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.fly import main
from flock_desk.runs import desk_flight
from flock_desk.runs.desk_flight import elsewhere, External, parameters_of_nodes
from flock_desk.runs.processes import free_udp_port
from flock_desk.scenarios.scenario_file import load
from flock_desk.vehicles.equipment import GROUND_AMSL

AUTOPILOT = str(Path(__file__).parents[1] / 'faulty_autopilot.py')


@pytest.fixture
def running():
    """Start embedded autopilots, and end them."""
    started = []

    def start(*arguments):
        started.append(subprocess.Popen(
            [sys.executable, AUTOPILOT, *arguments],
            start_new_session=True))
        return started[-1]
    yield start
    for child in started:
        child.kill()
        child.wait()


class HoveringLeader:
    """The truth of a second PX4: it hovers, facing ``yaw`` (deg, ENU), ahead of the first."""

    def __init__(self, port, yaw, distance, height):
        c, s = (f(math.radians(yaw)) for f in (math.cos, math.sin))
        half = 0.5 * math.radians(90.0 - yaw)
        self._messages = [
            mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 3, 3),
            mavlink.MAVLink_hil_state_quaternion_message(
                0, [math.cos(half), 0, 0, math.sin(half)], 0, 0, 0,
                round((47.397742 + distance * s / 111_320.0) * 1e7),
                round((8.545594 + distance * c / (
                    111_320.0 * math.cos(math.radians(47.397742)))) * 1e7),
                round((GROUND_AMSL + height) * 1e3), *[0] * 8)]
        self._port, self._ended = port, threading.Event()
        self._thread = threading.Thread(target=self._tell)

    def _tell(self):
        codec = mavlink.MAVLink(None, srcSystem=2, srcComponent=1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            while not self._ended.wait(0.02):
                for message in self._messages:
                    line.sendto(message.pack(codec), ('127.0.0.1', self._port))

    def __enter__(self):
        self._thread.start()

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()


@pytest.mark.slow
@pytest.mark.ros
def test_the_leader_of_a_flight_is_where_a_second_autopilot_says(running, tmp_path):
    port, truth, leader = (free_udp_port() for _ in range(3))
    running('--start', 'landed', '--yaw', '60', '--connect', f'127.0.0.1:{port}',
            '--truth', f'127.0.0.1:{truth}', '--param', 'COM_OF_LOSS_T=0.5')
    with HoveringLeader(leader, 60.0, 1.6, 2.5):
        main(['--scenario', 'fast_leader', '--duration', '4', '--output', str(tmp_path),
              '--autopilot', f'udp:127.0.0.1:{port}', '--truth', f'udpin:127.0.0.1:{truth}',
              '--leader-truth', f'udp:127.0.0.1:{leader}'])
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert summary['external']['leader_from'] == 'HIL_STATE_QUATERNION'
    assert summary['leader_speed_max_m_s'] == 0.0 and not summary['leader_faster_than_v_max']
    assert summary['frames'] * summary['recall'] > 20 and summary['failed_processes'] == 0
    assert summary['distance_rms_m'] < 0.02  # as the camera saw it
    flown = np.load(tmp_path / 'flight.npz')
    place = 1.6 * np.array([0.5, math.sqrt(0.75)])
    assert flown['leader_position'][:, :2] == pytest.approx(
        np.tile(place, (len(flown['leader_position']), 1)), abs=0.02)
    assert flown['leader_position'][:, 2] == pytest.approx(2.5, abs=0.01)
    assert summary['true_distance_m']['min'] > 1.0 and summary['true_distance_m']['max'] < 2.83
    assert (tmp_path / 'report.html').stat().st_size > 100_000


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.parametrize('forward', [pytest.param(False, marks=pytest.mark.sweep), True])
def test_a_flight_from_the_ground_and_back_by_an_autopilot_that_runs_already(
        forward, running, tmp_path):
    port, truth, log = free_udp_port(), free_udp_port(), tmp_path / 'vehicle.npz'
    autopilot = running(
        '--start', 'landed', '--yaw', '60', '--connect', f'127.0.0.1:{port}',
        '--truth', f'127.0.0.1:{truth}', '--log', str(log), '--param', 'COM_OF_LOSS_T=0.5',
        *(['--param', 'EKF2_EV_CTRL=15', '--param', 'EKF2_GPS_CTRL=0'] if forward else []))
    out = tmp_path / 'out'
    main(['--scenario', 'hover', '--duration', '4', '--output', str(out),
          '--autopilot', f'udp:127.0.0.1:{port}', '--truth', f'udpin:127.0.0.1:{truth}',
          *(['--forward-odometry'] if forward else [])])
    # Whatever else this machine is doing: it followed safely, and the report is there.
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['duration_s'] == pytest.approx(4.0, abs=0.05)
    assert summary['true_distance_m']['min'] > 1.0 and summary['true_distance_m']['max'] < 2.83
    assert summary['speed_max_m_s'] <= 0.55 and summary['altitude_off_m'] < 0.3
    assert summary['external']['pose_from'] == 'HIL_STATE_QUATERNION'
    assert summary['external']['leader_from'] is None
    assert summary['external']['pace'] == pytest.approx(1.0, abs=0.2)
    assert summary['frames'] * summary['recall'] > 20 and summary['failed_processes'] == 0
    assert (out / 'report.html').stat().st_size > 100_000
    told = np.load(out / 'flight.npz')
    assert autopilot.poll() is None  # it is the user's: it runs on
    autopilot.terminate()
    autopilot.wait(10.0)
    # What was told is what the vehicle did, from the ground and back to it.
    flown = np.load(log)
    for axis in range(3):
        there = np.interp(told['state_time'], flown['state_time'], flown['position'][:, axis])
        assert np.abs(there - told['position'][:, axis]).max() < 0.15
    assert flown['position'][:, 2].max() > 2.0 and flown['position'][-1, 2] < 0.05
    assert not flown['armed'][-1]
    if forward:
        assert len(flown['odometry_time']) > 100


@pytest.mark.slow
@pytest.mark.ros
def test_a_flight_that_is_taken_from_the_bridge_ends_soon_with_the_reason_and_a_report(
        running, tmp_path, capfd):
    port, truth = free_udp_port(), free_udp_port()
    # Setpoints begin while offboard is asked for; the scenario 1.5 s later.
    switch = {'kind': 'pilot', 'at': 8.0, 'after': 'setpoint', 'mode': 'POSCTL'}
    running('--start', 'landed', '--connect', f'127.0.0.1:{port}', '--truth',
            f'127.0.0.1:{truth}', '--param', 'COM_OF_LOSS_T=0.5', '--fault', json.dumps(switch))
    out, began = tmp_path / 'out', time.monotonic()
    assert main(['--scenario', 'hover', '--output', str(out),
                 '--autopilot', f'udp:127.0.0.1:{port}',
                 '--truth', f'udpin:127.0.0.1:{truth}']) == 1
    assert time.monotonic() - began < 60.0  # as long as the scenario alone
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['duration_s'] < 10.0 and summary['failed_processes'] == 0
    why = summary['external']['ended_early']
    assert why.startswith('TAKEN_OVER: ')
    told = capfd.readouterr()
    assert f'the bridge has ended the flight: {why}' in told.out
    assert f'warning: the flight ended after {summary["duration_s"]:.1f} s: {why}' in told.err
    assert 'FAILED: duration_s' in told.err
    assert why in (out / 'report.html').read_text()


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.parametrize(('arguments', 'said'), [
    (['--deny-arming', 'compass not calibrated'], 'mavlink_bridge/arm: arm refused: '),
    pytest.param(None, 'the simulator ended early', marks=pytest.mark.sweep)])
def test_what_keeps_it_on_the_ground_is_told_and_nothing_is_left_running(
        arguments, said, running, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(desk_flight, 'READY_TIMEOUT', 15.0)
    port, truth = free_udp_port(), free_udp_port()
    if arguments is not None:
        running('--start', 'landed', '--connect', f'127.0.0.1:{port}',
                '--truth', f'127.0.0.1:{truth}', *arguments)
    else:
        monkeypatch.setattr(desk_flight, 'READY_TIMEOUT', 60.0)
    started = []
    begin = desk_flight.Processes.start
    monkeypatch.setattr(desk_flight.Processes, 'start', lambda self, *words, **options: (
        started.append(begin(self, *words, **options)) or started[-1]))
    assert main(['--scenario', 'hover', '--output', str(tmp_path),
                 '--autopilot', f'udp:127.0.0.1:{port}',
                 '--truth', f'udpin:127.0.0.1:{truth}']) == 1
    errors = capfd.readouterr().err
    assert said in errors and 'Traceback' not in errors
    if arguments is None:
        assert f"truth_connection = 'udpin:127.0.0.1:{truth}': no pose of a vehicle" in errors
    assert len(started) >= 5 and all(child.poll() is not None for child in started)


@pytest.mark.parametrize(('autopilot', 'truth', 'links'), [
    ('udp:127.0.0.1:14988', '', ('udpin:127.0.0.1:14988', 'udpin:127.0.0.1:19410')),
    ('udpin:127.0.0.1:14988', 'udp:127.0.0.1:14989',
     ('udpin:127.0.0.1:14988', 'udpin:127.0.0.1:14989')),
    ('tcp:127.0.0.1:5760', '', ('tcp:127.0.0.1:5760', 'tcp:127.0.0.1:5762')),
    ('tcp:127.0.0.1:5760', 'tcp:127.0.0.1:5763', ('tcp:127.0.0.1:5760', 'tcp:127.0.0.1:5763'))])
def test_the_truth_comes_from_where_each_simulator_tells_it(autopilot, truth, links):
    assert elsewhere(autopilot, truth, False)[:2] == links


@pytest.mark.parametrize(('arguments', 'said'), [
    (['--autopilot', '127.0.0.1:14540'], "connection = '127.0.0.1:14540': must be udpin:"),
    (['--autopilot', 'tcp:127.0.0.1:5760', '--truth', 'tcp:127.0.0.1'], 'must be udpin:'),
    (['--autopilot', 'tcp:127.0.0.1:5760', '--leader-truth', '5772'],
     "connection = '5772': must be udpin:")])
def test_a_url_that_is_none_is_told_before_anything_starts(arguments, said, tmp_path, capsys):
    assert main([*arguments, '--output', str(tmp_path / 'out')]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_a_port_that_another_program_has_is_told_before_anything_starts(tmp_path, capsys):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('127.0.0.1', 0))
        url = f'udpin:127.0.0.1:{other.getsockname()[1]}'
        assert main(['--autopilot', url, '--output', str(tmp_path / 'out')]) == 1
    assert f'{url!r}: cannot listen there: Address already in use' in capsys.readouterr().err


def test_two_links_on_one_port_are_told_before_anything_starts(tmp_path, capsys):
    url = f'udp:127.0.0.1:{free_udp_port()}'
    assert main(['--autopilot', 'tcp:127.0.0.1:5760', '--truth', url, '--leader-truth', url,
                 '--output', str(tmp_path / 'out')]) == 1
    assert 'cannot listen there: Address already in use' in capsys.readouterr().err


@pytest.mark.parametrize('arguments', [['--truth', 'tcp:127.0.0.1:5762'], ['--forward-odometry'],
                                       ['--leader-truth', 'udp:127.0.0.1:19411']])
def test_what_only_an_autopilot_elsewhere_has_needs_one(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert 'only with --autopilot' in capsys.readouterr().err


def test_an_estimate_is_refused_exactly_where_odometry_is_forwarded(tmp_path):
    for forward in (False, True):
        links = External('tcp:127.0.0.1:5760', 'tcp:127.0.0.1:5762', forward)
        nodes = parameters_of_nodes(load('hover'), 'hover', 0, 4.0, tmp_path, links)
        told = str(forward).lower()
        assert f'forward_odometry:={told}' in nodes['mavlink_bridge']
        assert f'require_truth:={told}' in nodes['simulator']
        assert not any(value.startswith('leader') for value in nodes['simulator'])
        nodes = parameters_of_nodes(load('hover'), 'hover', 0, 4.0, tmp_path,
                                    links._replace(leader_truth='tcp:127.0.0.1:5772'))
        assert 'leader_truth_connection:=tcp:127.0.0.1:5772' in nodes['simulator']
    embedded = parameters_of_nodes(load('hover'), 'hover', 0, 4.0, tmp_path, None)
    assert not any('external' in value for value in embedded['simulator'])
