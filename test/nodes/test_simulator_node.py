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

import signal
import subprocess
import sys
import time

from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Image

from flock_desk.runs.processes import free_udp_port
from flock_follower.nodes.support.conversions import stamp_to_nanoseconds
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


class Ear:
    """A node that keeps raw messages by topic."""

    def __init__(self, **topics):
        self.node = rclpy.create_node('ear')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.raw = {topic: [] for topic in topics}
        for topic, kind in topics.items():
            # Depths to hold all: this machine may be busy with rendering.
            qos = qos_profile_sensor_data if topic in ('image_raw', 'camera_info') else QoSProfile(
                depth=1000)
            self.node.create_subscription(kind, topic, self.raw[topic].append, qos, raw=True)

    def wait(self, child, condition):
        end = time.monotonic() + DEADLINE
        while not condition():
            self.executor.spin_once(timeout_sec=0.05)
            assert time.monotonic() < end and child.poll() is None


def stamps(messages):
    return np.array([stamp_to_nanoseconds(m.header.stamp) for m in messages])


def test_odometry_images_calibration_and_truth_share_their_stamps_and_ctrl_c_ends_it(ros):
    ear = Ear(**TOPICS)
    child = simulator('scenario:=hover')
    try:
        ear.wait(child, lambda: len(ear.raw['image_raw']) >= 20 and len(ear.raw['odom']) >= 150)
        child.send_signal(signal.SIGINT)
        output, errors = child.communicate(timeout=10.0)
    finally:
        child.kill()
        ear.node.destroy_node()
    assert child.returncode == 0 and 'Traceback' not in output + errors
    assert 'waiting for offboard mode and planner/engage' in errors
    messages = {topic: [deserialize_message(data, TOPICS[topic]) for data in received]
                for topic, received in ear.raw.items()}
    assert np.all(np.diff(stamps(messages['odom'])) == 10_000_000)
    for message in messages['odom']:
        assert (message.header.frame_id, message.child_frame_id) == ('odom', 'base_link')
        assert np.all(np.linalg.eigvalsh(np.reshape(message.pose.covariance, (6, 6))) > 0.0)
    images = stamps(messages['image_raw'])
    gaps = np.diff(images) * 30e-9
    assert np.all(np.abs(gaps - np.rint(gaps)) < 1e-6) and np.all(gaps > 0.5)
    for topic in ('truth/odom', 'truth/neighbors', 'camera_info'):
        others = stamps(messages[topic])
        within = images[(images >= others[0]) & (images <= others[-1])]
        # Images and calibrations are sent best effort: some may be lost.
        assert np.isin(within, others).mean() > (0.8 if topic == 'camera_info' else 0.999)
    assert {(m.header.frame_id, m.child_frame_id) for m in messages['truth/neighbors']} == {
        ('odom', 'leader')}
    image, info = messages['image_raw'][-1], messages['camera_info'][0]
    assert (image.width, image.height, image.step, image.encoding) == (640, 480, 640, 'mono8')
    assert image.header.frame_id == info.header.frame_id == 'camera_optical_frame'
    pixels = np.frombuffer(image.data, np.uint8).reshape(480, 640)
    assert list(detect(pixels, 'DICT_4X4_50').ids) == [0]


def test_the_leader_of_one_is_the_vehicle_of_another_and_it_ends_with_that(ros):
    ear = Ear(**{'/behind/truth/neighbors': Odometry})
    ahead = simulator('scenario:=straight', namespace='ahead')
    behind = simulator('scenario:=straight', 'leader_topic:=/ahead/truth/motion',
                       'leader_offset:=[2.0, 0.5, 0.0]', namespace='behind')
    try:
        ((_, seen),) = ear.raw.items()
        ear.wait(behind, lambda: len(seen) >= 5)
        leader = deserialize_message(seen[-1], Odometry).pose.pose.position
        np.testing.assert_allclose([leader.x, leader.y, leader.z], [2.0, 0.5, 1.5], atol=0.05)
        ahead.send_signal(signal.SIGINT)
        output, errors = behind.communicate(timeout=10.0)
        assert behind.returncode == 0 and 'Traceback' not in output + errors
    finally:
        for child in (ahead, behind):
            child.kill()
            child.communicate()
        ear.node.destroy_node()
