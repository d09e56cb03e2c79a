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

from contextlib import nullcontext
import signal
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import Mock

from nav_msgs.msg import Odometry
import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String

from flock_desk.runs.processes import free_udp_port, TooBusyError, wait_until
from flock_desk.simulator_node import ExternalVehicle, Simulator
from flock_follower.checks.processor import Load
from flock_follower.messages import stamp_to_nanoseconds
from flock_follower.perception.markers import detect

DEADLINE = 40.0  # s, for what should take a few
TOPICS = {'image_raw': Image, 'camera_info': CameraInfo, 'odom': Odometry,
          'truth/odom': Odometry, 'truth/neighbors': Odometry}


@pytest.mark.parametrize('load', [Load(0.5, 1.5, 2), Load(0.01, 0.1, 2), None])
def test_flight_behind_clock_is_excused_by_load_alone(load):
    meter = SimpleNamespace(worst=lambda: load)
    expected = (pytest.raises(TooBusyError, match='^9 images lost: for 50% of the worst 2 s')
                if load is not None and load.busy else nullcontext())
    with expected:
        Simulator._blame(SimpleNamespace(_load=meter), '9 images lost')
    Simulator._blame(SimpleNamespace(_load=None), '9 images lost')  # end_if_busy is false


def test_flight_ended_by_bridge_is_over_once_landed_and_logged():
    follower, log = SimpleNamespace(armed=True, motion=SimpleNamespace(times=[])), Mock()
    node = SimpleNamespace(
        _vehicle=Mock(spec=ExternalVehicle), _early=None, _duration=60.0, _ahead=None, _log=log,
        _flight=SimpleNamespace(began_ns=10**10, skipped_images=0), _start=100.0, _epoch_ns=0,
        _external=SimpleNamespace(follower=follower, sources={}), _values={'log': 'flight.npz'})
    for seconds, state in ((-1.0, 'READY: no obstacle'), (0.5, 'ACTIVE'), (1.0, 'NO_AUTOPILOT'),
                           (3.0, 'TAKEN_OVER: the pilot took over'), (3.1, 'INACTIVE: landed')):
        node._flight.time, node._flight.time_ns = seconds, 10**10 + round(seconds * 1e9)
        Simulator._take_permission(node, String(data=state))
        assert not Simulator._finished(node)
    follower.armed = False
    assert Simulator._finished(node)
    Simulator._save_log(node)
    saved = log.save.call_args.kwargs
    assert (saved['began'], saved['ended'], saved['duration'], saved['ended_early']) == (
        110.0, 113.0, 60.0, 'TAKEN_OVER: the pilot took over')


def test_simulator_topics_share_stamps_and_ctrl_c_ends_it(
        ros, tmp_path):
    ear, executor = rclpy.create_node('ear'), SingleThreadedExecutor()
    executor.add_node(ear)
    raw = {topic: [] for topic in TOPICS}
    for topic, kind in TOPICS.items():
        # Depths to hold all: this machine may be busy with rendering.
        qos = qos_profile_sensor_data if topic in ('image_raw', 'camera_info') else QoSProfile(
            depth=1000)
        ear.create_subscription(kind, topic, raw[topic].append, qos, raw=True)
    child = subprocess.Popen(
        [sys.executable, '-m', 'flock_desk.simulator_node', '--ros-args', '-p',
         'scenario:=hover', '-p', f'connection:=127.0.0.1:{free_udp_port()}',
         '-p', f'log:={tmp_path / "flight.npz"}'],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)

    def received():
        for _ in range(100):
            executor.spin_once(timeout_sec=0.001)
        return len(raw['image_raw']) >= 20 and len(raw['odom']) >= 150
    try:
        wait_until(received, DEADLINE, 'images and odometry')
        child.send_signal(signal.SIGINT)
        output, errors = child.communicate(timeout=10.0)
    finally:
        child.kill()
        ear.destroy_node()
    assert child.returncode == 0 and 'Traceback' not in output + errors
    assert (tmp_path / 'flight.npz').is_file()  # what was flown is judged
    messages = {topic: [deserialize_message(data, TOPICS[topic]) for data in found]
                for topic, found in raw.items()}
    times = {topic: np.array([stamp_to_nanoseconds(m.header.stamp) for m in found])
             for topic, found in messages.items()}
    apart = np.diff(times['odom']) / 10_000_000
    # A busy machine may overwrite one that waits to be sent.
    assert np.all((apart % 1.0 == 0.0) & (apart > 0.0)) and np.mean(apart == 1.0) > 0.99
    images = times['image_raw']
    for topic in ('truth/odom', 'truth/neighbors', 'camera_info'):
        within = images[(images >= times[topic][0]) & (images <= times[topic][-1])]
        # Images and calibrations are sent best effort: some may be lost.
        assert np.isin(within, times[topic]).mean() > (0.8 if topic == 'camera_info' else 0.999)
    odom, leader = messages['odom'][-1], messages['truth/neighbors'][0]
    assert (odom.header.frame_id, odom.child_frame_id) == ('odom', 'base_link')
    assert np.all(np.linalg.eigvalsh(np.reshape(odom.pose.covariance, (6, 6))) > 0.0)
    assert (leader.header.frame_id, leader.child_frame_id) == ('odom', 'leader')
    image = messages['image_raw'][-1]
    pixels = np.frombuffer(image.data, np.uint8).reshape(480, 640)
    assert image.encoding == 'mono8' and list(detect(pixels, 'DICT_4X4_50').ids) == [0]
