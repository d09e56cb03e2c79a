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

"""Messages read from CDR bytes: byte order, alignment, no copies, and damage said in one way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flock_follower.bags.bag import BagError, deserialize, serialize
from flock_follower.bags.message_types import empty, typestore
from flock_follower.messages import from_odometry
from flock_follower.perception.images import decode_image

ODOMETRY, IMAGE = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'


def image(encoding: str = 'mono8', size: int = 1) -> Any:
    """Return an image of 5 by 30 pixels, its rows padded by two bytes."""
    message = empty(IMAGE)
    message.height, message.width, message.step, message.encoding = 30, 5, 5 * size + 2, encoding
    message.header.frame_id = 'camera'
    message.data = np.arange(30 * message.step).astype(np.uint8)
    return message


@pytest.mark.parametrize('frame', ['', 'o', 'odom', 'a_frame'])
@pytest.mark.parametrize('little', [True, False])
def test_alignment_and_byte_order_are_respected(frame: str, little: bool) -> None:
    message = empty(ODOMETRY)
    message.header.frame_id, message.child_frame_id = frame, frame + 'x'
    message.header.stamp.sec, message.header.stamp.nanosec = 3, 5
    message.pose.pose.orientation.w, message.twist.twist.linear.y = 1.0, 2.5
    message.twist.covariance[35] = 7.0
    data = bytes(typestore().serialize_cdr(message, ODOMETRY, little_endian=little))
    state = from_odometry(deserialize(data, ODOMETRY))
    assert (state.stamp, state.frame, state.child) == (3_000_000_005, frame, frame + 'x')
    assert state.velocity.tolist() == [0.0, 2.5, 0.0]
    assert state.twist_covariance[5, 5] == 7.0


@pytest.mark.parametrize(('encoding', 'size'), [('mono8', 1), ('bgr8', 3), ('rgba8', 4)])
def test_an_image_keeps_its_pixels(encoding: str, size: int) -> None:
    message = image(encoding, size)
    read = deserialize(serialize(message, IMAGE), IMAGE)
    assert np.array_equal(decode_image(read), decode_image(message))


def test_the_pixels_of_a_grey_image_are_never_copied() -> None:
    data = serialize(image(), IMAGE)
    pixels = decode_image(deserialize(data, IMAGE))
    assert np.shares_memory(pixels, np.frombuffer(data, dtype=np.uint8))


def test_a_compressed_image_keeps_its_bytes() -> None:
    message = empty(COMPRESSED)
    message.format, message.data = 'jpeg', np.arange(7, dtype=np.uint8)
    data = serialize(message, COMPRESSED)
    read = deserialize(data, COMPRESSED)
    assert (read.format, bytes(read.data)) == ('jpeg', bytes(range(7)))
    assert np.shares_memory(read.data, np.frombuffer(data, dtype=np.uint8))


@pytest.mark.parametrize('kept', [0, 3, 11, 40, 100, -1])
def test_truncated_messages_are_refused(kept: int) -> None:
    odometry = empty(ODOMETRY)
    odometry.pose.pose.orientation.w = 1.0
    compressed = empty(COMPRESSED)
    compressed.data = np.zeros(200, dtype=np.uint8)
    for message, msgtype in ((odometry, ODOMETRY), (compressed, COMPRESSED), (image(), IMAGE)):
        data = serialize(message, msgtype)[:kept]
        with pytest.raises(BagError, match=f'^{msgtype}: corrupt message'):
            deserialize(data, msgtype)


def test_whatever_the_bytes_are_nothing_but_a_bag_error_is_raised() -> None:
    rng = np.random.default_rng(1)
    refused = 0
    for msgtype in (ODOMETRY, COMPRESSED, IMAGE):
        good = serialize(empty(msgtype), msgtype)
        for _ in range(300):
            data = bytearray(good)
            for at in rng.integers(0, min(len(data), 40), size=3):
                data[at] = rng.integers(256)
            try:
                deserialize(bytes(data), msgtype)
            except BagError as error:
                assert '\n' not in str(error)
                refused += 1
    assert refused > 300
