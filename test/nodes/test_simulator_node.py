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

"""The simulator node as a real process: what subscribers receive, and what it refuses."""

from collections import defaultdict
import signal
import subprocess
import sys
import time

from nav_msgs.msg import Odometry
import numpy as np
from odometry_series import states
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Image

from flock_desk.runs.processes import free_udp_port
from flock_follower.nodes.support.conversions import stamp_to_nanoseconds
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.markers import detect

DEADLINE = 40.0  # s, for what should take a few
TOPICS = {'image_raw': Image, 'camera_info': CameraInfo, 'odom': Odometry,
          'truth/odom': Odometry, 'truth/neighbors': Odometry}


def simulator(*parameters, namespace=''):
    arguments = [word for p in (f'connection:=127.0.0.1:{free_udp_port()}', *parameters)
                 for word in ('-p', p)]
    arguments += ['-r', f'__ns:=/{namespace}'] if namespace else []
    return subprocess.Popen(
        [sys.executable, '-m', 'flock_desk.simulator_node', '--ros-args', *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


@pytest.fixture(scope='module')
def seen_messages():
    """Give a second of what the simulator publishes, by topic, and how it ended."""
    rclpy.init()
    node = rclpy.create_node('ear')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    raw = defaultdict(list)
    for topic, message_type in TOPICS.items():
        # Depths to hold all: this machine may be busy with rendering.
        qos = qos_profile_sensor_data if topic in ('image_raw', 'camera_info') else QoSProfile(
            depth=1000)
        node.create_subscription(message_type, topic, raw[topic].append, qos, raw=True)
    child = simulator('scenario:=hover')
    try:
        deadline = time.monotonic() + DEADLINE
        while len(raw['image_raw']) < 20 or len(raw['odom']) < 150:
            assert time.monotonic() < deadline and child.poll() is None
            executor.spin_once(timeout_sec=0.05)
        child.send_signal(signal.SIGINT)
        output, errors = child.communicate(timeout=10.0)
    finally:
        child.kill()
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()
    messages = {topic: [deserialize_message(data, TOPICS[topic]) for data in received]
                for topic, received in raw.items()}
    return messages, child.returncode, output, errors


def stamps(messages):
    return np.array([stamp_to_nanoseconds(m.header.stamp) for m in messages])


def test_it_ends_on_ctrl_c_without_a_traceback(seen_messages):
    _, code, output, errors = seen_messages
    assert code == 0
    assert 'Traceback' not in output + errors
    assert 'waiting for offboard mode and planner/engage' in errors


def test_odometry_has_a_stamp_every_10_ms(seen_messages):
    odometry = seen_messages[0]['odom']
    assert np.all(np.diff(stamps(odometry)) == 10_000_000)
    for message in odometry:
        assert (message.header.frame_id, message.child_frame_id) == ('odom', 'base_link')
        covariance = np.reshape(message.pose.covariance, (6, 6))
        assert np.all(np.linalg.eigvalsh(covariance) > 0.0)


def test_every_image_has_its_calibration_and_its_truth_on_the_same_stamp(seen_messages):
    messages = seen_messages[0]
    images = stamps(messages['image_raw'])
    gaps = np.diff(images) * 30e-9
    assert np.all(np.abs(gaps - np.rint(gaps)) < 1e-6) and np.all(gaps > 0.5)
    for topic in ('truth/odom', 'truth/neighbors', 'camera_info'):
        others = stamps(messages[topic])
        within = images[(images >= others[0]) & (images <= others[-1])]
        # Images and calibrations are sent best effort: some may be lost.
        assert np.isin(within, others).mean() > (0.8 if topic == 'camera_info' else 0.999)
    assert {m.child_frame_id for m in messages['truth/neighbors']} == {'leader'}
    assert {m.header.frame_id for m in messages['truth/neighbors']} == {'odom'}


def test_images_are_mono8_and_show_the_marker_where_truth_projects(seen_messages):
    messages = seen_messages[0]
    own, leader = (states(messages[f'truth/{name}']) for name in ('odom', 'neighbors'))
    info = messages['camera_info'][0]
    camera = CameraModel.from_calibration(
        info.k, info.d, info.distortion_model, info.width, info.height)
    checked = 0
    for image in messages['image_raw'][::5]:
        assert (image.width, image.height, image.step) == (640, 480, 640)
        assert image.encoding == 'mono8' and len(image.data) == 640 * 480
        assert image.header.frame_id == info.header.frame_id == 'camera_optical_frame'
        stamp = stamp_to_nanoseconds(image.header.stamp)
        if stamp not in own.stamps or stamp not in leader.stamps:
            continue
        pixels = np.frombuffer(image.data, np.uint8).reshape(480, 640)
        seen = detect(pixels, 'DICT_4X4_50')
        assert list(seen.ids) == [0]
        # Both hover facing along x: the marker is 0.2 m this side of the leader, the camera
        # 0.1 m ahead of the follower; optical axes are -y, -z, x.
        x, y, z = leader.at(stamp)[0] - own.at(stamp)[0] - [0.3, 0.0, 0.0]
        middle = camera.project([[-y, -z, x]])[0]
        assert seen.corners[0].mean(axis=0) == pytest.approx(middle, abs=8.0)  # px
        checked += 1
    assert checked >= 2


def test_the_leader_of_one_is_the_vehicle_of_another_and_it_ends_with_that():
    rclpy.init()
    node = rclpy.create_node('ear')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    seen = []
    node.create_subscription(Odometry, '/behind/truth/neighbors', seen.append, 10)
    ahead = simulator('scenario:=straight', namespace='ahead')
    behind = simulator('scenario:=straight', 'leader_topic:=/ahead/truth/motion',
                       'leader_offset:=[2.0, 0.5, 0.0]', namespace='behind')
    try:
        deadline = time.monotonic() + DEADLINE
        while len(seen) < 5:
            assert time.monotonic() < deadline
            assert behind.poll() is None, behind.communicate()
            executor.spin_once(timeout_sec=0.05)
        leader = seen[-1].pose.pose.position
        np.testing.assert_allclose([leader.x, leader.y, leader.z], [2.0, 0.5, 1.5], atol=0.05)
        ahead.send_signal(signal.SIGINT)
        output, errors = behind.communicate(timeout=10.0)
        assert behind.returncode == 0 and 'Traceback' not in output + errors
    finally:
        for child in (ahead, behind):
            child.kill()
            child.communicate()
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()
