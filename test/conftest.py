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

"""Keeps every test on this machine and repeatable."""

import os
from pathlib import Path

from hypothesis import HealthCheck, settings
import pytest

# Before any rclpy import: DDS reads these once, and nobody's real drone may hear a test.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
# Nodes find each other in a fifth of a second instead of up to 2.5 s.
os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(
    Path(__file__).resolve().parent.parent / 'config' / 'fastdds.xml')

settings.register_profile(
    'repeatable', derandomize=True, deadline=None, print_blob=False,
    suppress_health_check=[HealthCheck.too_slow])
settings.load_profile('repeatable')


@pytest.fixture(scope='module')
def ros():
    """Have ROS up while a module's tests run; where there is none, others run all the same."""
    import rclpy
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def make_rig(ros):
    """Give what makes a bridge as a process, with all it talks to; they end with the test."""
    from bridge_rig import made_rigs
    with made_rigs() as make:
        yield make
