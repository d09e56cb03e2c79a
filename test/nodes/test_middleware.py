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

"""Planner and bridge keep off shared memory, in which other processes can make them wait."""

import os
import subprocess
import sys
from unittest import mock

import pytest

from flock_follower.files import resource
from flock_follower.nodes import mavlink_bridge, planner
from flock_follower.nodes.support.middleware import (
    avoid_shared_memory,
    avoid_shared_memory_for_images,
    DEFAULT_SEGMENT,
    IMAGES_BUFFER,
    open_to_network,
    segment_size,
)

PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
UDP_IMAGES, IMAGES = (str(resource(f'config/{name}')) for name in (
    'fastdds_udp_images.xml', 'fastdds_images.xml'))
OWN, UDP = (str(resource(f'config/{name}')) for name in ('fastdds.xml', 'fastdds_udp.xml'))
LOOK = """
import os
import sys
from flock_follower.nodes.support.middleware import avoid_shared_memory, shares_memory
if sys.argv[1] == 'avoid':
    avoid_shared_memory(os.environ)
import rclpy
rclpy.init()
node = rclpy.create_node('looks')
print(shares_memory())
node.destroy_node()
rclpy.shutdown()
"""


@pytest.mark.parametrize(('given', 'changed'), [
    ({}, {TRANSPORTS: 'UDPv4'}),
    ({RANGE: 'SUBNET', 'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp'}, {TRANSPORTS: 'UDPv4'}),
    ({RANGE: 'localhost'}, {RANGE: 'SYSTEM_DEFAULT', PROFILE: UDP}),
    ({'ROS_LOCALHOST_ONLY': '1'},
     {'ROS_LOCALHOST_ONLY': None, RANGE: 'SYSTEM_DEFAULT', PROFILE: UDP}),
    ({RANGE: 'LOCALHOST', PROFILE: OWN}, {RANGE: 'SYSTEM_DEFAULT', PROFILE: UDP}),
    ({PROFILE: OWN}, {PROFILE: UDP}),
    ({RANGE: 'LOCALHOST', TRANSPORTS: 'LARGE_DATA'}, {}),
    ({RANGE: 'LOCALHOST', 'ROS_STATIC_PEERS': '10.0.0.2'}, {}),
    ({'ROS_STATIC_PEERS': '10.0.0.2'}, {TRANSPORTS: 'UDPv4'}),
    ({PROFILE: '/of/the/user.xml'}, {TRANSPORTS: 'UDPv4'}),
    ({PROFILE: '/of/the/user.xml', RANGE: 'LOCALHOST'}, {}),
    ({PROFILE: str(resource('config/follower.yaml')), RANGE: 'LOCALHOST'}, {}),
    ({'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp', RANGE: 'LOCALHOST'}, {})])
def test_only_what_the_user_left_open_is_set(given, changed):
    environment = dict(given)
    avoid_shared_memory(environment)
    expected = {**given, **changed}
    assert environment == {name: value for name, value in expected.items() if value is not None}


@pytest.mark.parametrize(('given', 'changed'), [
    ({}, {TRANSPORTS: 'UDPv4', PROFILE: IMAGES}),
    ({RANGE: 'LOCALHOST'}, {RANGE: 'SYSTEM_DEFAULT', PROFILE: UDP_IMAGES}),
    ({PROFILE: '/of/the/user.xml'}, {TRANSPORTS: 'UDPv4'})])
def test_images_come_without_where_the_kernel_has_room_for_them(given, changed):
    environment = dict(given)
    assert not avoid_shared_memory_for_images(environment, 212_992)
    assert environment == given
    assert avoid_shared_memory_for_images(environment, IMAGES_BUFFER)
    assert environment == {**given, **changed}


@pytest.mark.parametrize(('avoid', 'range_', 'shares'), [
    ('avoid', 'LOCALHOST', False), ('avoid', 'OFF', False), ('no', 'LOCALHOST', True)])
def test_fast_dds_opens_no_shared_memory(avoid, range_, shares):
    # Another test of this worker may have set the transport.
    environment = {**os.environ, RANGE: range_, PROFILE: OWN}
    environment.pop(TRANSPORTS, None)
    if range_ == 'OFF':  # as for the whole subnet, without being heard there
        del environment[PROFILE]
    looked = subprocess.run([sys.executable, '-c', LOOK, avoid], env=environment, text=True,
                            capture_output=True, timeout=30.0)
    assert looked.stdout == f'{shares}\n', looked.stderr


@pytest.mark.parametrize('module', [mavlink_bridge, planner])
def test_the_bridge_and_the_planner_run_without(module, monkeypatch):
    profiles = []
    monkeypatch.setattr(module, 'never_block_output', list, raising=False)
    monkeypatch.setattr(module, 'run', lambda *_: profiles.append(os.environ[PROFILE]))
    with mock.patch.dict(os.environ, {PROFILE: OWN}):
        module.main([])
    assert profiles == [UDP]


@pytest.mark.parametrize(('given', 'found'), [
    ({}, True), ({RANGE: 'SUBNET'}, True), ({RANGE: 'SYSTEM_DEFAULT'}, True),
    ({'ROS_STATIC_PEERS': '10.0.0.2'}, True),
    ({RANGE: 'SUBNET', PROFILE: '/of/the/user.xml'}, True),
    ({PROFILE: OWN, 'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}, True),
    ({'ROS_LOCALHOST_ONLY': '0'}, True),
    ({RANGE: 'LOCALHOST'}, False), ({RANGE: 'localhost'}, False), ({RANGE: 'OFF'}, False),
    ({'ROS_LOCALHOST_ONLY': '1'}, False), ({PROFILE: OWN}, False),
    ({PROFILE: OWN, RANGE: 'LOCALHOST', 'ROS_STATIC_PEERS': '10.0.0.2'}, False),
    ({RANGE: 'LOCALHOST', 'ROS_STATIC_PEERS': '10.0.0.2'}, False)])
def test_how_far_ros_reaches(given, found):
    assert open_to_network(given) == found


def test_the_size_of_the_shared_memory_is_that_of_the_profile(tmp_path):
    assert segment_size({PROFILE: OWN}) == 16 * 1024 * 1024
    assert segment_size({PROFILE: UDP}) == segment_size({}) == DEFAULT_SEGMENT == 512 * 1024
    assert segment_size({PROFILE: str(tmp_path / 'none.xml')}) == DEFAULT_SEGMENT
