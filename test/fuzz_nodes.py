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
Malformed messages into every callback of the nodes: no exception, no command beyond the limits.

Each node runs in this process without an executor: its subscriptions, services and timers are
called directly, so that every message is a callback. A third of the messages is good, so that the
states behind the first check are reached; the rest is good but for a few fields, or nonsense.
"""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from functools import reduce
import signal
import time

from builtin_interfaces.msg import Time
import cv2
from driven import Driven, overrides
from fuzz_mavlink import FuzzError, judge_odometry, judge_setpoint, LONGEST, no_hang, place
from fuzz_messages import MessageFuzzer
from geometry_msgs.msg import Transform, Twist
from marker_images import facing, make_camera, render
from nav_msgs.msg import Odometry
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
from rclpy.logging import LoggingSeverity
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header, String
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from flock_desk.vehicles.embedded import EmbeddedAutopilot
from flock_follower.gate.permission import Phase
from flock_follower.mavlink.transport import UdpTransport
from flock_follower.messages import to_array
from flock_follower.nodes.flock import SharingNode
from flock_follower.nodes.mavlink_bridge import MavlinkBridge
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose

PERIOD_NS = 10_000_000  # of time between messages
A_MAX = 2.5
RECOVERY = 30  # good messages of each kind after which a node does its work again
NODES = {
    'planner': (Planner, {}),
    'mavlink_bridge': (MavlinkBridge, {
        'stream_rate': 100.0, 'a_max': A_MAX, 'forward_odometry': True,
        'require_failsafe': False}),  # it is not fused
    'relative_pose': (RelativePose, {'image_transport': 'raw'}),
    'relative_pose compressed': (RelativePose, {'image_transport': 'compressed'}),
    'sharing': (SharingNode, {'vehicle_name': 'f1'})}
# Small, so that many images are looked at in little time.
_CAMERA = make_camera().scaled(0, 0, 640, 480, 4, 4)
_GRAY = render(_CAMERA, {0: facing((0.0, 0.0, 0.8), (0.1, 0.1, 0.0))})
_FILES = [cv2.imencode(form, _GRAY)[1].tobytes() for form in ('.png', '.jpg')]
_COVARIANCE = np.diag([1e-4] * 6).ravel()
#: Fields of good messages.
GOOD = {
    String: {'data': 'ACTIVE'},  # of the bridge
    Odometry: {'child_frame_id': 'base_link', 'pose.pose.position.z': 2.0,
               'pose.pose.orientation.w': 1.0, 'pose.covariance': _COVARIANCE,
               'twist.covariance': _COVARIANCE},
    CameraInfo: {'width': _CAMERA.width, 'height': _CAMERA.height,
                 'distortion_model': 'plumb_bob', 'd': [0.0] * 5, 'k': _CAMERA.matrix.ravel(),
                 'r': np.eye(3).ravel(),
                 'p': np.hstack([_CAMERA.matrix, np.zeros((3, 1))]).ravel()},
    Image: {'encoding': 'mono8', 'height': _GRAY.shape[0], 'width': _GRAY.shape[1],
            'step': _GRAY.shape[1], 'data': _GRAY.tobytes()},
    CompressedImage: {'format': 'jpeg', 'data': _FILES[1]}, Header: {}}


class NodeUnderFire(Driven):
    """One node without an executor, in a time of its own."""

    def __init__(self, kind, seed):
        self.fuzzer = MessageFuzzer(seed)
        self.random = self.fuzzer.random
        self.published = Counter()
        self.given = 0
        self.autopilot = self._line = None
        make, parameters = NODES[kind]
        if kind == 'mavlink_bridge':
            self._line = UdpTransport('', bind=('127.0.0.1', 0))
            self.autopilot = EmbeddedAutopilot('px4', now=time.monotonic(), seed=seed)
            host, port = self._line.address
            parameters = {**parameters, 'connection': f'udpout:{host}:{port}'}
        super().__init__(make(parameter_overrides=overrides(use_sim_time=True, **parameters)))
        self.now = 1_000_000_000_000
        self.node.get_logger().set_level(LoggingSeverity.FATAL)
        self.errors = []
        self.node.diagnostics.internal_error = self._note_error
        self._timer_share = 0.3 if kind == 'planner' else 0.05
        for publisher in self.node.publishers:
            publisher.publish = self._judge
        self.sent = Counter()
        self._codec = mavlink.MAVLink(None)
        if self.autopilot is not None:
            self._take_over()

    def _take_over(self):
        """Ask for offboard until the vehicle flies the setpoints: before, no command gets far."""
        asking, deadline = None, time.monotonic() + 20.0
        while self.node._bridge.gate.permission.phase is not Phase.ACTIVE:
            assert time.monotonic() < deadline, self.node._bridge.gate.permission
            time.sleep(0.005)
            self._exchange()
            asking = asking or self.call('offboard', data=True)
            self.turn()
            try:
                asking.send(None)
            except StopIteration:  # refused while nothing was received yet
                asking = None

    def close(self):
        """Release everything."""
        super().close()
        if self._line is not None:
            self._line.close()

    def fire(self):
        """Send one message to one callback, and now and then let a timer run or a service act."""
        r = self.random
        self.now += PERIOD_NS
        subscription = r.choice([s for s in self.node.subscriptions
                                 if s.topic_name != '/parameter_events'])
        if subscription.msg_type is Clock:
            message = Clock(clock=self._stamp(jitter=r.random() < 0.01))
        else:
            self.give('/clock', Clock(clock=self._stamp()))
            message = self._message(subscription.msg_type)
            self._address(subscription, message)
        self.given += 1  # how a message came: in order, or untold
        self.give(subscription.topic_name, message, *r.choice(
            [(self.given, 0), (self.given, time.time_ns()), (None, None)]))
        if r.random() < self._timer_share:
            for timer in self.node.timers:
                timer.callback()
        if r.random() < 0.01:
            self._engage(r.random() < 0.8)
        if self.autopilot is not None:
            self._exchange()

    def tick(self, change=lambda message: None):
        """Give every input a good message, changed by a function, and run every timer."""
        self.now += PERIOD_NS
        self.give('/clock', Clock(clock=self._stamp()))
        for subscription in self.node.subscriptions:
            if subscription.msg_type in GOOD:
                message = self.good(
                    subscription.msg_type, subscription.topic_name.endswith('neighbors'))
                self._address(subscription, message)
                change(message)
                self.give(subscription.topic_name, message)
        self._engage(True)
        for timer in self.node.timers:
            timer.callback()

    def recovers(self):
        """Return whether good messages make the node do its work again."""
        wanted = {'Planner': 'MultiDOFJointTrajectory', 'RelativePose': 'Odometry',
                  'SharingNode': 'Odometry'}.get(type(self.node).__name__)
        before = self.published[wanted]
        for _ in range(RECOVERY):
            self.tick()
        return wanted is None or self.published[wanted] > before

    def _address(self, subscription, message):
        """Let what another vehicle tells be in its frame."""
        if subscription.topic_name.endswith('/shared') and message.header.frame_id == 'odom':
            message.header.frame_id = 'f2/odom'
            if message.child_frame_id == 'base_link':
                message.child_frame_id = 'f2'

    def _engage(self, value):
        if isinstance(self.node, Planner):
            self.call('engage', data=value)

    def _message(self, kind):
        lot = self.random.random()
        if lot < 0.2:
            return self.fuzzer.any_message(kind)
        message = self.good(kind, self.random.random() < 0.6)
        if kind is CompressedImage and lot < 0.6:
            message.data = self._spoilt(message.data)
        return message if lot < 0.5 else self.fuzzer.spoil(message, self.random.randint(1, 4))

    def _stamp(self, jitter=False):
        now = self.now + (self.random.randint(-10**9, 10**9) if jitter else 0)
        return Time(sec=now // 10**9, nanosec=now % 10**9)

    def good(self, kind, of_leader=False):
        """Return a message as it should be."""
        r, message = self.random, kind()
        for path, value in GOOD.get(kind, {}).items():
            *parts, name = path.split('.')
            setattr(reduce(getattr, parts, message), name, value)
        if kind is String:
            return message
        header = message if kind is Header else message.header
        header.stamp, header.frame_id = self._stamp(), 'odom'
        if kind is Odometry:
            message.child_frame_id = 'leader' if of_leader else 'base_link'
            message.pose.pose.position.x = r.gauss(1.5 if of_leader else 0.0, 0.05)
            message.twist.twist.linear.x = r.gauss(0.2, 0.05)
        elif kind is MultiDOFJointTrajectory:
            point = MultiDOFJointTrajectoryPoint(
                transforms=[Transform()], velocities=[Twist()], accelerations=[Twist()])
            point.accelerations[0].linear.x = r.gauss(0.0, 2.0)
            message.points = [point]
        elif kind is CompressedImage:
            message.data = r.choice(_FILES)
        return message

    def _spoilt(self, data):
        data = bytearray(data)
        for _ in range(self.random.choice((1, 1, 3))):
            data[self.random.randrange(min(len(data), 700))] = self.random.randrange(256)
        return bytes(data)

    def _exchange(self):
        """Let the embedded autopilot and the bridge's stream hear each other."""
        now = time.monotonic()
        for data, peer in self._line.read():
            self._line.peer = peer
            for message in self._codec.parse_buffer(data) or []:
                kind = message.get_type()
                self.sent[kind] += 1
                if kind == 'SET_POSITION_TARGET_LOCAL_NED':
                    judge_setpoint(message, A_MAX)
                elif kind == 'ODOMETRY':
                    judge_odometry(message)
            for answer in self.autopilot.receive(data, now):
                self._line.write(answer)
        # Its first HEARTBEAT must not go out, and be lost, before it knows where to.
        while self._line.peer is not None and self.autopilot.next_step <= now:
            for data in self.autopilot.step(self.autopilot.next_step):
                self._line.write(data)

    def _note_error(self, where, error):
        self.errors.append(f'{where}: {place(error)}')

    def _judge(self, message):
        kind = type(message).__name__
        self.published[kind] += 1
        if isinstance(message, MultiDOFJointTrajectory):
            size = np.linalg.norm(to_array(message.points[0].accelerations[0].linear))
            if not size <= A_MAX * (1.0 + 1e-9):
                raise FuzzError(f'command of {size} m/s^2')
        elif isinstance(message, Odometry):
            pose, q = message.pose.pose, message.pose.pose.orientation
            numbers = [*to_array(pose.position), q.x, q.y, q.z, q.w,
                       *to_array(message.twist.twist.linear)]
            if not np.all(np.isfinite(numbers)):
                raise FuzzError(f'odometry that is not finite: {numbers}')


@contextmanager
def node_under_fire(kind, seed):
    """Make a node and take it down again; rclpy is initialized by whoever calls."""
    under_fire = NodeUnderFire(kind, seed)
    try:
        yield under_fire
    finally:
        under_fire.close()


def fuzz_node(kind, count, seed):
    """Fire ``count`` messages at a node; return what it published and rejected."""
    what = f'{kind}, seed {seed}'
    with node_under_fire(kind, seed) as under_fire, no_hang(what):
        for number in range(count):
            try:
                under_fire.fire()
            except FuzzError as error:
                raise FuzzError(f'{what}, message {number}: {error}') from None
            if under_fire.errors:
                raise FuzzError(f'{what}, message {number}: {under_fire.errors[0]}')
            signal.alarm(LONGEST)
        if not under_fire.recovers():
            raise FuzzError(f'{what}: after {count} messages and {RECOVERY} good ones of each '
                            'kind it publishes nothing')
        return under_fire
