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

"""The node that draws: what it publishes, that it does nothing unwatched, and its transforms."""

from __future__ import annotations

from collections.abc import Iterator
import math
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from driven import Driven, overrides
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import String
from visualization_msgs.msg import Marker

from flock_desk.runs.processes import wait_until
from flock_follower.geometry import quaternion_from_yaw, quaternion_to_matrix, Transform
from flock_follower.messages import Command, set_quaternion, trajectory
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp, to_odometry
from flock_follower.nodes.support.inputs import StaticChild
from flock_follower.nodes.visualizer import TransformBroadcaster, Visualizer

pytestmark = pytest.mark.usefixtures('ros')
K = [610.0, 0.0, 320.0, 0.0, 610.0, 240.0, 0.0, 0.0, 1.0]
KNOWN = 1e-2 * np.eye(6)
ONE_CAMERA = {'camera_position': [0.1, 0.0, 0.0], 'camera_rpy': [0.0] * 3, 'cameras': ['']}


class Rig(Driven):
    """The visualizer, with messages of one moment of a flight."""

    def __init__(self) -> None:
        super().__init__(Visualizer(namespace='/one', parameter_overrides=overrides(rate=50.0)))
        self.node._perception.values = {
            **ONE_CAMERA, 'odom_child_position': [0.0, 0.0, 0.5], 'odom_child_rpy': [0.0] * 3}
        self.node._take_perception(self.node._perception.values)
        self.node._planner.values = {'d0': 1.0, 'd1': 8.0, 'radius': 0.0}
        self.inputs = {topic: take for _, topic, take, _ in self.node._inputs}

    def look(self, viewers: int) -> None:
        self.node._markers.get_subscription_count = lambda: viewers

    def draw(self) -> dict[str, Marker]:
        """Take one moment of a flight, the leader 2 m ahead to the north; return the markers."""
        now = self.node.get_clock().now().nanoseconds
        stamp, north = nanoseconds_to_stamp(now), quaternion_from_yaw(np.pi / 2)
        self.inputs['odom'](to_odometry(
            stamp, 'odom', 'imu', [0.0, 0.0, 2.0], north, np.zeros(3)))
        self.inputs['neighbors'](to_odometry(
            stamp, 'odom', 'leader', [0.0, 2.0, 2.0], north, [0.5, 0.0, 0.0], np.zeros(3), KNOWN,
            KNOWN))
        self.inputs['command/trajectory'](trajectory(make, Command(
            np.array([0.0, 1.0, 0.0]), 0.0, frame='odom', stamp=now)))
        self.inputs['camera_info'](CameraInfo(width=640, height=480, k=K))
        self.inputs['planner/state'](String(data='TRACK'))
        self.inputs['/diagnostics'](DiagnosticArray(status=[
            DiagnosticStatus(name='one/planner', values=[
                KeyValue(key='state', value='TRACK'), KeyValue(key='edges', value='leader'),
                KeyValue(key='limits', value='separation')]),
            DiagnosticStatus(name='two/planner', values=[KeyValue(key='state', value='HOLD')])]))
        self.node._tick()
        return {one.ns: one for one in self.sent['visualizer/markers'][-1].markers}


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.close()


def points(marker: Marker) -> Any:
    return np.array([[p.x, p.y, p.z] for p in marker.points])


def test_it_draws_the_flight_and_nothing_while_nobody_looks(rig: Rig) -> None:
    rig.node._tick()
    assert not rig.sent['visualizer/markers'] and not rig.node._open
    assert rig.values['watched'] is False

    rig.look(1)
    drawn = rig.draw()
    assert {s.topic_name for s in rig.node._open} == {
        '/diagnostics', *(f'/one/{topic}' for topic in rig.inputs if topic != '/diagnostics')}
    assert set(drawn) == {
        'base_link', 'command', 'edges', 'leader', 'leader covariance', 'leader d0', 'leader d1',
        'leader name', 'leader velocity', 'sight', 'state'}
    assert all((one.header.frame_id, one.action) == ('odom', Marker.ADD) and one.color.a > 0.0
               for one in drawn.values())
    own = drawn['base_link'].pose.position
    assert (own.x, own.y, own.z) == pytest.approx((0.0, 0.0, 1.5))  # the IMU is 0.5 m above it
    assert np.ptp(points(drawn['leader d1'])[:, 0]) == pytest.approx(2.0 * np.sqrt(8.0), rel=0.01)
    assert points(drawn['sight'])[0] == pytest.approx([0.0, 0.1, 1.5])
    assert drawn['state'].text == 'TRACK\nguard: separation'

    rig.node._planner.values = {**rig.node._planner.values, 'd1': 4.0}
    assert np.ptp(points(rig.draw()['leader d1'])[:, 0]) == pytest.approx(4.0, abs=0.01)
    rig.look(0)
    rig.node._tick()
    assert not rig.node._open and rig.node._own is None  # a later viewer sees no old state


def test_messages_of_the_other_nodes_are_taken_and_their_parameters_requested(rig: Rig) -> None:
    other, executor = Node('planner', namespace='/one'), SingleThreadedExecutor()
    for name, value in {'d0': 1.5, 'd1': 7.0, 'radius': 0.25}.items():
        other.declare_parameter(name, value)
    odom = other.create_publisher(Odometry, 'odom', 10)
    for node in (other, rig.node):
        executor.add_node(node)
    rig.look(1)
    lost = Odometry()
    lost.pose.pose.orientation.w = 0.0

    def seen() -> bool:
        odom.publish(lost)
        rig.node._asked = -math.inf
        executor.spin_once(timeout_sec=0.01)
        return bool(rig.counters['invalid odom'] and rig.node._planner.values['d0'] == 1.5)
    wait_until(seen, 20.0, 'a message and the parameters')
    assert rig.node._planner.values == {'d0': 1.5, 'd1': 7.0, 'radius': 0.25}
    executor.shutdown()
    other.destroy_node()


@pytest.fixture
def tf(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Node, dict[str, list[Any]]]]:
    """Give a node for which tf2_msgs is installed, and what it publishes."""
    module = ModuleType('tf2_msgs.msg')
    module.TFMessage = lambda transforms: SimpleNamespace(transforms=transforms)
    monkeypatch.setitem(sys.modules, 'tf2_msgs', ModuleType('tf2_msgs'))
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', module)
    node = Node('visualizer')
    sent: dict[str, list[Any]] = {'/tf': [], '/tf_static': []}
    monkeypatch.setattr(node, 'create_subscription', lambda *_, **__: None)
    monkeypatch.setattr(node, 'create_publisher', lambda _, topic, __: SimpleNamespace(
        publish=sent[topic].append, get_subscription_count=lambda: 1))
    yield node, sent
    node.destroy_node()


def test_a_transform_is_told_once_for_a_stamp(tf: tuple[Node, dict[str, list[Any]]]) -> None:
    node, received = tf
    broadcaster = TransformBroadcaster(node, StaticChild(node), 'auto')
    pose = Transform.from_quaternion([1.0, 2.0, 3.0], quaternion_from_yaw(0.5))
    for stamp in (10**9, 10**9, 2 * 10**9):
        broadcaster.move(stamp, 'odom', 'leader', pose)
    broadcaster.move(10**9, '', 'leader', pose)
    sent = [one for message in received['/tf'] for one in message.transforms]
    assert [one.header.stamp.sec for one in sent] == [1, 2]
    assert (sent[0].header.frame_id, sent[0].child_frame_id) == ('odom', 'leader')
    reported, turn = sent[0].transform.translation, sent[0].transform.rotation
    assert (reported.x, reported.y, reported.z) == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(
        quaternion_to_matrix([turn.x, turn.y, turn.z, turn.w]), pose.rotation)


@pytest.mark.parametrize(('odom_tf', 'others', 'owns'), [
    ('auto', [], True), ('auto', ['/vio'], False), ('always', ['/vio'], True),
    ('never', [], False), ('auto', ['/visualizer'], True), ('auto', ['/b/visualizer'], False)])
def test_odom_to_base_link_is_left_to_the_odometry(
        tf: tuple[Node, dict[str, list[Any]]], monkeypatch: pytest.MonkeyPatch, odom_tf: str,
        others: list[str], owns: bool) -> None:
    node, _ = tf
    monkeypatch.setattr(node, 'get_publishers_info_by_topic', lambda topic: [
        SimpleNamespace(node_namespace=name.rpartition('/')[0] or '/',
                        node_name=name.rpartition('/')[2])
        for name in ['/visualizer', *others] if topic == '/tf'])
    assert TransformBroadcaster(node, StaticChild(node), odom_tf).owns_odometry is owns


def test_a_cameras_frame_that_is_told_already_is_left_alone(
        tf: tuple[Node, dict[str, list[Any]]]) -> None:
    node, received = tf
    static = StaticChild(node)
    broadcaster = TransformBroadcaster(node, static, 'auto')
    pose = Transform(translation=np.array([0.1, 0.0, 0.0]))
    assert broadcaster.fix(0, 'base_link', 'left', pose)
    assert broadcaster.fix(0, 'base_link', 'right', pose)
    assert broadcaster.fix(0, 'base_link', 'right', pose)
    sent = received['/tf_static']
    assert [[one.child_frame_id for one in message.transforms] for message in sent] == [
        ['left'], ['left', 'right']]
    static.take(sent[0])  # one's own, as it comes back
    assert broadcaster.fix(0, 'base_link', 'left', pose)
    reported = sent[0].transforms[0]
    reported.child_frame_id = 'rear'
    static.take(SimpleNamespace(transforms=[reported]))
    assert not broadcaster.fix(0, 'base_link', 'rear', pose)


def test_without_tf2_msgs_nothing_is_broadcast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)
    node = Node('visualizer')
    broadcaster = TransformBroadcaster(node, StaticChild(node), 'always')
    broadcaster.move(1, 'odom', 'base_link', Transform())
    assert not broadcaster.wanted
    assert broadcaster.fix(1, 'base_link', 'camera', Transform())
    assert not node.count_publishers('/tf')
    node.destroy_node()


def test_the_pose_of_the_child_frame_is_composed_of_the_frames_between() -> None:
    node = Node('visualizer')
    static = StaticChild(node)
    for parent, child, x, yaw in (('base_link', 'camera', 0.1, np.pi / 2.0),
                                  ('camera', 'imu', 0.02, 0.0)):
        stamped = TransformStamped(child_frame_id=child)
        stamped.header.frame_id, stamped.transform.translation.x = parent, x
        set_quaternion(stamped.transform.rotation, quaternion_from_yaw(yaw))
        static.take(SimpleNamespace(transforms=[stamped]))
    pose = static.transform('imu')
    assert pose is not None and pose.translation == pytest.approx([0.1, 0.02, 0.0])
    np.testing.assert_allclose(pose.quaternion, quaternion_from_yaw(np.pi / 2.0))
    assert static.transform('base_link') is static.transform('elsewhere') is None
    node.destroy_node()
