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

from flock_follower.checks.reach import Reach
from flock_follower.nodes import mavlink_bridge, planner
from flock_follower.nodes.support.image_middleware import (
    avoid_shared_memory_for_images,
    IMAGES_BUFFER,
)
from flock_follower.nodes.support.middleware import avoid_shared_memory
from flock_follower.system.fast_dds import PROFILE_VARIABLES, profile_variables
from flock_follower.system.files import resource

KILTED, JAZZY = PROFILE_VARIABLES
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
OWN, UDP, UDP_IMAGES, IMAGES = (profile_variables(f'config/dds/{name}.xml') for name in (
    'fastdds', 'fastdds_udp', 'fastdds_udp_images', 'fastdds_images'))
NO_PROFILE = dict.fromkeys(PROFILE_VARIABLES)
#: Of the user; whichever variable he sets is the one that his distribution reads.
JAZZYS, KILTEDS = ({name: '/of/the/user.xml'} for name in (JAZZY, KILTED))
LOOK = """
import os
import sys
from flock_follower.checks.reach import find_reach
from flock_follower.nodes.support.middleware import avoid_shared_memory
from flock_follower.nodes.support.shared_memory import shared_memory_size
if sys.argv[1] == 'avoid':
    avoid_shared_memory(os.environ)
import rclpy
rclpy.init()
node = rclpy.create_node('looks')
print(shared_memory_size() // 1024, find_reach(os.getpid(), int(os.environ['ROS_DOMAIN_ID'])))
node.destroy_node()
rclpy.shutdown()
"""


@pytest.mark.parametrize(('given', 'changed'), [
    ({}, {TRANSPORTS: 'UDPv4'}),
    ({RANGE: 'SUBNET', 'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp'}, {TRANSPORTS: 'UDPv4'}),
    ({RANGE: 'localhost'}, {RANGE: 'SYSTEM_DEFAULT', **UDP}),
    ({'ROS_LOCALHOST_ONLY': '1'},
     {'ROS_LOCALHOST_ONLY': None, RANGE: 'SYSTEM_DEFAULT', **UDP}),
    ({RANGE: 'LOCALHOST', **OWN}, {RANGE: 'SYSTEM_DEFAULT', **UDP}),
    (OWN, UDP), ({JAZZY: OWN[JAZZY]}, UDP), ({KILTED: OWN[KILTED]}, UDP),
    ({RANGE: 'LOCALHOST', TRANSPORTS: 'LARGE_DATA'}, {}),
    ({RANGE: 'LOCALHOST', 'ROS_STATIC_PEERS': '10.0.0.2'}, {}),
    ({'ROS_STATIC_PEERS': '10.0.0.2'}, {TRANSPORTS: 'UDPv4'}),
    (JAZZYS, {TRANSPORTS: 'UDPv4'}), (KILTEDS, {TRANSPORTS: 'UDPv4'}),
    ({**JAZZYS, RANGE: 'LOCALHOST'}, {}), ({**KILTEDS, RANGE: 'LOCALHOST'}, {}),
    ({**OWN, **KILTEDS, RANGE: 'LOCALHOST'}, {}),
    ({JAZZY: str(resource('config/follower.yaml')), RANGE: 'LOCALHOST'}, {}),
    ({'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp', RANGE: 'LOCALHOST'}, {})])
def test_only_what_the_user_left_open_is_set(given, changed):
    environment = dict(given)
    avoid_shared_memory(environment)
    expected = {**given, **changed}
    assert environment == {name: value for name, value in expected.items() if value is not None}


@pytest.mark.parametrize(('given', 'changed'), [
    ({}, {TRANSPORTS: 'UDPv4', **IMAGES}),
    ({RANGE: 'LOCALHOST'}, {RANGE: 'SYSTEM_DEFAULT', **UDP_IMAGES}),
    (JAZZYS, {TRANSPORTS: 'UDPv4'}), (KILTEDS, {TRANSPORTS: 'UDPv4'})])
def test_images_come_without_where_the_kernel_has_room_for_them(given, changed):
    environment = dict(given)
    assert not avoid_shared_memory_for_images(environment, 212_992)
    assert environment == given
    assert avoid_shared_memory_for_images(environment, IMAGES_BUFFER)
    assert environment == {**given, **changed}


@pytest.mark.parametrize(('avoid', 'changed', 'found'), [
    ('avoid', {}, (0, Reach.COMPUTER)),
    ('no', {}, (16 * 1024, Reach.COMPUTER)),
    ('no', NO_PROFILE, (512, Reach.ADDRESS)),
    ('no', {**NO_PROFILE, 'ROS_STATIC_PEERS': '127.0.0.1'},
     (512, Reach.ADDRESS)),
    # OFF: as for the whole subnet, without being heard there.
    ('avoid', {**NO_PROFILE, RANGE: 'OFF'}, (0, Reach.ADDRESS))])
def test_the_shared_memory_and_the_reach_of_a_process_are_found(avoid, changed, found):
    # Another test of this worker may have set the transport.
    environment = {**os.environ, RANGE: 'LOCALHOST', **profile_variables('config/dds/fastdds.xml'),
                   TRANSPORTS: None, **changed}
    looked = subprocess.run(
        [sys.executable, '-c', LOOK, avoid], text=True, capture_output=True, timeout=30.0,
        env={name: value for name, value in environment.items() if value is not None})
    assert looked.stdout == f'{found[0]} {found[1]}\n', looked.stderr


@pytest.mark.parametrize('module', [mavlink_bridge, planner])
def test_the_bridge_and_the_planner_run_without(module, monkeypatch):
    seen = {}
    monkeypatch.setattr(module, 'never_block_output', list, raising=False)
    monkeypatch.setattr(module, 'run', lambda *_: seen.update(os.environ))
    with mock.patch.dict(os.environ, OWN):
        module.main([])
    assert seen.items() >= UDP.items()
