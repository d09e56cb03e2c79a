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

"""
Who flies, and when, by the real nodes: as test/desk/test_handover.py has it in lock step.

Each personality of the embedded autopilot flies once, both at the same time. The autopilot, the
bridge and the planner are processes. Here are the operator, who calls the services, the pilot's
script, and a leader that is seen whatever happens. The test judges what really happened, by the
autopilot's own log, and what bridge and planner said meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
import itertools
import json
import math
import os
from pathlib import Path
import signal
import time
from typing import Any, NamedTuple

from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from flock_desk.runs.processes import free_udp_port, private_environment, Processes
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry

pytestmark = pytest.mark.slow
DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time
HEIGHT, CLIMB, AHEAD = 1.5, 2.0, 2.0  # m: take-off, the pilot's climb, the leader at first
LEADER_SPEED, LEADER_PERIOD = 0.2, 0.05  # m/s, eastward while the bridge is ACTIVE; s
PILOT, GIVES_BACK = 7.0, 15.0  # s after the first setpoint
FOLLOWING, HOLDING = 3.0, 2.0  # s for which it is watched
LAG = 0.3  # s between what is done and what of it is logged elsewhere, on a busy machine
HEARTBEAT = 1.0  # s between those of PX4, by which the bridge hears of the pilot's switch


class Personality(NamedTuple):
    """The modes of an autopilot, and parameters as config recommends them."""

    offboard: str
    manual: str
    given_back: str
    """What it is in once the pilot's switch is back where it was, and no setpoint comes."""
    hold: str
    parameters: tuple[str, ...]


PERSONALITIES = {
    'px4': Personality('OFFBOARD', 'POSCTL', 'AUTO.LOITER', 'AUTO.LOITER', (
        'COM_OF_LOSS_T=0.5', 'COM_OBL_RC_ACT=5', 'COM_RC_OVERRIDE=3',
        f'MIS_TAKEOFF_ALT={HEIGHT}')),
    'arducopter': Personality('GUIDED', 'LOITER', 'GUIDED', 'BRAKE', ('GUID_TIMEOUT=0.5',))}


class Flight:
    """The nodes' processes, everybody they talk to, and what happened, by the monotonic clock."""

    def __init__(self, name: str, folder: Path) -> None:
        self.personality = PERSONALITIES[name]
        self.states: dict[str, list[tuple[float, str]]] = {'planner': [], 'mavlink_bridge': []}
        self.asked: list[float] = []
        self.killed = self.interrupted = math.nan
        self.log: dict[str, Any] = {}
        self._name, self._folder = name, folder
        self._altitude = math.nan
        self._leader_due, self._leader_east = 0.0, AHEAD
        self._port = free_udp_port()
        self._ros = ['--ros-args', '-r', f'__ns:=/handover_{name}']
        environment = private_environment(int(os.environ['ROS_DOMAIN_ID']))
        environment['PYTHONPATH'] = os.pathsep.join(
            [str(Path(__file__).parents[1]), environment.get('PYTHONPATH', '')])
        self._processes = Processes(environment, folder / 'logs')
        self._node = Node('surroundings', namespace=f'handover_{name}')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for who in self.states:
            self._node.create_subscription(
                String, f'{who}/state', partial(self._hear, who), latched)
        self._node.create_subscription(
            Odometry, 'mavlink/odom', self._take_odometry, qos_profile_sensor_data)
        self._neighbors = self._node.create_publisher(Odometry, 'neighbors', 10)

    def fly(self) -> Flight:
        try:
            with self._processes:
                self._fly()
                assert self._processes.stop('autopilot', DEADLINE) == 0
        finally:
            self._executor.shutdown()
            self._node.destroy_node()
        with np.load(self._folder / 'flight.npz') as log:
            self.log = dict(log)
        return self

    def _fly(self) -> None:
        manual, given_back = self.personality.manual, self.personality.given_back
        self._start_bridge('mavlink_bridge')
        self._processes.start('planner', 'flock_follower.nodes.planner',
                              [*self._ros, '-r', 'odom:=mavlink/odom'])
        self._ask('planner/engage', True)
        self._start_autopilot()
        self._ask('mavlink_bridge/arm', True)
        self._ask('mavlink_bridge/takeoff')
        self._offboard()
        flown = self._altitude
        self._wait(lambda: self._word('mavlink_bridge') == 'TAKEN_OVER')
        self._wait(lambda: self._altitude > flown + CLIMB - 0.2)
        self._wait(lambda: f'{given_back}, armed' in self._processes.log(
            'mavlink_bridge').rpartition(f'{manual}, armed')[2])
        self._run(HOLDING)
        self._offboard()
        self._run(FOLLOWING)

        bridge = self._processes.children['mavlink_bridge']
        os.kill(bridge.pid, signal.SIGKILL)
        bridge.wait()
        self.killed = time.monotonic()
        self._start_bridge('again')
        self._wait(lambda: self.states['mavlink_bridge'][-1][0] > self.killed)
        self._run(HOLDING)
        self._offboard()
        self._run(FOLLOWING)
        self.interrupted = time.monotonic()
        assert self._processes.stop('again', 2.0) == 0
        self._run(HOLDING)
        assert 'Traceback' not in self._logs()

    def _start_bridge(self, name: str) -> None:
        self._processes.start(name, 'flock_follower.nodes.mavlink_bridge', [
            *self._ros, '-p', f'connection:=udpin:127.0.0.1:{self._port}',
            '-p', 'velocity_source:=autopilot', '-p', f'takeoff_height:={HEIGHT}'])

    def _start_autopilot(self) -> None:
        switches = [
            {'kind': 'pilot', 'at': PILOT, 'after': 'setpoint', 'mode': self.personality.manual,
             'climb': CLIMB},
            {'kind': 'pilot', 'at': GIVES_BACK, 'after': 'setpoint',
             'mode': self.personality.offboard}]
        self._processes.start('autopilot', 'faulty_autopilot', [
            '--connect', f'127.0.0.1:{self._port}', '--personality', self._name,
            '--start', 'landed',
            *(word for switch in switches for word in ('--fault', json.dumps(switch))),
            '--log', str(self._folder / 'flight.npz'),
            *(word for text in self.personality.parameters for word in ('--param', text))])

    def _offboard(self) -> None:
        self.asked.append(time.monotonic())
        self._ask('mavlink_bridge/offboard', True)
        self._ask('planner/engage', True)  # the pilot's takeover disengaged it
        self._wait(lambda: self._word('planner') == 'TRACK')

    def _ask(self, service: str, value: bool | None = None) -> None:
        """Call a SetBool, or without a value a Trigger, until it succeeds."""
        kind, request = (Trigger, Trigger.Request()) if value is None else (
            SetBool, SetBool.Request(data=value))
        client = self._node.create_client(kind, service)
        self._wait(client.service_is_ready)
        success, deadline = False, time.monotonic() + DEADLINE
        while not success:
            assert time.monotonic() < deadline, self._logs()
            future = client.call_async(request)
            self._wait(future.done)
            success = future.result().success
            self._run(0.0 if success else 0.2)  # as an operator: the vehicle is getting ready

    def _wait(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, self._logs()
            self._spin()

    def _run(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._spin()

    def _spin(self) -> None:
        if time.monotonic() >= self._leader_due:
            self._leader_due = time.monotonic() + LEADER_PERIOD
            speed = LEADER_SPEED if self._word('mavlink_bridge') == 'ACTIVE' else 0.0
            self._leader_east += speed * LEADER_PERIOD
            self._neighbors.publish(to_odometry(
                nanoseconds_to_stamp(self._node.get_clock().now().nanoseconds), 'odom', 'leader',
                (self._leader_east, 0.0, HEIGHT), (0.0, 0.0, 0.0, 1.0), (speed, 0.0, 0.0)))
        self._executor.spin_once(timeout_sec=0.01)

    def _take_odometry(self, message: Odometry) -> None:
        self._altitude = message.pose.pose.position.z

    def _hear(self, who: str, message: String) -> None:
        self.states[who].append((time.monotonic(), message.data.partition(':')[0]))

    def _word(self, who: str) -> str:
        return self.states[who][-1][1] if self.states[who] else ''

    def _logs(self) -> str:
        return '\n'.join([str(self.states), *(
            f'--- {name}\n{self._processes.log(name)}' for name in self._processes.children)])


@pytest.fixture(scope='module')
def flights(ros: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Future[Flight]]:
    """Fly both personalities at the same time, and return what happened."""
    folders = {name: tmp_path_factory.mktemp(name) for name in PERSONALITIES}
    with ThreadPoolExecutor(len(folders)) as pool:
        return {name: pool.submit(Flight(name, folder).fly) for name, folder in folders.items()}


@pytest.fixture(params=PERSONALITIES)
def flight(request: pytest.FixtureRequest, flights: dict[str, Future[Flight]]) -> Flight:
    return flights[request.param].result()


def taken_over(flight: Flight) -> float:
    """Return when the pilot took over, s, by the autopilot."""
    return float(flight.log['state_time'][flight.log['mode'] == flight.personality.manual][0])


def ends(flight: Flight) -> list[float]:
    """Return until when each of the three permissions held, s."""
    return [taken_over(flight), flight.killed, flight.interrupted]


def test_setpoints_come_only_while_permitted(flight: Flight) -> None:
    times, over = flight.log['setpoint_time'], taken_over(flight)
    heard = next(time for time, word in flight.states['mavlink_bridge'] if word == 'TAKEN_OVER')
    assert heard - over < HEARTBEAT + LAG
    permitted = np.zeros(len(times), bool)
    # The interrupted bridge brakes before it ends.
    for asked, end in zip(flight.asked, [heard, flight.killed, flight.interrupted + 2.0]):
        permitted |= (times >= asked) & (times < end + LAG)
        assert np.any((times >= asked) & (times < end))
    assert permitted.all()


def test_the_pilots_switch_alone_never_gives_the_vehicle_back(flight: Flight) -> None:
    log = flight.log
    left = (log['state_time'] > taken_over(flight)) & (log['state_time'] < flight.asked[1])
    assert [mode for mode, _ in itertools.groupby(log['mode'][left])] == [
        flight.personality.manual, flight.personality.given_back]
    assert np.abs(log['velocity'][left][-50:]).max() < 0.1  # it stands where the pilot left it


def test_the_planner_follows_only_while_the_bridge_flies_and_keeps_the_altitude(
        flight: Flight) -> None:
    log = flight.log
    modes = log['mode'][np.searchsorted(log['state_time'], log['setpoint_time']) - 1]
    obeyed = log['setpoint_time'][modes == flight.personality.offboard]
    for asked, end in zip(flight.asked, ends(flight)):
        first = obeyed[obeyed >= asked][0]
        flown = (log['state_time'] >= first) & (log['state_time'] < end)
        east, north, up = log['position'][flown].T
        assert np.ptp(up) < 0.3
        assert east[-1] - east[0] > 0.1 and abs(north[-1] - north[0]) < 0.1  # after the leader
        assert next(word for time, word in flight.states['planner'] if time > asked) == 'TRACK'
    # HOLD: the odometry of a bridge that was killed ends before its silence counts.
    words = [word for word, _ in itertools.groupby(
        w for _, w in flight.states['planner'] if w != 'HOLD')]
    assert words == ['IDLE', 'TRACK'] * 3 + ['IDLE']


def test_the_bridge_says_what_becomes_of_it_and_leaves_the_vehicle_in_hold(
        flight: Flight) -> None:
    words = [word for word, _ in itertools.groupby(w for _, w in flight.states['mavlink_bridge'])]
    # READY may have been replaced by what came then before it was heard.
    assert [word for word in words if word not in ('NO_AUTOPILOT', 'READY')] == [
        'INACTIVE', 'ACTIVE', 'TAKEN_OVER', 'ACTIVE', 'INACTIVE', 'ACTIVE']
    assert flight.log['mode'][-1] == flight.personality.hold
    assert np.abs(flight.log['velocity'][-50:]).max() < 0.1
