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

"""The view node: what it takes and when, where it draws, and which services its buttons call."""

from __future__ import annotations

from collections.abc import Iterator
import socket
import subprocess
import sys
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from driven import Driven, overrides, to_odometry
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import BatteryState, CameraInfo, CompressedImage, Image, Range
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from flock_follower.geometry import IDENTITY_QUATERNION, Transform
from flock_follower.messages.command_writer import trajectory
from flock_follower.messages.commands import Command
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp
from flock_follower.nodes.view import IDLE_PERIOD, PERIOD, View
from flock_follower.system.fast_dds import PROFILE_VARIABLES

STAMP = 1_700_000_000 * 10**9
STILL = (0.0, 0.0, 0.0)


class Pages:
    """Stands in for the server."""

    def __init__(self) -> None:
        self.pages, self.greets = 0, False
        self.states: list[dict[str, Any]] = []
        self.images: list[bytes] = []
        self.answers: list[tuple[str, bool, str]] = []
        self.send_state, self.send_image = self.states.append, self.images.append

    def send_answer(self, *answer: Any) -> None:
        self.answers.append(answer)

    def stop(self) -> None:
        """Do nothing."""


class Rig(Driven):
    """The node with a stand-in for its server."""

    def __init__(self, **values: Any) -> None:
        super().__init__(View(namespace='one', parameter_overrides=overrides(port=0, **values)))
        self.node._server.stop()
        self.pages = self.node._server = Pages()

    def topics(self) -> set[str]:
        """Return the topics that are subscribed, but for those of every node."""
        return {s.topic_name.removeprefix('/one/') for s in self.node.subscriptions
                } - {'/parameter_events', '/clock'}

    def show(self) -> dict[str, Any]:
        """Take a turn with a page open; return its state."""
        self.pages.pages = 1
        self.node._turn()
        return self.pages.states[-1]

    def report(self, node: str, level: bytes = DiagnosticStatus.OK, message: str = 'running',
               **values: str) -> None:
        self.give('/diagnostics', DiagnosticArray(status=[DiagnosticStatus(
            name=node, level=level, message=message,
            values=[KeyValue(key=key, value=value) for key, value in values.items()])]))

    def place(self, topic: str, child: str, position: Any, stamp: int = STAMP) -> None:
        self.give(topic, to_odometry(
            nanoseconds_to_stamp(stamp), 'odom', child, position, IDENTITY_QUATERNION, STILL,
            STILL, 1e-4 * np.eye(6), 1e-4 * np.eye(6)))


@pytest.fixture
def rig(ros: None) -> Iterator[Rig]:
    made = Rig(control=True)
    yield made
    made.close()


ALWAYS = {'/diagnostics', 'planner/state', 'mavlink_bridge/state', 'planner/distance',
          'mavlink/battery'}
WATCHED = {'odom', 'mavlink/relative', 'neighbors', 'neighbors/heard', 'command/trajectory',
           'camera_info', 'image_raw'}


def test_images_and_odometry_are_subscribed_while_a_page_is_open(rig: Rig) -> None:
    for _ in range(2):
        rig.node._turn()
        assert rig.topics() == ALWAYS
        assert rig.node._timer.timer_period_ns == IDLE_PERIOD * 1e9
        rig.show()
        assert rig.topics() == ALWAYS | WATCHED
        assert rig.node._timer.timer_period_ns == PERIOD * 1e9
        rig.pages.pages = 0


def test_the_messages_of_a_flight_are_on_the_page(rig: Rig) -> None:
    rig.show()
    rig.give('planner/state', String(data='TRACK'))
    rig.give('mavlink_bridge/state', String(data='ACTIVE'))
    rig.give('planner/distance', Range(range=2.25))
    rig.give('mavlink/battery', BatteryState(percentage=0.5, voltage=15.0))
    rig.give('command/trajectory', trajectory(make, Command(np.ones(3), 0.0, frame='odom')))
    rig.place('odom', 'base_link', (1.0, 2.0, 3.0))
    rig.place('neighbors', 'leader', (3.0, 2.0, 3.0))
    rig.report('one/planner', state='TRACK', limits='a_max', nearest_m='1.0', farthest_m='2.8')
    rig.report('two/planner', state='HOLD')
    rig.report('one/mavlink_bridge', DiagnosticStatus.WARN, 'set it to 3', mode='OFFBOARD')
    page = rig.show()
    assert (page['state'], page['limits'], page['band']) == ('TRACK', 'a_max', [1.0, 2.8])
    assert (page['bridge']['state'], page['bridge']['mode']) == ('ACTIVE', 'OFFBOARD')
    assert page['distance']['m'] == 2.25 and page['battery']['share'] == 0.5
    assert (page['own'], page['neighbors']) == ([1.0, 2.0], {'leader': [3.0, 2.0]})
    assert [one['text'] for one in page['warnings']] == ['set it to 3']
    assert {'follower', 'leader', 'command'} <= {shape['n'] for shape in page['scene']}


def test_invalid_or_large_message_is_counted_node_goes_on(rig: Rig) -> None:
    rig.show()
    rig.place('odom', 'base_link', (np.nan, 0.0, 0.0))
    rig.give('planner/state', String(data='x' * 100_000))
    assert rig.counters == {'invalid odom': 1, 'too large planner/state': 1}
    assert rig.show()['own'] is None


def test_bytes_that_are_no_message_are_invalid_page_goes_on(rig: Rig) -> None:
    rig.show()
    for topic in ('planner/state', 'image_raw'):
        next(s for s in rig.node.subscriptions if s.topic_name == f'/one/{topic}').callback(b'??')
    shown = len(rig.pages.states)
    rig.show()
    assert len(rig.pages.states) == shown + 1
    assert rig.counters == {'invalid planner/state': 1, 'invalid image': 1}


def test_own_place_is_that_of_base_link_for_each_child_frame(rig: Rig) -> None:
    rig.show()
    rig.node._static.frames.add('base_link', 'imu', Transform(np.eye(3), np.array([0.5, 0, 0])))
    for k, (child, x) in enumerate((('imu', 0.5), ('base_link', 1.0), ('imu', 0.5))):
        rig.place('odom', child, (1.0, 2.0, 3.0), STAMP + k * 10_000_000)
        assert rig.show()['own'] == [x, 2.0]


def test_covariance_that_no_ellipsoid_has_leaves_the_page(rig: Rig) -> None:
    rig.show()
    rig.place('odom', 'base_link', (1.0, 2.0, 3.0))
    rig.give('neighbors/heard', to_odometry(
        nanoseconds_to_stamp(STAMP), 'odom', 'leader', (3.0, 2.0, 3.0), IDENTITY_QUATERNION,
        STILL, STILL, 1.7e308 * np.ones((6, 6)), np.eye(6)))
    shapes = {shape['n'] for shape in rig.show()['scene']}
    assert 'leader' in shapes and 'leader covariance' not in shapes


@pytest.mark.parametrize('compressed', [False, True])
def test_the_estimate_is_drawn_where_the_camera_sees_it(rig: Rig, compressed: bool) -> None:
    if compressed:
        rig.node._names = lambda: {'odom': 'odom', 'camera_info': 'camera_info',
                                   'image_raw': 'image_raw/compressed', 'compressed': 'yes'}
    rig.show()
    gray = np.full((480, 640), 90, np.uint8)
    k = [400.0, 0.0, 320.0, 0.0, 400.0, 240.0, 0.0, 0.0, 1.0]
    rig.give('camera_info', CameraInfo(width=640, height=480, k=k, d=[0.0] * 5,
                                       distortion_model='plumb_bob'))
    for stamp in (STAMP - 10**7, STAMP + 10**7):
        rig.place('odom', 'base_link', (5.0, 0.0, 1.0), stamp)
    # 2 m ahead of the camera, which is 0.1 m ahead of the body, and 0.5 m to the left.
    rig.place('neighbors', 'leader', (7.1, 0.5, 1.0))
    image = (CompressedImage(format='png', data=cv2.imencode('.png', gray)[1].tobytes())
             if compressed else
             Image(width=640, height=480, step=640, encoding='mono8', data=gray.tobytes()))
    image.header.stamp = nanoseconds_to_stamp(STAMP)
    rig.give('image_raw/compressed' if compressed else 'image_raw', image)
    rig.show()
    (jpeg,) = rig.pages.images
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)
    marked = np.argwhere(np.ptp(picture, axis=2) > 60)[:, ::-1]
    box = marked[marked[:, 1] > 215]  # without the name above
    assert box.mean(axis=0) == pytest.approx([320 - 400 * 0.5 / 2.0, 240], abs=10)
    rig.show()
    assert len(rig.pages.images) == 1  # each is sent once


def test_an_image_of_another_size_is_counted(rig: Rig) -> None:
    rig.show()
    rig.give('camera_info', CameraInfo(width=640, height=480, d=[0.0] * 5, k=[
        400.0, 0.0, 320.0, 0.0, 400.0, 240.0, 0.0, 0.0, 1.0], distortion_model='plumb_bob'))
    rig.give('image_raw', Image(width=2, height=1, step=2, encoding='mono8', data=b'ab'))
    rig.show()
    assert rig.counters == {'invalid image': 1} and not rig.pages.images


def test_names_and_mounting_are_those_of_relative_pose(rig: Rig) -> None:
    other = Node('relative_pose', namespace='one')
    for kind, topic in ((CompressedImage, '/cam/compressed'), (CameraInfo, '/cam/info'),
                        (Odometry, '/vio'), (Odometry, 'mavlink/relative')):
        other.create_subscription(kind, topic, lambda message: None, 1)
    rig.wait(lambda: len(rig.node._names().keys() & {'odom'}) and rig.node._names() == {
        'odom': '/vio', 'camera_info': '/cam/info', 'image_raw': '/cam/compressed',
        'compressed': 'yes'})
    rig.show()
    assert {'/cam/compressed', '/cam/info', '/vio'} <= rig.topics()
    rig.node._perception.take({'cameras': [''], 'camera_position': [0.0, 0.0, 0.5],
                               'camera_rpy': [0.0, 0.0, 1.0], 'rectified': True,
                               'odom_child_position': [0.1, 0.0, 0.0]})
    assert rig.node._mounting.translation.tolist() == [0.0, 0.0, 0.5]
    assert rig.node._camera.rectified and rig.node._source.params.child_position[0] == 0.1
    rig.node._perception.take({'cameras': ['left', 'right'], **{
        f'camera.{name}.{key}': value for name in ('left', 'right') for key, value in (
            ('image', f'{name}/mono'), ('camera_info', f'{name}/info'),
            ('position', [0.0, 0.2, 0.0]), ('rpy', [0.0, 0.0, float(name == 'left')]),
            ('rectified', False), ('time_offset', 0.0), ('readout_time', 0.0))}})
    assert {'left/mono', 'left/info'} <= rig.topics()
    rig.node._perception.take({**rig.node._perception.values, 'image_transport': 'compressed'})
    assert 'left/mono/compressed' in rig.topics()
    other.destroy_node()


@pytest.mark.parametrize(('button', 'request_type', 'wanted'), [
    ('brake', SetBool, SetBool.Request(data=False)), ('land', Trigger, Trigger.Request())])
def test_each_button_press_calls_service_and_shows_answer(
        rig: Rig, button: str, request_type: Any, wanted: Any) -> None:
    client = rig.node._callers[button]
    assert client.srv_type is request_type
    called: list[Any] = []
    futures = [Future(), Future()]
    client.call_async = lambda request: called.append(request) or futures[len(called) - 1]
    client.service_is_ready = lambda: True
    for _ in range(2):
        rig.node._press(button)
        rig.show()
    assert called == [wanted, wanted] and not rig.pages.answers
    futures[1].set_result(request_type.Response(success=False, message='refused: <b>'))
    for _ in range(2):
        rig.show()
    assert rig.pages.answers == [(button, False, 'refused: <b>')]


def test_a_button_without_its_node_is_answered(rig: Rig) -> None:
    rig.node._press('land')
    rig.show()
    assert rig.pages.answers == [('land', False, 'no answer of mavlink_bridge/land')]


def test_node_without_control_has_parameter_clients_only(ros: None) -> None:
    made = Rig()
    assert {client.srv_name.rpartition('/')[2] for client in made.node.clients} == {
        'list_parameters', 'get_parameters'}
    made.close()


def ended(code: str, *values: str) -> tuple[int, str, str]:
    """Return exit code, output and errors of the node in a process of its own."""
    ran = subprocess.run(
        [sys.executable, '-c', f'{code}; from flock_follower.nodes.view import main; '
         'import sys; sys.exit(main())', '--ros-args', *(w for v in values for w in ('-p', v))],
        capture_output=True, text=True, check=False, timeout=60.0)
    # Fast DDS 3 deprecates the variable that Fast DDS 2 needs.
    lines = [line for line in ran.stderr.splitlines(True) if PROFILE_VARIABLES[1] not in line]
    return ran.returncode, ran.stdout, ''.join(lines)


def test_a_busy_port_is_one_line() -> None:
    with socket.socket() as busy:
        busy.bind(('127.0.0.1', 0))
        busy.listen()
        port = busy.getsockname()[1]
        assert ended('pass', f'port:={port}') == (
            1, '', f'error: view: 127.0.0.1 port {port}: in use: set port:={port + 1}\n')


def test_a_missing_library_is_one_line() -> None:
    code, out, error = ended("import sys; sys.modules['aiohttp'] = None", 'port:=0')
    assert (code, out, error.count('\n')) == (1, '', 1) and 'pip install aiohttp' in error
