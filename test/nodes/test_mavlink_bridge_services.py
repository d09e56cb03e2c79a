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

"""The bridge node flown by its services against both autopilots, and its odometry forwarded."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
import itertools
import os
from pathlib import Path
import signal
import subprocess
import sys
import termios
import time
import tty
from typing import Any

from bridge_rig import made_rigs, Rig, ROOT, start_autopilot
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.runs.processes import free_udp_port

pytestmark = pytest.mark.slow

GUIDED = 4  # of ArduCopter
LOITER = 5


def parameters(**values: Any) -> list[str]:
    return [word for name, value in values.items() for word in ('-p', f'{name}:={value}')]


MODES = {'px4': ('OFFBOARD', 'AUTO.LOITER', 'AUTO.LAND'),
         'arducopter': ('GUIDED', 'BRAKE', 'LAND')}


@pytest.fixture(scope='module')
def flights(ros: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Future[Path]]:
    """Fly both personalities at the same time, and return the logs of what really happened."""
    folder = tmp_path_factory.mktemp('flights')
    with made_rigs() as make, ThreadPoolExecutor(len(MODES)) as pool:
        return {personality: pool.submit(
            fly, make(*parameters(velocity_source='autopilot')), personality,
            folder / f'{personality}.npz') for personality in MODES}


def fly(rig: Rig, personality: str, log: Path) -> Path:
    """Fly from the ground and back by the services, 30 s of it by commands."""
    offboard, hold, land = MODES[personality]
    autopilot = start_autopilot(rig, '--personality', personality, '--start', 'landed',
                                '--log', str(log))
    rig.wait(lambda: rig.values.get('link') == 'alive', velocity=None)
    for service, value in (('arm', True), ('takeoff', None), ('offboard', True)):
        answer = rig.call(f'mavlink_bridge/{service}', value, velocity=None)
        assert answer.success, answer.message
    assert offboard in answer.message
    # A climb that the planner would close: at 2.5 m nothing wants to go further up.
    rig.run(30.0, (0.4, 0.0, 0.0), velocity=None)
    for service, value, mode in (('offboard', False, hold), ('land', None, land)):
        answer = rig.call(f'mavlink_bridge/{service}', value, velocity=None)
        assert answer.success and mode in answer.message
    rig.wait(lambda: rig.values.get('armed') == 'False', velocity=None)
    autopilot.send_signal(signal.SIGINT)
    assert autopilot.wait(timeout=5.0) == 0
    return log


@pytest.mark.parametrize('personality', MODES)
def test_the_services_fly_from_the_ground_and_back(
        flights: dict[str, Future[Path]], personality: str) -> None:
    with np.load(flights[personality].result()) as flight:
        position, velocity, mode = (
            flight[name] for name in ('position', 'velocity', 'mode'))
    speed = np.linalg.norm(velocity[:, :2], axis=1)
    assert 2.0 < position[:, 2].max() < 3.2
    assert 0.4 < speed.max() < 0.6
    obeyed = mode == MODES[personality][0]
    # East at the limit of speed for half a minute.
    assert 12.0 < np.ptp(position[obeyed, 0]) < 18.0
    assert ' '.join(MODES[personality]) in ' '.join(name for name, _ in itertools.groupby(mode))


def test_a_pilot_who_switches_away_ends_the_stream_and_is_told_how_to_go_on(make_rig):
    rig = make_rig()
    rig.permit()
    rig.wait(rig.commanded, (0.3, 0.0, 0.0))
    rig.custom_mode = 3 << 16  # POSCTL
    rig.wait(lambda: 'offboard was left for POSCTL' in rig.status.message, (0.3, 0.0, 0.0))
    assert rig.status.level == DiagnosticStatus.WARN
    assert rig.values['state'] == 'TAKEN_OVER: offboard was left for POSCTL'
    rig.custom_mode = 6 << 16
    start = time.monotonic()
    rig.run(1.5, (0.3, 0.0, 0.0))
    assert not rig.setpoints(start)
    assert 'the pilot took over' in rig.call('mavlink_bridge/offboard', True).message
    rig.run(9.0, (0.3, 0.0, 0.0))
    rig.permit()
    rig.wait(lambda: rig.setpoints(start) and rig.commanded(), (0.3, 0.0, 0.0))


def test_ardupilot_is_told_by_its_heartbeat_and_flown_in_guided(make_rig):
    rig = make_rig()
    rig.firmware, rig.custom_mode = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, GUIDED
    rig.permit()
    rig.wait(rig.commanded, (0.3, 0.0, 0.1))
    assert rig.setpoints()[-1].type_mask == 0x83F
    rig.wait(lambda: rig.values.get('autopilot') == 'ArduPilot', (0.3, 0.0, 0.0))
    assert rig.values['mode'] == 'GUIDED'


def test_a_firmware_that_is_not_the_one_insisted_on_is_not_flown(make_rig):
    rig = make_rig(*parameters(autopilot='px4'))
    rig.firmware = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    rig.wait(lambda: "heard ARDUPILOTMEGA QUADROTOR, which autopilot = 'px4' does not speak"
             in rig.status.message)
    assert not rig.setpoints()


def test_odometry_is_forwarded_in_the_frames_of_px4_with_our_clock(make_rig):
    rig = make_rig(*parameters(forward_odometry='true'))

    def forwarded() -> list[Any]:
        return [m for _, m in rig.received if m.get_type() == 'ODOMETRY']
    rig.wait(lambda: len(forwarded()) > 5, velocity=(0.2, 0.0, 0.0))
    start = time.monotonic()

    def gaps() -> Any:
        return np.diff([m.time_usec * 1e-6 for t, m in rig.received
                        if t > start and m.get_type() == 'ODOMETRY'])
    # On a busy machine, too, there is a half second in which nobody is held up.
    rig.wait(lambda: len(gaps()) > 60 and (
        np.convolve(gaps(), np.full(10, 0.1), 'valid').min() < 1 / 20.0),
        velocity=(0.2, 0.0, 0.0))
    # As many as 30 Hz allow, and the three that an irregular source can add.
    assert len(gaps()) <= 31.0 * gaps().sum() + 3.0
    last = forwarded()[-1]
    assert (last.frame_id, last.child_frame_id) == (
        mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
    assert (last.x, last.y, last.z) == (0.0, 0.0, -2.0)
    assert (last.vx, last.vy, last.vz) == pytest.approx((0.2, 0.0, 0.0))
    # It is stamped with the clock that answers TIMESYNC: here, that of this machine.
    arrived = next(t for t, m in reversed(rig.received) if m is last)
    assert 0.0 <= arrived - last.time_usec * 1e-6 < 0.5
    rig.send(mavlink.MAVLink_timesync_message(0, 4711))
    rig.wait(lambda: any(m.get_type() == 'TIMESYNC' and m.ts1 == 4711 for _, m in rig.received))
    answer = next(m for _, m in rig.received if m.get_type() == 'TIMESYNC' and m.ts1 == 4711)
    assert abs(answer.tc1 * 1e-9 - time.monotonic()) < 1.0
    rig.wait(lambda: int(rig.values.get('odometry: sent', 0)) > 0)
    rig.wait(lambda: 'forward_odometry: none sent for' in rig.status.message, velocity=None)
    rig.wait(lambda: int(rig.values.get('odometry: gaps over 100 ms', 0)) >= 1)


@pytest.mark.parametrize('personality', ['px4', 'arducopter'])
def test_parameters_that_differ_are_told_with_the_reason_and_never_written(make_rig, personality):
    rig = make_rig()
    autopilot = start_autopilot(rig, '--personality', personality, recommended=False)
    count = 10 if personality == 'px4' else 9
    differing = 6 if personality == 'px4' else 4
    rig.wait(lambda: rig.values.get('parameters') == f'{differing} of {count} differ, '
                                                     '0 unanswered')
    rig.run(1.1)
    rig.process.send_signal(signal.SIGINT)
    output = rig.process.communicate(timeout=5.0)[0]
    autopilot.kill()
    line = ('COM_OF_LOSS_T = 1, recommended 0.5: PX4 keeps the last acceleration'
            if personality == 'px4' else
            'GUID_TIMEOUT = 3, recommended 0.5: ArduPilot keeps the last acceleration')
    assert output.count(f'parameter {line}') == 1


def test_a_serial_device_that_is_pulled_is_told_and_the_node_lives_on(make_rig):
    main, replica = os.openpty()
    rig = make_rig(*parameters(connection=f'{os.ttyname(replica)},115200'))
    codec = mavlink.MAVLink(None, 1, 1)

    def beat() -> bool:
        os.write(main, mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 129, 6 << 16, 4,
            3).pack(codec))
        return rig.values.get('link') == 'alive' and 'line_out_percent' in rig.values
    rig.wait(beat)
    os.close(replica)
    os.close(main)
    rig.wait(lambda: 'no autopilot on /dev/pts/' in rig.status.message)
    rig.process.send_signal(signal.SIGINT)
    output = rig.process.communicate(timeout=5.0)[0]
    assert 'trying again until it is back' in output and rig.process.returncode == 0


def test_a_serial_device_absent_at_the_start_is_waited_for(make_rig):
    main, replica = os.openpty()
    device = Path(f'/dev/shm/ttyTEST{os.getpid()}')
    rig = make_rig(*parameters(connection=f'{device},57600'))
    try:
        rig.wait(lambda: f'no autopilot on {device},57600: No such file or directory'
                 in rig.status.message)
        assert rig.status.level == DiagnosticStatus.ERROR
        device.symlink_to(os.ttyname(replica))
        rig.send = lambda message: os.write(main, message.pack(rig.codec))
        rig.wait(lambda: rig.values.get('link') == 'alive')
    finally:
        device.unlink(missing_ok=True)
    rig.process.send_signal(signal.SIGINT)
    output = rig.process.communicate(timeout=5.0)[0]
    assert f'{device},57600: No such file or directory; trying again until' in output
    assert f'{device},57600: open' in output and rig.process.returncode == 0
    os.close(replica)
    os.close(main)


def test_a_line_that_takes_nothing_is_told_though_the_autopilot_is_heard(make_rig):
    main, replica = os.openpty()
    tty.setraw(main)
    rig = make_rig(*parameters(
        connection=f'{os.ttyname(replica)},115200', require_failsafe='false'))
    rig.send = lambda message: os.write(main, message.pack(rig.codec))
    rig.permit()
    rig.wait(lambda: rig.values.get('setpoint') == 'command', (0.3, 0.0, 0.0))
    termios.tcflow(replica, termios.TCOOFF)  # as flow control would stop it
    rig.wait(lambda: 'no setpoint has left for' in rig.status.message, (0.3, 0.0, 0.0))
    assert rig.status.level == DiagnosticStatus.ERROR
    assert rig.values['link'] == 'alive' and rig.values['setpoint'] == 'command'
    os.close(replica)
    os.close(main)


def test_the_estimate_of_the_autopilot_is_not_fed_back_to_it():
    process = subprocess.run(
        [sys.executable, '-m', 'flock_follower.nodes.mavlink_bridge', '--ros-args',
         '-p', 'forward_odometry:=true', '-p', f'connection:=udpin:127.0.0.1:{free_udp_port()}',
         '-r', 'odom:=mavlink/odom'],
        capture_output=True, text=True, timeout=20.0, cwd=ROOT)
    assert process.returncode == 1
    assert process.stderr.startswith('error: forward_odometry = true: odom is the estimate of')


@pytest.mark.parametrize('place', ['[91.0, 8.5, 488.0]', '[47.4, 181.0, 488.0]', '[47.4, 8.5]'])
def test_an_origin_that_is_nowhere_is_refused(place):
    process = subprocess.run(
        [sys.executable, '-m', 'flock_follower.nodes.mavlink_bridge', '--ros-args',
         '-p', f'connection:=udpin:127.0.0.1:{free_udp_port()}',
         '-p', f'global_origin:={place}'], capture_output=True, text=True, timeout=20.0, cwd=ROOT)
    assert process.returncode == 1 and process.stderr.startswith('error: global_origin = [')


def test_a_bridge_that_starts_sends_nothing_to_a_vehicle_in_offboard_until_it_is_asked(make_rig):
    rig = make_rig()
    arguments = rig.process.args[1:]
    for _ in range(2):  # as it starts, and as it starts again in flight
        rig.states.clear()
        start = time.monotonic()
        rig.wait(lambda: 'the service mavlink_bridge/offboard asks for offboard'
                 in rig.status.message, (0.3, 0.0, 0.0))
        rig.wait(lambda: rig.states.count('INACTIVE: offboard was not requested') >= 4,
                 (0.3, 0.0, 0.0))
        assert not rig.setpoints(start) and 'ACTIVE' not in rig.states
        rig.permit()
        rig.wait(rig.commanded, (0.3, 0.0, 0.0))
        rig.process.kill()
        rig.process.wait()
        rig.status = DiagnosticStatus()
        rig.received.clear()
        rig.process = rig.start(*arguments)


def test_the_state_is_told_as_it_changes_and_twice_per_second(make_rig):
    rig = make_rig()
    rig.flies = False  # until the first state was heard: only the last one is latched
    rig.wait(lambda: rig.states)
    assert rig.states[0].startswith('NO_AUTOPILOT: ')
    rig.flies = True
    rig.permit()
    changes = [state for state, _ in itertools.groupby(rig.states)]
    asked = changes.index('READY: waiting for offboard mode')
    assert changes[asked - 1] == 'INACTIVE: offboard was not requested'
    assert all(state.startswith('READY: ') for state in changes[asked:-1])
    before, start = len(rig.states), time.monotonic()
    rig.wait(lambda: len(rig.states) >= before + 6)
    assert time.monotonic() - start > 2.0 and set(rig.states[before:]) == {'ACTIVE'}
    rig.flies = False
    rig.wait(lambda: rig.states[-1] == 'NO_AUTOPILOT: lost, ACTIVE before')
