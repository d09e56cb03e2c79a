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


"""`make fly` through the real nodes: an embedded autopilot, and one that runs already."""

import base64
import json
from pathlib import Path
import re
import subprocess
import sys

import numpy as np
import pytest

from flock_desk.fly import main
from flock_desk.runs.flight import ended_by_bridge
from flock_desk.runs.processes import free_udp_port

pytestmark = [pytest.mark.slow, pytest.mark.ros]
AUTOPILOT = str(Path(__file__).parents[1] / 'faulty_autopilot.py')


def test_a_flight_is_safe_and_its_report_complete(tmp_path):
    main(['--scenario', 'hover', '--duration', '3', '--output', str(tmp_path)])
    summary = json.loads((tmp_path / 'summary.json').read_text())
    # Whatever else this machine is doing: nothing unsafe is sent or flown, and it follows.
    assert summary['duration_s'] == pytest.approx(3.0, abs=0.02)
    assert summary['time_in_band_share'] == 1.0
    assert summary['setpoints']['acceleration_max_m_s2'] <= 2.5
    assert summary['speed_max_m_s'] <= 0.55
    assert summary['setpoints']['sent'] > 40 and summary['frames'] * summary['recall'] > 20
    assert summary['position_rms_m'] < 0.05 and summary['failed_processes'] == 0
    assert {'simulator', 'planner'} <= set(summary['cpu_cores']) or not Path('/proc').exists()
    log = np.load(tmp_path / 'flight.npz')
    assert set(log['mode'][log['state_time'] >= log['began']]) == {'OFFBOARD'}
    for name in ('relative_pose', 'planner', 'mavlink_bridge', 'recorder'):
        assert 'Traceback' not in (tmp_path / f'{name}.log').read_text()
    page = (tmp_path / 'report.html').read_text()
    assert 'http' not in re.sub(r'base64,[^"]*', '', page)  # it needs nothing from elsewhere
    pictures = re.findall(r'data:image/(png|jpeg);base64,([^"]+)', page)
    assert [kind for kind, _ in pictures][:3] == ['png', 'png', 'jpeg']
    assert base64.b64decode(pictures[0][1])[:4] == b'\x89PNG'
    assert '<code>time_in_band_share</code>' in page
    assert (tmp_path / 'record' / 'metadata.yaml').exists()  # closed, not cut off


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


def test_a_flight_from_the_ground_and_back(running, tmp_path):
    port, truth = free_udp_port(), free_udp_port()
    log, out = tmp_path / 'vehicle.npz', tmp_path / 'out'
    autopilot = running(
        '--start', 'landed', '--yaw', '60', '--connect', f'127.0.0.1:{port}',
        '--truth', f'127.0.0.1:{truth}', '--log', str(log), '--param', 'COM_OF_LOSS_T=0.5',
        '--param', 'EKF2_EV_CTRL=15', '--param', 'EKF2_GPS_CTRL=0',
        # Sooner up and down than by default.
        '--param', 'MPC_TKO_RAMP_T=0.5', '--param', 'MPC_LAND_SPEED=1.4',
        '--param', 'COM_DISARM_LAND=0.5')
    main(['--scenario', 'hover', '--duration', '3', '--output', str(out),
          '--autopilot', f'udp:127.0.0.1:{port}', '--truth', f'udpin:127.0.0.1:{truth}',
          '--forward-odometry'])
    # Whatever else this machine is doing: it followed safely, and the report is there.
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['external']['pose_from'] == 'HIL_STATE_QUATERNION'
    assert summary['external']['pace'] == pytest.approx(1.0, abs=0.2)
    assert summary['duration_s'] == pytest.approx(3.0, abs=0.05)
    assert summary['true_distance_m']['min'] > 1.0 and summary['true_distance_m']['max'] < 2.83
    assert summary['distance_rms_m'] < 0.02 and summary['speed_max_m_s'] <= 0.55
    assert summary['frames'] * summary['recall'] > 20 and summary['failed_processes'] == 0
    assert (out / 'report.html').stat().st_size > 100_000
    # What the real bridge prints is understood: it was ACTIVE until offboard was left.
    assert ended_by_bridge((out / 'mavlink_bridge.log').read_text()).startswith('READY: ')
    assert autopilot.poll() is None  # it is the user's: it runs on
    autopilot.terminate()
    autopilot.wait(10.0)
    # The truth received is the vehicle's motion, from the ground and back to it.
    received, flown = np.load(out / 'flight.npz'), np.load(log)
    for axis in range(3):
        there = np.interp(received['state_time'], flown['state_time'], flown['position'][:, axis])
        assert np.abs(there - received['position'][:, axis]).max() < 0.15
    assert flown['position'][:, 2].max() > 2.0 and flown['position'][-1, 2] < 0.05
    assert not flown['armed'][-1] and len(flown['odometry_time']) > 100
