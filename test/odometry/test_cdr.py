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

"""Odometry read from its bytes is what the type store reads from them."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from flock_follower.bags.message_types import empty, typestore
from flock_follower.geometry import IDENTITY_QUATERNION
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import ODOMETRY, odometry
from flock_follower.odometry.reader import read_odometry

STAMP = 1_700_000_000_123_456_789  # ns


def some(frame='odom', child='base_link'):
    chance = np.random.default_rng(len(frame) + 10 * len(child))
    return odometry(
        empty, STAMP, frame, child, chance.normal(size=3),
        IDENTITY_QUATERNION + 0.1 * chance.normal(size=4), chance.normal(size=3),
        chance.normal(size=3), chance.normal(size=(6, 6)), chance.normal(size=(6, 6)))


def to_bytes(message, little_endian=True):
    return bytes(typestore().serialize_cdr(message, ODOMETRY, little_endian=little_endian))


@pytest.mark.parametrize(('frame', 'child', 'little_endian'), list(product(
    ['', 'odom', 'K\u00fcche'], ['', 'b', 'imu', 'base_link'], [True, False])))
def test_every_field_is_the_same_wherever_the_names_end(frame, child, little_endian):
    message = some(frame, child)
    read = read_odometry(to_bytes(message, little_endian))
    for mine, theirs in zip(from_odometry(read), from_odometry(message)):
        assert np.array_equal(mine, theirs)
    q, theirs = read.pose.pose.orientation, message.pose.pose.orientation
    assert (q.x, q.y, q.z, q.w) == (theirs.x, theirs.y, theirs.z, theirs.w)


@pytest.mark.parametrize('length', [0, 3, 10, 20, 40, 500])
def test_bytes_that_end_early_are_a_bad_message(length):
    data = to_bytes(some())
    with pytest.raises(ValueError, match='not an Odometry message'):
        read_odometry(data[:length])
    assert read_odometry(data).child_frame_id == 'base_link'
