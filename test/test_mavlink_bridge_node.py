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

from collections.abc import Callable, Iterator
import itertools
import math
from pathlib import Path
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Transform, Twist
from nav_msgs.msg import Odometry
import numpy as np
from pymavlink.dialects.v20 import common as mavlink
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import BatteryState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from flock_follower.geometry import quaternion_enu_flu_to_ned_frd, quaternion_from_yaw
from flock_follower.messages import set_quaternion, set_vector, to_array
from flock_follower.nodes.conversions import nanoseconds_to_stamp, to_odometry
from flock_follower.tools.processes import free_udp_port

ROOT = Path(__file__).parents[1]
SO_TIMESTAMPNS = 35  # of Linux; the socket module does not name it
DEADLINE = 15.0  # s for anything awaited
PLANNER = """
import sys, time
sys.path.insert(0, 'test')
import rclpy
from test_mavlink_bridge_node import COMMAND, make_command
rclpy.init()
node = rclpy.create_node('planner', namespace=sys.argv[1])
publisher = node.create_publisher(COMMAND, 'command/trajectory', 1)
while True:
    publisher.publish(make_command(node.get_clock().now().nanoseconds, (0.3, 0.0, 0.0)))
    time.sleep(0.1)
"""
COMMAND = MultiDOFJointTrajectory
NUMBERS = itertools.count()


def make_command(stamp: int, acceleration: tuple[float, ...], yaw: float = 0.0,
                 frame: str = 'odom', offset: int = 0) -> MultiDOFJointTrajectory:
    message = MultiDOFJointTrajectory(joint_names=['base_link'])
    message.header.stamp, message.header.frame_id = nanoseconds_to_stamp(stamp), frame
    point = MultiDOFJointTrajectoryPoint(
        transforms=[Transform()], accelerations=[Twist()], velocities=[Twist()])
    set_quaternion(point.transforms[0].rotation, quaternion_from_yaw(yaw))
    set_vector(point.accelerations[0].linear, acceleration)
    point.time_from_start.nanosec = offset
    message.points = [point]
    return message


class Rig:
    """The node's process, its ROS surroundings, and an autopilot's end of the wire."""

    def __init__(self, *parameters: str) -> None:
        # A namespace of its own: several rigs may live side by side.
        self.namespace = f'rig{next(NUMBERS)}'
        self.wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.wire.bind(('127.0.0.1', 0))
        self.wire.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.address = ('127.0.0.1', free_udp_port())
        self.url = f'udpin:127.0.0.1:{self.address[1]}'
        self.codec = mavlink.MAVLink(None, 1, 1)
        self.node = Node('surroundings', namespace=self.namespace)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.commands = self.node.create_publisher(COMMAND, 'command/trajectory', 1)
        self.odom = self.node.create_publisher(Odometry, 'odom', 1)
        self.status = DiagnosticStatus()
        self.odometry: list[Odometry] = []
        self.batteries: list[BatteryState] = []
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._told, 10)
        self.node.create_subscription(Odometry, 'mavlink/odom', self.odometry.append, 10)
        self.node.create_subscription(
            BatteryState, 'mavlink/battery', self.batteries.append, 10)
        self.received: list[tuple[float, Any]] = []
        self.flies = True
        self.heartbeats = True
        self.custom_mode = 6 << 16
        self.velocity_ned = (0.0, 0.0, 0.0)
        self.yaw = 0.0
        self._due: dict[str, float] = {}
        self.processes: list[subprocess.Popen[str]] = []
        self.process = self.start('-m', 'flock_follower.nodes.mavlink_bridge', '--ros-args',
                                  '-r', f'__ns:=/{self.namespace}',
                                  '-p', f'connection:={self.url}', *parameters)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE,
                                   stderr=subprocess.STDOUT, text=True, cwd=ROOT)
        self.processes.append(process)
        return process

    def _told(self, message: DiagnosticArray) -> None:
        if message.status[0].name == f'{self.namespace}/mavlink_bridge':
            self.status = message.status[0]

    @property
    def values(self) -> dict[str, str]:
        return {v.key: v.value for v in self.status.values}

    def send(self, message: Any) -> None:
        self.wire.sendto(message.pack(self.codec), self.address)

    def _is_due(self, name: str, period: float) -> bool:
        now = time.monotonic()
        if now < self._due.get(name, 0.0):
            return False
        self._due[name] = now + period
        return True

    def _fly(self) -> None:
        if self.heartbeats and self._is_due('heartbeat', 1.0):
            self.send(mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 129, self.custom_mode,
                mavlink.MAV_STATE_ACTIVE, 3))
            self.send(mavlink.MAVLink_sys_status_message(
                0, 0, 0, 0, 15200, 1850, 81, 0, 0, 0, 0, 0, 0))
        if self._is_due('position', 0.02):
            x, y, z, w = quaternion_enu_flu_to_ned_frd(quaternion_from_yaw(self.yaw)).tolist()
            self.send(mavlink.MAVLink_attitude_quaternion_message(0, w, x, y, z, 0.0, 0.0, 0.1))
            self.send(mavlink.MAVLink_local_position_ned_message(
                0, 1.0, 2.0, -3.0, *self.velocity_ned))

    def run(self, seconds: float, acceleration: tuple[float, ...] | None = None, *,
            velocity: tuple[float, float, float] | None = (0.0, 0.0, 0.0), yaw: float = 0.0,
            until: Callable[[], object] = lambda: False, **options: Any) -> None:
        """Publish commands at 10 Hz and odometry of a body velocity at 50 Hz, and listen."""
        end = time.monotonic() + seconds
        age = round(options.pop('age', 0.0) * 1e9)
        while time.monotonic() < end and not until():
            if self.flies:
                self._fly()
            stamp = self.node.get_clock().now().nanoseconds
            if velocity is not None and self._is_due('odom', 0.02):
                self.odom.publish(to_odometry(
                    nanoseconds_to_stamp(stamp), 'odom', 'base_link', (0, 0, 2),
                    quaternion_from_yaw(yaw), velocity))
            if acceleration is not None and self._is_due('command', 0.1):
                self.commands.publish(make_command(stamp - age, acceleration, yaw, **options))
            self.executor.spin_once(timeout_sec=0.0)
            if select.select([self.wire], [], [], 0.002)[0]:
                data, ancillary, _, _ = self.wire.recvmsg(4096, 64)
                # When it reached this machine's socket, not when this loop came round to it.
                seconds, nanoseconds = struct.unpack('qq', ancillary[0][2])
                arrived = time.monotonic() - (time.time() - seconds - nanoseconds * 1e-9)
                for message in self.codec.parse_buffer(data) or []:
                    self.received.append((arrived, message))

    def wait(self, condition: Callable[[], object], *arguments: Any, **options: Any) -> None:
        self.run(DEADLINE, *arguments, **options,
                 until=lambda: condition() or self.process.poll() is not None)
        if not condition():
            self.process.terminate()
            pytest.fail(f'waited in vain; {self.status.message}; {self.values}; '
                        f'{self.process.communicate(timeout=5.0)[0]}')

    def setpoints(self, since: float = 0.0) -> list[Any]:
        return [m for t, m in self.received
                if t >= since and m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED']

    def hears_odometry(self) -> bool:
        # Until it has heard any, the node rightly judges by the velocity of the autopilot.
        return float(self.values.get('odom_hz', 0.0)) > 20.0

    def commanded(self) -> bool:
        last = self.setpoints()[-1:]
        return bool(last) and math.hypot(last[0].afx, last[0].afy) > 0.2

    def call(self, service: str, value: bool, **options: Any) -> SetBool.Response:
        client = self.node.create_client(SetBool, service)
        self.wait(client.service_is_ready, **options)
        future = client.call_async(SetBool.Request(data=value))
        self.wait(future.done, **options)
        return future.result()

    def set_parameter(self, name: str, value: float) -> Any:
        client = self.node.create_client(SetParameters, 'mavlink_bridge/set_parameters')
        self.wait(client.service_is_ready)
        future = client.call_async(SetParameters.Request(parameters=[Parameter(
            name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE,
                                            double_value=value))]))
        self.wait(future.done)
        return future.result().results[0]

    def close(self) -> None:
        for process in self.processes:
            if process.poll() is None:
                process.kill()
            process.communicate()
        self.executor.shutdown()
        self.node.destroy_node()
        self.wire.close()


@pytest.fixture(scope='module', autouse=True)
def ros() -> Iterator[None]:
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def make_rig() -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def make(*parameters: str) -> Rig:
        rigs.append(Rig(*parameters))
        return rigs[-1]
    yield make
    for rig in rigs:
        rig.close()


@pytest.fixture(scope='module')
def shared() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()


@pytest.mark.parametrize(('acceleration', 'yaw', 'north', 'east', 'down', 'heading'), [
    ((0.3, 0.0, 0.0), 0.0, 0.0, 0.3, 0.0, math.pi / 2),
    ((0.0, 0.3, 0.1), math.pi / 2, 0.3, 0.0, -0.1, 0.0)], ids=['east', 'north and up'])
def test_enu_commands_leave_in_ned(shared, acceleration, yaw, north, east, down, heading):
    shared.yaw = yaw
    shared.wait(shared.commanded, acceleration, yaw=yaw)
    shared.run(0.3, acceleration, yaw=yaw)
    last = shared.setpoints()[-1]
    assert (last.type_mask, last.coordinate_frame) == (0x83F, mavlink.MAV_FRAME_LOCAL_NED)
    assert (last.target_system, last.get_srcComponent()) == (1, 191)
    assert [last.afx, last.afy, last.afz] == pytest.approx([north, east, down], abs=1e-6)
    assert last.yaw == pytest.approx(heading, abs=1e-6)


def test_the_stream_keeps_its_rate_while_commands_come_at_ten_hertz(shared):
    shared.yaw = 0.0
    shared.wait(shared.commanded, (0.3, 0.0, 0.0))
    start = time.monotonic()
    shared.run(4.0, (0.3, 0.0, 0.0))
    times = [t for t, m in shared.received
             if t >= start and m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED']
    assert (len(times) - 1) / (times[-1] - times[0]) == pytest.approx(20.0, abs=0.5)
    assert sum(t >= start and m.get_type() == 'HEARTBEAT' for t, m in shared.received) in (3, 4, 5)
    shared.wait(lambda: 'latency_p99_ms' in shared.values, (0.3, 0.0, 0.0))
    values = shared.values
    assert 0.0 < float(values['tick_latency_p50_ms']) < 200.0
    assert values['setpoint'] == 'command' and values['mode'] == 'OFFBOARD'
    assert float(values['stream_hz']) == pytest.approx(20.0, abs=0.5)


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
    before = int(shared.values.get(f'rejected: {reason}', 0))
    velocity = (0.3, 0.0, 0.0)
    start = time.monotonic()
    if len(acceleration) == 2:
        def publish() -> bool:
            shared.commands.publish(COMMAND())
            return int(shared.values.get(f'rejected: {reason}', 0)) > before
        shared.wait(publish, velocity=velocity)
    else:
        shared.wait(lambda: int(shared.values.get(f'rejected: {reason}', 0)) > before,
                    acceleration, velocity=velocity, **options)
    shared.run(max(0.0, start + 0.4 - time.monotonic()), acceleration[:3] if len(
        acceleration) == 3 else None, velocity=velocity, **options)
    shared.run(0.2, velocity=velocity)
    last = shared.setpoints()[-1]
    assert [last.afx, last.afy] == pytest.approx([0.0, -1.0], abs=1e-6)
    assert all(math.isfinite(v) for m in shared.setpoints() for v in (m.afx, m.afy, m.afz, m.yaw))


def test_the_tick_of_a_command_counts_not_the_age_of_its_image(shared):
    shared.wait(lambda: not shared.commanded())
    shared.wait(shared.commanded, (0.3, 0.0, 0.0), age=0.4, offset=400_000_000)


def test_acceleration_and_speed_are_limited_and_the_limits_can_change_in_flight(shared):
    shared.run(0.5, (9.0, 0.0, 0.0))
    assert shared.setpoints()[-1].afy == pytest.approx(0.5 / 0.3, abs=1e-6)
    refused = shared.set_parameter('a_max', -1.0)
    assert not refused.successful
    assert 'a_max = -1.0: must be a number in [0.01, 20]' in refused.reason
    assert shared.set_parameter('a_max', 0.8).successful
    shared.run(0.5, (9.0, 0.0, 0.0))
    assert shared.setpoints()[-1].afy == pytest.approx(0.8, abs=1e-6)
    assert shared.set_parameter('a_max', 2.5).successful


def test_the_estimate_of_the_autopilot_is_published_in_enu_and_flu(shared):
    shared.yaw = math.pi / 2  # facing north
    shared.velocity_ned = (0.4, 0.1, -0.2)
    shared.run(0.5)
    shared.odometry.clear()
    shared.wait(lambda: shared.odometry and shared.batteries)
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


def test_frames_that_do_not_fit_are_told_and_offboard_is_refused(shared):
    shared.yaw = math.pi / 2
    shared.custom_mode = 4 << 16 | 3 << 24
    shared.run(1.2)
    answer = shared.call('mavlink_bridge/offboard', True)
    assert not answer.success and 'differ by -90 deg' in answer.message
    shared.wait(lambda: 'commands would go the wrong way' in shared.status.message)
    shared.yaw, shared.custom_mode = 0.0, 6 << 16


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
    assert rig.setpoints()[-1].afy == pytest.approx(-0.2 / 0.3, abs=1e-6)
    rig.run(1.2, velocity=velocity)
    assert 'braked: command stale' in rig.values


def test_lost_odometry_brakes_on_the_velocity_of_the_autopilot(make_rig):
    rig = make_rig()
    rig.velocity_ned = (0.0, 0.3, 0.0)
    rig.wait(rig.hears_odometry, velocity=(0.2, 0.0, 0.0))
    rig.wait(rig.commanded, (0.3, 0.0, 0.0), velocity=(0.2, 0.0, 0.0))
    rig.wait(lambda: rig.setpoints()[-1].afy == pytest.approx(-1.0, abs=1e-6),
             (0.3, 0.0, 0.0), velocity=None)


def test_a_silent_or_wrong_autopilot_is_explained(make_rig):
    rig = make_rig()
    rig.flies = False
    start = time.monotonic()
    expected = f'no autopilot on {rig.url}: nothing arrives'
    rig.wait(lambda: expected in rig.status.message)
    assert time.monotonic() - start < 8.0  # with the start of the process
    assert rig.status.level == DiagnosticStatus.ERROR
    rig.codec.srcSystem = 7
    rig.flies = True
    rig.wait(lambda: 'heard system id 7, not target_system 1' in rig.status.message)
    assert rig.setpoints() == []
    rig.process.send_signal(signal.SIGINT)
    assert expected in rig.process.communicate(timeout=5.0)[0]


def test_a_lost_autopilot_is_told(make_rig):
    rig = make_rig()
    rig.wait(lambda: rig.values.get('link') == 'alive')
    rig.flies = False
    rig.wait(lambda: f'autopilot lost on {rig.url}' in rig.status.message)


def start_autopilot(rig: Rig, *arguments: str) -> subprocess.Popen[str]:
    rig.flies = False
    return rig.start('-m', 'flock_follower.simulation.autopilot', '--connect',
                     f'127.0.0.1:{rig.address[1]}', *arguments)


@pytest.mark.parametrize('interrupts', [1, 2])
def test_offboard_takes_over_a_hovering_vehicle_and_ctrl_c_leaves_it_in_hold(
        make_rig, tmp_path, interrupts):
    log = tmp_path / 'flight.npz'
    rig = make_rig()
    autopilot = start_autopilot(rig, '--log', str(log))
    rig.wait(lambda: rig.values.get('mode') == 'AUTO.LOITER')
    answer = rig.call('mavlink_bridge/offboard', True)
    assert answer.success and 'HEARTBEAT shows OFFBOARD' in answer.message
    rig.run(2.5, (1.0, 0.0, 0.0), velocity=(0.1, 0.0, 0.0))
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


def test_refusals_come_with_the_words_of_the_autopilot(make_rig):
    rig = make_rig()
    start_autopilot(rig, '--start', 'landed', '--deny-arming', 'Compass not calibrated')
    rig.wait(lambda: rig.values.get('link') == 'alive')
    answer = rig.call('mavlink_bridge/arm', True)
    assert (answer.success, answer.message) == (
        False,
        'armed refused: temporarily rejected: Arming denied: Compass not calibrated')
    assert rig.call('mavlink_bridge/offboard', True).success
    assert rig.call('mavlink_bridge/offboard', False).success


def test_without_an_autopilot_the_services_say_so(make_rig):
    rig = make_rig()
    rig.flies = False
    answer = rig.call('mavlink_bridge/arm', True)
    assert (answer.success, answer.message) == (
        False, 'armed: no HEARTBEAT from the autopilot')


@pytest.mark.parametrize(('parameter', 'line'), [
    ('connection:=udp:nowhere', "error: connection = 'udp:nowhere': must be udpin:HOST:PORT, "),
    ('signing_key_file:=/nowhere', "error: signing_key_file = '/nowhere': No such file"),
    ('a_max:=-1.0', 'error: a_max = -1.0: must be a number in [0.01, 20] m/s^2'),
    ('dialect:=betaflight', "error: dialect = 'betaflight': must be one of px4"),
    ('velocity_sorce:=odom', 'error: unknown parameter velocity_sorce for node mavlink_bridge: '
                             'did you mean velocity_source?')])
def test_a_bad_parameter_is_one_line_and_exit_code_one(parameter, line):
    process = subprocess.run(
        [sys.executable, '-m', 'flock_follower.nodes.mavlink_bridge', '--ros-args', '-p',
         parameter], capture_output=True, text=True, timeout=20.0, cwd=ROOT)
    assert process.returncode == 1
    assert process.stderr.startswith(line) and process.stderr.count('\n') == 1
