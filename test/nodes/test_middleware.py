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
import shutil
import subprocess
import sys
from unittest import mock

import pytest

from flock_desk.runs.processes import wait_until
from flock_follower.files import resource
from flock_follower.nodes import mavlink_bridge, planner
from flock_follower.nodes.observer import processes
from flock_follower.nodes.support.middleware import (
    avoid_shared_memory,
    avoid_shared_memory_for_images,
    DEFAULT_SEGMENT,
    HERE,
    IMAGES_BUFFER,
    NETWORK,
    PEERS,
    reach,
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
    environment = {**os.environ, RANGE: range_}
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


@pytest.mark.parametrize(('given', 'far'), [
    ({}, NETWORK), ({RANGE: 'SUBNET'}, NETWORK), ({RANGE: 'SYSTEM_DEFAULT'}, NETWORK),
    ({'ROS_STATIC_PEERS': '10.0.0.2'}, NETWORK),
    ({RANGE: 'SUBNET', PROFILE: '/of/the/user.xml'}, NETWORK),
    ({PROFILE: OWN, 'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}, NETWORK),
    ({'ROS_LOCALHOST_ONLY': '0'}, NETWORK),
    ({RANGE: 'LOCALHOST'}, HERE), ({RANGE: 'localhost'}, HERE), ({RANGE: 'OFF'}, HERE),
    ({'ROS_LOCALHOST_ONLY': '1'}, HERE), ({PROFILE: OWN}, HERE),
    ({PROFILE: OWN, RANGE: 'LOCALHOST', 'ROS_STATIC_PEERS': '10.0.0.2'}, HERE),
    ({RANGE: 'LOCALHOST', 'ROS_STATIC_PEERS': '10.0.0.2'}, PEERS)])
def test_how_far_ros_reaches(given, far):
    assert reach(given) == far


def test_the_environment_of_a_running_node_is_read(tmp_path):
    stand_in = tmp_path / 'planner'  # not a node: no test may be heard on the network
    stand_in.symlink_to(shutil.which('sleep'))
    environment = {RANGE: 'SUBNET', 'ROS_DOMAIN_ID': '99', 'KEY': str(tmp_path)}

    def found_now():
        return [found.environment for found in processes()
                if found.node == 'planner' and found.environment.get('KEY') == str(tmp_path)]
    with subprocess.Popen([str(stand_in), '30'], env=environment) as process:
        try:  # the kernel shows it a moment after it was started
            wait_until(found_now, 5.0, 'the process')
            found = found_now()
        finally:
            process.kill()
    assert found == [environment] and reach(found[0]) == NETWORK


def test_the_size_of_the_shared_memory_is_that_of_the_profile(tmp_path):
    assert segment_size({PROFILE: OWN}) == 16 * 1024 * 1024
    assert segment_size({PROFILE: UDP}) == segment_size({}) == DEFAULT_SEGMENT == 512 * 1024
    assert segment_size({PROFILE: str(tmp_path / 'none.xml')}) == DEFAULT_SEGMENT
