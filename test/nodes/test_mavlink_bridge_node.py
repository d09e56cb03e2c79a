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

"""The bridge node as a real process: topics in, and what pymavlink decodes on the wire."""

from __future__ import annotations

from collections.abc import Iterator
import itertools
import math
import signal
import subprocess
import sys
import time

from bridge_rig import COMMAND, Rig, ROOT, start_autopilot
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.runs.processes import free_udp_port
from flock_follower.messages import stamp_to_nanoseconds, to_array

pytestmark = pytest.mark.slow
PLANNER = """
import sys, time
sys.path.insert(0, 'test')
import rclpy
from bridge_rig import COMMAND, make_command
rclpy.init()
node = rclpy.create_node('planner', namespace=sys.argv[1])
publisher = node.create_publisher(COMMAND, 'command/trajectory', 1)
while True:
    publisher.publish(make_command(node.get_clock().now().nanoseconds, (0.3, 0.0, 0.0)))
    time.sleep(0.1)
"""


@pytest.fixture(scope='module')
def one_rig(ros: None) -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()


@pytest.fixture
def shared(one_rig: Rig) -> Rig:
    """Return the rig, ACTIVE: between two tests it was handed over, for want of commands."""
    one_rig.yaw = 0.0
    one_rig.wait(lambda: one_rig.values.get('link') == 'alive')
    for _ in range(5):  # hold, which it does not obey, may be under way
        if one_rig.call('mavlink_bridge/offboard', True).success:
            break
        one_rig.run(1.0)
    one_rig.wait(lambda: one_rig.states[-1:] == ['ACTIVE'])
    return one_rig


@pytest.mark.parametrize(('acceleration', 'yaw', 'north', 'east', 'down', 'heading'), [
    ((0.3, 0.0, 0.0), 0.0, 0.0, 0.3, 0.0, math.pi / 2),
    # No climb: a vehicle that does not obey it looks like one with a wrong hover thrust.
    ((0.0, 0.3, 0.0), math.pi / 2, 0.3, 0.0, 0.0, 0.0)], ids=['east', 'north'])
def test_enu_commands_leave_in_ned(shared, acceleration, yaw, north, east, down, heading):
    shared.yaw = yaw
    last = shared.wait_for_setpoint(*acceleration, acceleration, yaw=yaw)
    assert (last.type_mask, last.coordinate_frame) == (0x83F, mavlink.MAV_FRAME_LOCAL_NED)
    assert (last.target_system, last.get_srcComponent()) == (1, 191)
    assert [last.afx, last.afy, last.afz] == pytest.approx([north, east, down], abs=1e-6)
    assert last.yaw == pytest.approx(heading, abs=1e-6)


def test_commands_at_ten_hertz_are_sent_at_once_in_a_stream_without_gaps(shared):
    shared.yaw = 0.0
    shared.wait(shared.commanded, (0.3, 0.0, 0.0))
    start = time.monotonic()
    shared.run(4.0, (0.3, 0.0, 0.0))
    times = [t for t, m in shared.received
             if t >= start and m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED']
    # Percentiles: where the whole machine stands still, cycles are left out, not made up for.
    # A new command is sent at once and begins a new period, but never within 20 ms.
    gaps = np.diff(times)
    assert np.percentile(gaps, 75) <= 0.056 and np.percentile(gaps, 5) >= 0.015
    assert sum(t >= start and m.get_type() == 'HEARTBEAT' for t, m in shared.received) in (3, 4, 5)
    shared.wait(lambda: 'latency_p99_ms' in shared.values, (0.3, 0.0, 0.0))
    values = shared.values
    assert 0.0 < float(values['tick_latency_p50_ms']) < 40.0
    assert values['setpoint'] == 'command' and values['mode'] == 'OFFBOARD'
    shared.wait(lambda: 19.5 <= float(shared.values['stream_hz']) <= 30.5)


@pytest.mark.parametrize(('acceleration', 'options', 'reason'), [
    ((math.nan, 0.0, 0.0), {}, 'command not finite'),
    ((0.3, math.inf, 0.0), {}, 'command not finite'),
    ((0.3, 0.0, 0.0), {'age': 0.5}, 'command too old'),
    ((0.3, 0.0, 0.0), {'age': -0.5}, 'command from the future'),
    ((0.3, 0.0, 0.0), {'frame': 'map'}, 'invalid command/trajectory'),
    ((0.3, 0.0), {}, 'invalid command/trajectory')],
    ids=['NaN', 'inf', 'stale', 'future', 'frame', 'empty'])
def test_commands_that_must_not_fly_are_counted_and_the_vehicle_brakes(
        shared, acceleration, options, reason):
    velocity = (0.3, 0.0, 0.0)
    shared.wait(shared.commanded, (0.3, 0.0, 0.0), velocity=velocity)
    before = int(shared.values.get(f'rejected: {reason}', 0))
    if len(acceleration) == 2:
        def rejected() -> bool:
            shared.commands.publish(COMMAND())
            return int(shared.values.get(f'rejected: {reason}', 0)) > before
        shared.wait(rejected, velocity=velocity)
        acceleration = None
    else:
        shared.wait(lambda: int(shared.values.get(f'rejected: {reason}', 0)) > before,
                    acceleration, velocity=velocity, **options)
    shared.wait_for_setpoint(-1.0, 0.0, 0.0, acceleration, velocity=velocity, **options)
    braking = time.monotonic()
    shared.run(0.4, acceleration, velocity=velocity, **options)
    assert all(m.afx == 0.0 and -1.0 - 1e-6 <= m.afy <= 0.0 for m in shared.setpoints(braking))
    assert all(math.isfinite(v) for m in shared.setpoints() for v in (m.afx, m.afy, m.afz, m.yaw))


def test_the_tick_of_a_command_counts_not_the_age_of_its_image(shared):
    shared.wait(lambda: not shared.commanded())
    shared.wait(shared.commanded, (0.3, 0.0, 0.0), age=0.4, offset=400_000_000)


def test_acceleration_and_speed_are_limited_and_the_limits_can_change_in_flight(shared):
    shared.wait_for_setpoint(0.5 / 0.3, 0.0, 0.0, (9.0, 0.0, 0.0))
    refused = shared.set_parameter('a_max', -1.0)
    assert not refused.successful
    assert 'a_max = -1.0: must be a number in [0.01, 20]' in refused.reason
    assert shared.set_parameter('a_max', 0.8).successful
    shared.wait_for_setpoint(0.8, 0.0, 0.0, (9.0, 0.0, 0.0))
    raised = shared.set_parameter('a_max', 2.5)
    assert not raised.successful and 'in flight it can only be lowered' in raised.reason


def test_the_estimate_of_the_autopilot_is_published_in_enu_and_flu(shared):
    shared.yaw = math.pi / 2  # facing north
    shared.velocity_ned = (0.4, 0.1, -0.2)
    shared.wait(lambda: shared.batteries and shared.odometry
                and shared.odometry[-1].twist.twist.linear.x > 0.3)
    odom, battery = shared.odometry[-1], shared.batteries[-1]
    shared.velocity_ned, shared.yaw = (0.0, 0.0, 0.0), 0.0
    assert (odom.header.frame_id, odom.child_frame_id) == ('odom', 'base_link')
    np.testing.assert_allclose(to_array(odom.pose.pose.position), [2, 1, 3])
    assert odom.pose.pose.orientation.z == pytest.approx(math.sqrt(0.5), abs=1e-6)
    # Forward is north, left is west, up is up.
    np.testing.assert_allclose(to_array(odom.twist.twist.linear), [0.4, -0.1, 0.2], atol=1e-6)
    assert odom.twist.twist.angular.z == pytest.approx(-0.1)
    assert battery.voltage == pytest.approx(15.2)
    assert (battery.current, battery.percentage) == (pytest.approx(-18.5), pytest.approx(0.81))


def test_the_estimate_of_the_autopilot_is_stamped_when_it_was_valid(make_rig):
    rig, late = make_rig(), 0.06  # s that the autopilot takes to send an estimate
    rig.flies = False
    stamps: list[tuple[float, int]] = []
    rig.node.create_subscription(Odometry, 'mavlink/odom', lambda odom: stamps.append(
        (rig.node.get_clock().now().nanoseconds * 1e-9, stamp_to_nanoseconds(odom.header.stamp))),
        10)
    answered = 0

    def flown() -> bool:
        nonlocal answered
        if rig._is_due('heartbeat', 1.0):
            rig.send(mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_QUADROTOR, rig.firmware, 129, rig.custom_mode, 4, 3))
        for _, message in rig.received[answered:]:
            if message.get_type() == 'TIMESYNC' and not message.tc1:
                rig.send(mavlink.MAVLink_timesync_message(time.monotonic_ns(), message.ts1))
        answered = len(rig.received)
        if rig._is_due('position', 0.02):
            valid = round((time.monotonic() - late) * 1e3)
            rig.send(mavlink.MAVLink_attitude_quaternion_message(valid, 1.0, *[0.0] * 6))
            rig.send(mavlink.MAVLink_local_position_ned_message(valid, *[0.0] * 6))
        # How late they come is known from the second answer to TIMESYNC on.
        return len(stamps) > 200
    rig.wait(flown, velocity=None)
    ages = [heard - stamp * 1e-9 for heard, stamp in stamps]
    assert all(age >= 0.0 for age in ages)
    assert all(earlier < later for (_, earlier), (_, later) in itertools.pairwise(stamps))
    assert late - 0.002 <= np.median(ages[-50:]) < late + 0.03


def test_frames_that_do_not_fit_are_told_and_offboard_is_refused(make_rig):
    rig = make_rig()
    rig.yaw = math.pi / 2
    rig.custom_mode = 4 << 16 | 3 << 24
    rig.wait(lambda: 'commands would go the wrong way' in rig.status.message)
    answer = rig.call('mavlink_bridge/offboard', True)
    assert not answer.success and 'differ by -90 deg' in answer.message


def test_commands_from_another_clock_are_explained(shared):
    shared.wait(lambda: 'does use_sim_time differ' in shared.status.message,
                (0.3, 0.0, 0.0), age=7200.0)
    assert shared.status.level == DiagnosticStatus.ERROR


def test_two_planners_at_once_are_told(shared):
    second = shared.node.create_publisher(COMMAND, 'command/trajectory', 1)
    shared.wait(lambda: '2 publishers command on' in shared.status.message)
    shared.node.destroy_publisher(second)


def test_an_autopilot_without_an_estimate_is_told(make_rig):
    rig = make_rig()
    rig._due['position'] = math.inf
    rig.wait(lambda: 'sends no LOCAL_POSITION_NED and no ATTITUDE_QUATERNION'
             in rig.status.message)
    # It is alive none the less: HEARTBEATs at 1 Hz are enough.
    assert rig.values['link'] == 'alive'


def test_killing_the_planner_brakes_within_300_ms(make_rig):
    rig = make_rig()
    rig.permit()
    planner = rig.start('-c', PLANNER, f'/{rig.namespace}')
    velocity = (0.2, 0.0, 0.0)
    rig.wait(rig.hears_odometry, velocity=velocity)
    rig.wait(lambda: rig.setpoints() and rig.setpoints()[-1].afy > 0.2, velocity=velocity)
    rig.run(1.0, velocity=velocity)
    rig.wait(lambda: rig.setpoints()[-1].afy > 0.2, velocity=velocity)
    killed = time.monotonic()
    planner.kill()
    rig.wait(lambda: rig.setpoints()[-1].afy < 0.0, velocity=velocity)
    braking = next(t for t, m in rig.received if t > killed
                   and m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED' and m.afy < 0.0)
    assert braking - killed < 0.3
    rig.wait_for_setpoint(-0.2 / 0.3, 0.0, 0.0, velocity=velocity)
    rig.wait(lambda: 'braked: command stale' in rig.values, velocity=velocity)


def test_lost_odometry_brakes_on_the_velocity_of_the_autopilot(make_rig):
    rig = make_rig()
    rig.permit()
    rig.velocity_ned = (0.0, 0.3, 0.0)
    rig.wait(rig.hears_odometry, velocity=(0.2, 0.0, 0.0))
    rig.wait(rig.commanded, (0.3, 0.0, 0.0), velocity=(0.2, 0.0, 0.0))
    rig.wait_for_setpoint(-1.0, 0.0, 0.0, (0.3, 0.0, 0.0), velocity=None)


def test_a_silent_or_wrong_autopilot_is_explained(make_rig):
    rig = make_rig()
    rig.flies = False
    rig.wait(lambda: rig.status.name)
    start = time.monotonic()
    expected = f'no autopilot on {rig.url}: nothing arrives'
    rig.wait(lambda: expected in rig.status.message)
    assert time.monotonic() - start < 5.0
    assert rig.status.level == DiagnosticStatus.ERROR
    rig.codec.srcSystem = 7
    rig.flies = True
    rig.wait(lambda: 'heard system id 7, not target_system 1' in rig.status.message)
    assert rig.setpoints() == []
    rig.process.send_signal(signal.SIGINT)
    assert expected in rig.process.communicate(timeout=5.0)[0]


def test_an_autopilot_that_is_lost_and_comes_back_is_told(make_rig):
    rig = make_rig()
    rig.wait(lambda: rig.values.get('link') == 'alive')
    rig.flies = False
    rig.wait(lambda: f'autopilot lost on {rig.url}' in rig.status.message)
    rig.flies = True
    rig.wait(lambda: rig.values.get('link') == 'alive')
    rig.run(1.2)
    rig.process.send_signal(signal.SIGINT)
    assert rig.process.communicate(timeout=5.0)[0].count(f'HEARTBEAT received on {rig.url}') == 2


def test_the_words_of_the_autopilot_are_logged_once_and_whole(make_rig):
    rig = make_rig()
    rig.wait(lambda: rig.values.get('link') == 'alive')
    words = 'Preflight Fail: ' + 'heading estimate not stable, ' * 2 + 'wait'
    for chunk in range(0, len(words), 50):
        rig.send(mavlink.MAVLink_statustext_message(
            mavlink.MAV_SEVERITY_WARNING, words[chunk:chunk + 50].encode(), 7, chunk // 50))
    rig.send(mavlink.MAVLink_statustext_message(
        mavlink.MAV_SEVERITY_INFO, b'Takeoff detected\t', 0, 0))
    rig.send(mavlink.MAVLink_statustext_message(  # its end never comes
        mavlink.MAV_SEVERITY_INFO, b'c' * 50, 8, 0))
    rig.run(1.0)
    rig.process.send_signal(signal.SIGINT)
    output = rig.process.communicate(timeout=5.0)[0]
    lines = [line.split('autopilot: ')[1] for line in output.splitlines() if 'autopilot: ' in line]
    assert lines[1:] == [words, 'Takeoff detected', 'c' * 50 + '...']  # after its mode


@pytest.mark.parametrize('interrupts', [1, 2])
def test_offboard_takes_over_a_hovering_vehicle_and_ctrl_c_leaves_it_in_hold(
        make_rig, tmp_path, interrupts):
    log = tmp_path / 'flight.npz'
    rig = make_rig()
    autopilot = start_autopilot(rig, '--log', str(log))
    # By its own velocity: odometry that contradicts it would silence the bridge.
    rig.wait(lambda: rig.values.get('mode') == 'AUTO.LOITER', velocity=None)
    answer = rig.call('mavlink_bridge/offboard', True, velocity=None)
    assert answer.success and 'HEARTBEAT shows OFFBOARD' in answer.message
    rig.wait(lambda: rig.states[-1:] == ['ACTIVE'], velocity=None)
    rig.run(2.5, (1.0, 0.0, 0.0), velocity=None)
    start = time.monotonic()
    rig.process.send_signal(signal.SIGINT)
    if interrupts == 2:  # while it brakes
        rig.run(0.3)
        rig.process.send_signal(signal.SIGINT)
    output = rig.process.communicate(timeout=5.0)[0]
    assert time.monotonic() - start < 2.0
    assert rig.process.returncode == 0 and 'Traceback' not in output
    rig.run(2.0)
    autopilot.send_signal(signal.SIGINT)
    assert autopilot.wait(timeout=5.0) == 0
    with np.load(log) as flight:
        east = flight['velocity'][:, 0]
        assert east.max() > 0.4 and abs(east[-1]) < 0.1
        assert flight['mode'][-1] == 'AUTO.LOITER' and 'AUTO.LAND' not in flight['mode']
        assert not flight['setpoint_acceleration'][-1].any()
        # The stream did not pause while the services waited for HEARTBEAT.
        assert np.diff(flight['setpoint_time']).max() < 0.25


def test_refusals_come_with_their_cause(make_rig):
    rig = make_rig()
    start_autopilot(rig, '--start', 'landed', '--deny-arming', 'Compass not calibrated')
    rig.wait(lambda: rig.values.get('link') == 'alive')
    answer = rig.call('mavlink_bridge/arm', True)
    assert (answer.success, answer.message) == (
        False,
        'arm refused: temporarily rejected: arm authorization denied')
    answer = rig.call('mavlink_bridge/offboard', True)
    assert not answer.success and 'on the ground: arm, call takeoff' in answer.message
    assert rig.call('mavlink_bridge/offboard', False).success


def test_without_an_autopilot_the_services_say_so(make_rig):
    rig = make_rig()
    rig.flies = False
    answer = rig.call('mavlink_bridge/arm', True)
    assert (answer.success, answer.message) == (
        False, 'arm: no HEARTBEAT from the autopilot')


@pytest.mark.parametrize(('parameter', 'line'), [
    ('connection:=udp:nowhere', "error: connection = 'udp:nowhere': must be udpin:HOST:PORT, "),
    ('signing_key_file:=/nowhere', "error: signing_key_file = '/nowhere': No such file"),
    ('a_max:=-1.0', 'error: a_max = -1.0: must be a number in [0.01, 20] m/s^2'),
    ('autopilot:=betaflight',
     "error: autopilot = 'betaflight': must be one of auto, px4, ardupilot"),
    ('velocity_sorce:=odom', 'error: unknown parameter velocity_sorce for node mavlink_bridge: '
                             'did you mean velocity_source?')])
def test_a_bad_parameter_is_one_line_and_exit_code_one(parameter, line):
    process = subprocess.run(
        [sys.executable, '-m', 'flock_follower.nodes.mavlink_bridge', '--ros-args',
         '-p', f'connection:=udpin:127.0.0.1:{free_udp_port()}', '-p', parameter],
        capture_output=True, text=True, timeout=20.0, cwd=ROOT)
    assert process.returncode == 1
    assert process.stderr.startswith(line) and process.stderr.count('\n') == 1


def test_a_link_that_stalls_is_told_with_its_longest_gap(make_rig):
    rig = make_rig()
    rig.wait(lambda: float(rig.values.get('LOCAL_POSITION_NED_hz', 0)) > 20.0)
    # Once what was asked for has had its time to come, each stall is told.
    def told() -> bool:
        rig.flies = False
        rig.run(0.6)
        rig.flies = True
        rig.run(1.5)
        return 'nothing came from the autopilot for ' in rig.status.message
    deadline = time.monotonic() + 30.0
    while not told():
        assert time.monotonic() < deadline, rig.status.message
    assert float(rig.values['longest_pause_s']) >= 0.6
    rig.wait(lambda: 'nothing came' not in rig.status.message)
