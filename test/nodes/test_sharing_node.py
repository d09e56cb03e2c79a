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

"""Two vehicles in namespaces that talk: who is in front is told of who is behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock

from flock_follower.flock.alignment import turned
from flock_follower.geometry import Array, quaternion_from_yaw
from flock_follower.messages import to_array
from flock_follower.nodes.flock import main, SHARED_QOS, SHARED_TOPIC, SharingNode
from flock_follower.nodes.sharing import main as former_main
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry

START = 1_700_000_000 * 10 ** 9  # ns
STEP = 50_000_000  # ns
DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time
#: How the odometry of each is turned, rad, and where it begins, m.
FRAMES = {'front': (0.4, np.array([5.0, 0.0, 0.0])), 'rear': (-2.0, np.array([0.0, -3.0, 0.2]))}
TRUE = {'front': np.array([2.0, 0.0, 2.0]), 'rear': np.array([0.0, 0.0, 2.0])}
KNOWN = 1e-4 * np.eye(6)


class Flock:
    """The nodes of both, and one that plays their surroundings in steps of 50 ms."""

    def __init__(self) -> None:
        self.node = Node('surroundings')
        self.sharing = {name: SharingNode(namespace=f'/{name}', parameter_overrides=[
            Parameter('use_sim_time', value=True), Parameter('odom_twist_frame', value='child')])
            for name in FRAMES}
        self.executor = SingleThreadedExecutor()
        for node in (self.node, *self.sharing.values()):
            self.executor.add_node(node)
        self.now = START
        self.clock = self.node.create_publisher(Clock, '/clock', 10)
        self.odom = {name: self.node.create_publisher(
            Odometry, f'/{name}/odom', qos_profile_sensor_data) for name in FRAMES}
        self.sightings = self.node.create_publisher(Odometry, '/rear/neighbors', 10)
        self.words = self.node.create_publisher(Odometry, SHARED_TOPIC, SHARED_QOS)
        self.states: dict[str, list[Odometry]] = {name: [] for name in FRAMES}
        self.diagnostics: dict[str, dict[str, str]] = {}
        for name, states in self.states.items():
            self.node.create_subscription(Odometry, f'/{name}/neighbors/heard', states.append, 10)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._take_status, 10)
        self.wait(lambda: all(
            publisher.get_subscription_count() for publisher in self.odom.values())
            and self.sightings.get_subscription_count()
            and self.words.get_subscription_count() == 2
            and self.node.count_publishers(SHARED_TOPIC) == 3
            and self.clock.get_subscription_count() == 2)

    def _take_status(self, message: DiagnosticArray) -> None:
        (status,) = message.status
        self.diagnostics[status.name] = {
            'message': status.message, **{v.key: v.value for v in status.values}}

    def wait(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, 'waited in vain'
            self.executor.spin_once(timeout_sec=0.01)

    def place(self, name: str, of: str) -> Array:
        """Return where a vehicle is in the odometry of another, or in its own."""
        yaw, origin = FRAMES[name]
        return turned(yaw) @ TRUE[of] + origin

    def count(self, name: str, topic: str) -> int:
        return self.sharing[name].diagnostics.rates[f'{topic}_hz'].count

    def run(self, seconds: float, seeing: bool = True) -> None:
        for _ in range(round(seconds * 1e9) // STEP):
            self.now += STEP
            stamp = nanoseconds_to_stamp(self.now)
            seen = self.count('rear', 'neighbors')
            for name, publisher in self.odom.items():
                publisher.publish(to_odometry(
                    stamp, 'odom', 'base_link', self.place(name, name),
                    quaternion_from_yaw(FRAMES[name][0]), np.zeros(3)))
            if seeing:
                self.sightings.publish(to_odometry(
                    stamp, 'odom', 'front', self.place('rear', 'front'),
                    quaternion_from_yaw(FRAMES['rear'][0]), np.zeros(3), np.zeros(3), KNOWN,
                    KNOWN))
            self.wait(lambda seen=seen: self.count('rear', 'neighbors') >= seen + seeing)
            self.clock.publish(Clock(clock=stamp))
            self.wait(lambda: all(node.get_clock().now().nanoseconds == self.now
                                  for node in self.sharing.values()))

    def status(self, name: str) -> dict[str, str]:
        self.diagnostics.clear()
        self.sharing[name].diagnostics.publish()
        self.wait(lambda: f'{name}/flock' in self.diagnostics)
        return self.diagnostics[f'{name}/flock']

    def close(self) -> None:
        self.executor.shutdown()
        for node in (self.node, *self.sharing.values()):
            node.destroy_node()


@pytest.fixture
def flock() -> Iterator[Flock]:
    rclpy.init()
    flock = Flock()
    yield flock
    flock.close()
    rclpy.shutdown()


def test_who_is_in_front_is_told_of_who_is_behind(flock: Flock) -> None:
    flock.run(0.3, seeing=False)
    assert 'no other sender' in flock.status('front')['message'] or (
        'not aligned with rear' in flock.status('front')['message'])
    flock.run(2.5)
    flock.wait(lambda: flock.states['front'])
    word = flock.states['front'][-1]
    assert (word.header.frame_id, word.child_frame_id) == ('odom', 'rear')
    assert to_array(word.pose.pose.position) == pytest.approx(
        flock.place('front', 'rear'), abs=0.05)
    q = word.pose.pose.orientation
    assert 2.0 * math.atan2(q.z, q.w) == pytest.approx(FRAMES['front'][0], abs=0.05)
    assert 0.0 < np.trace(np.array(word.pose.covariance).reshape(6, 6)[:3, :3]) < 0.3 ** 2
    assert flock.states['rear'] == []  # it sees who is in front
    status = flock.status('front')
    assert status['message'] == 'running' and status['frame of rear'].startswith('known to 0.')
    assert status['vehicle_name'] == 'front'
    assert float(status['rejected: not aligned with rear']) > 0

    bad = to_odometry(nanoseconds_to_stamp(flock.now), 'front/odom', 'front', np.zeros(3),
                      quaternion_from_yaw(0.0), np.zeros(3))
    flock.words.publish(bad)
    bad.header.frame_id, bad.pose.pose.position.x = 'rear/odom', math.nan
    flock.words.publish(bad)
    bad.header.frame_id, bad.pose.pose.position.x = 'odom', 0.0
    flock.words.publish(bad)
    counters = flock.sharing['front'].diagnostics.counters
    flock.wait(lambda: counters[f'invalid {SHARED_TOPIC}'])
    flock.run(0.3)
    flock.wait(lambda: counters['another vehicle uses this name'] == 1
               and counters['frame of a message is not unique'] == 1)
    count = len(flock.states['front'])
    flock.run(0.3)
    flock.wait(lambda: len(flock.states['front']) > count)


@pytest.mark.parametrize(('arguments', 'message'), [
    ([], "vehicle_name = ''"),
    (['-p', 'vehicle_name:=a/b'], "vehicle_name = 'a/b'"),
    (['-r', '__ns:=/f1', '-p', 'yaw_std_max:=4.0'], 'yaw_std_max for node flock: it was')])
def test_without_a_name_it_does_not_start(arguments: list[str], message: str,
                                          capfd: pytest.CaptureFixture[str]) -> None:
    assert main(['flock', '--ros-args', *arguments]) == 1
    error = capfd.readouterr().err
    assert 'Traceback' not in error
    (line,) = [line for line in error.splitlines() if line.startswith('error:')]
    assert message in line


def test_a_namespace_is_a_name() -> None:
    rclpy.init()
    try:
        node = SharingNode(namespace='/flock/f1')
        assert node._sharing.name == 'flock_f1'
        node.destroy_node()
    finally:
        rclpy.shutdown()


def test_its_former_name_starts_it_with_the_former_node_name(
        capfd: pytest.CaptureFixture[str]) -> None:
    assert former_main(['sharing', '--ros-args', '-r', '__ns:=/f1', '-p', 'yaw_std_max:=4.0']) == 1
    assert 'yaw_std_max for node sharing: it was' in capfd.readouterr().err
