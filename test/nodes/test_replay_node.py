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

"""The replay node as a real process: what subscribers receive, and how it ends."""

from collections import defaultdict
from itertools import pairwise
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from rclpy.serialization import deserialize_message
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool

from flock_follower.bags.bag import open_bag, typestore
from flock_follower.bags.writer import BagWriter

REPO = Path(__file__).parents[2]
REAL = REPO.parent / 'shared' / 'data' / 'real'
START = 1_700_000_000_000_000_000
PERIOD = 20_000_000  # ns between the messages of /stamps
COUNT = 50
DEADLINE = 20.0  # s, for what should take a fraction of it


def header(stamp_ns):
    types = typestore().types
    stamp = types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    return types['std_msgs/msg/Header'](stamp, 'odom')


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Give 1 s of headers, images and a latched string."""
    path = tmp_path_factory.mktemp('bags') / 'flight'
    types = typestore().types
    image = types['sensor_msgs/msg/CompressedImage']
    with BagWriter(path, latched=['mode']) as writer:
        writer.write('mode', 'std_msgs/msg/String', START, types['std_msgs/msg/String']('hover'))
        for i in range(COUNT):
            stamp = START + i * PERIOD
            writer.write('stamps', 'std_msgs/msg/Header', stamp, header(stamp))
            if i % 5 == 0:
                writer.write('image_raw/compressed', 'sensor_msgs/msg/CompressedImage', stamp,
                             image(header(stamp), 'jpeg', np.full(50_000, i, np.uint8)))
    return path


@pytest.fixture
def ear():
    """Give a node that keeps whatever it hears, raw, by topic."""
    rclpy.init()
    node = rclpy.create_node('ear')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.received = defaultdict(list)

    def listen(message_type, topic, qos=QoSProfile(depth=1000)):  # noqa: B008
        node.create_subscription(message_type, topic, node.received[topic].append, qos, raw=True)

    def wait(condition, timeout=DEADLINE):
        deadline = time.monotonic() + timeout
        while not condition() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)
        return bool(condition())

    def call(client, request):
        assert wait(client.service_is_ready)
        future = client.call_async(request)
        assert wait(future.done)
        return future.result()

    node.listen, node.wait, node.call = listen, wait, call
    yield node
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def replay():
    """Start replay processes and end those still running."""
    running = []

    def start(*arguments):
        process = subprocess.Popen(
            [sys.executable, '-m', 'flock_follower.nodes.replay', *map(str, arguments)],
            cwd=REPO, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        running.append(process)
        return process

    yield start
    for process in running:
        process.kill()
        process.communicate()


def finish(process):
    """Return exit code, stdout and stderr of a process that ends by itself."""
    out, err = process.communicate(timeout=DEADLINE)
    assert 'Traceback' not in err
    return process.returncode, out, err


def padded(cdr):
    """Return CDR bytes padded to a multiple of 4, as some middlewares deliver them."""
    return cdr + bytes(-len(cdr) % 4)


def clock_ns(raw):
    clock = deserialize_message(raw, Clock).clock
    return clock.sec * 10**9 + clock.nanosec


def header_ns(raw):
    stamp = deserialize_message(raw, Header).stamp
    return stamp.sec * 10**9 + stamp.nanosec


def status(raw):
    return {v.key: v.value for v in deserialize_message(raw, DiagnosticArray).status[0].values}


def playing(*parameters, wait=DEADLINE):
    """Return arguments for a run that starts when every topic played has an ear."""
    return ['--ros-args', '-p', f'wait_for_subscribers:={wait}',
            *(word for parameter in parameters for word in ('-p', parameter))]


def test_subscribers_get_every_message_bit_for_bit_and_a_clock_that_knows_its_stamp(
        bag, ear, replay):
    ear.listen(Header, '/stamps')
    ear.listen(CompressedImage, '/image_raw/compressed')
    ear.listen(String, '/mode')
    ear.listen(Clock, '/clock')
    process = replay(bag, *playing('rate:=2.0'))
    assert ear.wait(lambda: process.poll() is not None)
    code, out, err = finish(process)
    assert (code, err) == (0, '')
    assert f'replayed {COUNT + 11} messages of 3 topics' in out
    assert ear.wait(lambda: len(ear.received['/stamps']) == COUNT)
    with open_bag(bag) as recorded:
        for topic in recorded.topics:
            sent = [padded(m.data) for m in recorded.messages([topic])]
            assert [padded(raw) for raw in ear.received[topic]] == sent
    clocks = [clock_ns(raw) for raw in ear.received['/clock']]
    assert clocks == sorted(clocks) and clocks[0] == START
    assert {START + i * PERIOD for i in range(COUNT)} <= set(clocks)
    assert np.median(np.diff(clocks)) <= 5_500_000  # 200 Hz of bag time between the messages


def test_best_effort_and_late_subscribers_are_served(bag, ear, replay):
    ear.listen(CompressedImage, '/image_raw/compressed', qos_profile_sensor_data)
    process = replay(bag, *playing('loop:=true', 'rate:=5.0', 'wait_for:=[image_raw/compressed]'))
    assert ear.wait(lambda: ear.received['/image_raw/compressed'])
    ear.listen(String, '/mode', QoSProfile(
        depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    assert ear.wait(lambda: ear.received['/mode'])
    assert process.poll() is None


def test_start_duration_and_topics_choose_what_is_played_latched_messages_included(
        bag, ear, replay):
    ear.listen(Header, '/stamps')
    ear.listen(String, '/mode')
    process = replay(bag, *playing('start:=0.5', 'duration:=0.2', 'topics:=[stamps, /mode]'))
    assert ear.wait(lambda: process.poll() is not None)
    assert finish(process)[0] == 0
    assert ear.wait(lambda: len(ear.received['/stamps']) == 10 and ear.received['/mode'])
    assert [header_ns(raw) for raw in ear.received['/stamps']] == [
        START + i * PERIOD for i in range(25, 35)]
    assert deserialize_message(ear.received['/mode'][0], String).data == 'hover'


def test_namespace_and_remaps_apply_and_the_clock_can_be_left_out(bag, ear, replay):
    for kind, topic in ((Header, '/drone/vio'), (CompressedImage, '/drone/camera'),
                        (String, '/mode_out'), (Clock, '/clock')):
        ear.listen(kind, topic)
    process = replay(bag, *playing(
        "remap:=['/stamps:=vio', 'image_raw/compressed:=camera']", 'rate:=10.0', 'clock:=false'),
        '-r', '__ns:=/drone', '-r', '/drone/mode:=/mode_out')
    assert ear.wait(lambda: process.poll() is not None)
    assert finish(process)[0] == 0
    assert ear.wait(lambda: [len(ear.received[t]) for t in (
        '/drone/vio', '/drone/camera', '/mode_out')] == [COUNT, 10, 1])
    assert not ear.received['/clock']


def test_pause_stops_messages_and_clock_and_resume_goes_on(bag, ear, replay):
    ear.listen(Header, '/stamps')
    ear.listen(Clock, '/clock')
    process = replay(bag, *playing('paused:=true', 'wait_for:=[stamps]'))
    client = ear.create_client(SetBool, 'replay/pause')
    answer = ear.call(client, SetBool.Request(data=True))
    assert answer.success and answer.message == 'paused at 0.00 s'
    ear.wait(lambda: len(ear.received['/stamps']) > 1, timeout=0.5)
    assert not ear.received['/stamps']
    assert {clock_ns(raw) for raw in ear.received['/clock']} <= {START}
    assert ear.call(client, SetBool.Request(data=False)).message == 'playing at 0.00 s'
    assert ear.wait(lambda: len(ear.received['/stamps']) > 5)
    ear.call(client, SetBool.Request(data=True))
    ear.wait(lambda: False, timeout=0.2)  # hear out what was under way
    received, ticks = len(ear.received['/stamps']), len(ear.received['/clock'])
    ear.wait(lambda: False, timeout=0.3)
    assert (len(ear.received['/stamps']), len(ear.received['/clock'])) == (received, ticks)
    ear.call(client, SetBool.Request(data=False))
    assert ear.wait(lambda: process.poll() is not None)
    assert finish(process)[0] == 0
    assert ear.wait(lambda: len(ear.received['/stamps']) == COUNT)


def test_a_loop_steps_the_clock_back_reports_its_state_and_ends_on_sigterm(bag, ear, replay):
    ear.listen(Header, '/stamps')
    ear.listen(Clock, '/clock')
    ear.listen(DiagnosticArray, '/diagnostics')
    # Not so fast that a subscriber who is held up for a moment loses ticks of the clock.
    process = replay(bag, *playing('loop:=true', 'rate:=2.0', 'wait_for:=[stamps]'))

    def jumps():
        clocks = [clock_ns(raw) for raw in ear.received['/clock']]
        return [after for before, after in pairwise(clocks) if after < before]

    assert ear.wait(lambda: len(jumps()) >= 2)
    assert START in jumps()  # the jump itself is published before any message
    # On a busy machine a subscriber may lose the first ticks.
    assert max(jumps()) < START + 200_000_000
    assert ear.wait(lambda: [header_ns(m) for m in ear.received['/stamps']].count(START) >= 3)
    client = ear.create_client(SetParameters, '/replay/set_parameters')
    faster = Parameter('rate', value=20.0).to_parameter_msg()
    assert ear.call(client, SetParameters.Request(parameters=[faster])).results[0].successful
    ear.received['/diagnostics'].clear()
    assert ear.wait(lambda: any(status(m)['rate'] == '20.0' for m in ear.received['/diagnostics']))
    values = status(ear.received['/diagnostics'][-1])
    assert int(values['loops']) >= 2
    assert int(values['published /stamps']) >= 2 * COUNT
    assert 0.0 <= float(values['position_s']) <= 1.0
    assert float(values['lateness_p99_ms']) >= 0.0 and float(values['dropped_backlog_s']) >= 0.0
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=DEADLINE)
    # Where others take the processor, the deadline of the shutdown may come first.
    busy = os.getloadavg()[0] > (os.cpu_count() or 1)
    assert process.returncode == 0 or (busy and process.returncode == -signal.SIGALRM)
    assert err == ''


def test_statements_and_commands_of_the_recorded_system_are_played_only_if_named(
        tmp_path, ear, replay):
    types = typestore().types
    with BagWriter(tmp_path / 'bag') as writer:
        for topic in ('mode', '/rosout', '/drone1/command/trajectory'):
            writer.write(topic, 'std_msgs/msg/String', START, types['std_msgs/msg/String'](topic))
    ear.listen(String, '/mode')
    process = replay(tmp_path / 'bag', *playing('rate:=10.0'))
    assert ear.wait(lambda: process.poll() is not None)
    code, out, err = finish(process)
    assert code == 0
    assert 'replayed 1 messages of 1 topics' in out
    assert 'not played unless named: /drone1/command/trajectory, /rosout' in err


def test_ros1_topics_of_unknown_type_are_named_and_left_out(tmp_path, ear, replay):
    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg('float32 size', 'zoo_msgs/msg/Animal'))
    with Rosbag1Writer(tmp_path / 'old.bag') as writer:
        for topic, msgtype, value in (('/zoo', 'zoo_msgs/msg/Animal', 3.0),
                                      ('/mode', 'std_msgs/msg/String', 'hover')):
            connection = writer.add_connection(topic, msgtype, typestore=types)
            writer.write(connection, START, types.serialize_ros1(
                types.types[msgtype](value), msgtype))
    ear.listen(String, '/mode')
    process = replay(tmp_path / 'old.bag', *playing())
    assert ear.wait(lambda: process.poll() is not None)
    code, _, err = finish(process)
    assert code == 0
    assert 'topic /zoo is not played: type zoo_msgs/msg/Animal does not exist' in err
    assert ear.wait(lambda: ear.received['/mode'])
    assert deserialize_message(ear.received['/mode'][0], String).data == 'hover'


@pytest.mark.parametrize(('name', 'height'), [
    ('ubiq_aruco_images.bag', 960), ('ubiq_aruco_marker.bag', 720)])
def test_real_ros1_bags_arrive_as_ros2_messages(ear, replay, name, height):
    if not (REAL / name).exists():
        pytest.skip(f'{REAL / name} is not there')
    ear.listen(CompressedImage, '/image_raw/compressed')
    ear.listen(CameraInfo, '/camera_info')
    process = replay(REAL / name, *playing(
        "remap:=['/raspicam_node/image/compressed:=image_raw/compressed', "
        "'/raspicam_node/camera_info:=camera_info']"))
    assert ear.wait(lambda: process.poll() is not None)
    assert finish(process)[0] == 0
    assert ear.wait(lambda: ear.received['/image_raw/compressed'] and ear.received['/camera_info'])
    image = deserialize_message(ear.received['/image_raw/compressed'][0], CompressedImage)
    assert image.header.frame_id == 'raspicam'
    assert bytes(image.data[:3]) == b'\xff\xd8\xff'
    info = deserialize_message(ear.received['/camera_info'][0], CameraInfo)
    assert (info.width, info.height, info.distortion_model) == (1280, height, 'plumb_bob')
    assert info.k[8] == 1.0 and info.k[0] > 1000.0
