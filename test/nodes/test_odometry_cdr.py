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

"""Odometry read from its bytes is what rclpy reads from them."""

from itertools import product
import struct

import numpy as np
import pytest
from rclpy.serialization import serialize_message

from flock_follower.geometry import IDENTITY_QUATERNION
from flock_follower.messages import from_odometry
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry
from flock_follower.nodes.support.odometry_cdr import PlainOdometry, read_odometry

STAMP = 1_700_000_000_123_456_789  # ns


def some(frame='odom', child='base_link'):
    chance = np.random.default_rng(len(frame) + 10 * len(child))
    return to_odometry(
        nanoseconds_to_stamp(STAMP), frame, child, chance.normal(size=3),
        IDENTITY_QUATERNION + 0.1 * chance.normal(size=4), chance.normal(size=3),
        chance.normal(size=3), chance.normal(size=(6, 6)), chance.normal(size=(6, 6)))


@pytest.mark.parametrize(('frame', 'child'), list(product(
    ['', 'o', 'odom', 'vio_odom', 'K\u00fcche'],
    ['', 'b', 'imu', 'base', 'base_link', 'a/b/c'])))
def test_every_field_is_the_same_wherever_the_names_end(frame, child):
    message = some(frame, child)
    read = read_odometry(serialize_message(message))
    assert isinstance(read, PlainOdometry)
    for mine, theirs in zip(from_odometry(read), from_odometry(message)):
        assert np.array_equal(mine, theirs)
    q, theirs = read.pose.pose.orientation, message.pose.pose.orientation
    assert (q.x, q.y, q.z, q.w) == (theirs.x, theirs.y, theirs.z, theirs.w)


def test_of_the_other_byte_order_it_is_read_too():
    little = serialize_message(some('odom', 'base'))
    numbers = struct.unpack_from('<85d', little, len(little) - 8 * 85)
    seconds, nanoseconds = struct.unpack_from('<iI', little, 4)
    head = struct.pack('>iII', seconds, nanoseconds, 5) + b'odom\0\0\0\0'
    head += struct.pack('>I', 5) + b'base\0'
    head += bytes(-len(head) % 8)
    read = read_odometry(b'\x00\x00\x00\x00' + head + struct.pack('>85d', *numbers))
    for mine, theirs in zip(from_odometry(read), from_odometry(some('odom', 'base'))):
        assert np.array_equal(mine, theirs)


@pytest.mark.parametrize('length', [0, 3, 10, 20, 40, 500])
def test_bytes_that_end_early_are_a_bad_message(length):
    data = serialize_message(some())
    with pytest.raises((ValueError, RuntimeError)):
        read_odometry(data[:length])
    assert read_odometry(data).child_frame_id == 'base_link'
