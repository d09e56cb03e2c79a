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

"""Reading CDR bytes directly gives what reading them into messages gives."""

from __future__ import annotations

from bag_excerpts import SAMPLE
import numpy as np
import pytest

from flock_follower.bags.bag import BagError, deserialize, open_bag, serialize
from flock_follower.bags.cdr import CompressedImage, RawImage, read_image, read_odometry
from flock_follower.bags.message_types import empty, typestore
from flock_follower.messages import from_odometry
from flock_follower.perception.pending_images import decode_image

ODOMETRY, IMAGE = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'


@pytest.mark.parametrize('twist_frame', ['child', 'odom'])
def test_odometry_of_a_bag_is_the_same_bit_for_bit(twist_frame: str) -> None:
    with open_bag(SAMPLE) as bag:
        for message in list(bag.messages(['/odom', '/truth/neighbors']))[:400]:
            fast = read_odometry(message.data, twist_frame)
            slow = from_odometry(deserialize(message.data, message.msgtype), twist_frame)
            for a, b in zip(fast, slow):
                assert np.array_equal(a, b)  # type: ignore[arg-type]


@pytest.mark.parametrize('frame', ['', 'o', 'odom', 'a_frame'])
@pytest.mark.parametrize('little', [True, False])
def test_alignment_and_byte_order_are_respected(frame: str, little: bool) -> None:
    message = empty(ODOMETRY)
    message.header.frame_id, message.child_frame_id = frame, frame + 'x'
    message.header.stamp.sec, message.header.stamp.nanosec = 3, 5
    message.pose.pose.orientation.w, message.twist.twist.linear.y = 1.0, 2.5
    message.twist.covariance[35] = 7.0
    data = bytes(typestore().serialize_cdr(message, ODOMETRY, little_endian=little))
    state = read_odometry(data)
    assert (state.stamp, state.frame, state.child) == (3_000_000_005, frame, frame + 'x')
    assert state.velocity.tolist() == [0.0, 2.5, 0.0]
    assert state.twist_covariance[5, 5] == 7.0


@pytest.mark.parametrize('encoding', ['mono8', 'bgr8', 'rgba8'])
def test_an_image_keeps_its_pixels(encoding: str) -> None:
    message = empty(IMAGE)
    size = {'mono8': 1, 'bgr8': 3, 'rgba8': 4}[encoding]
    message.height, message.width, message.step, message.encoding = 3, 5, 5 * size + 2, encoding
    message.header.frame_id, message.header.stamp.sec = 'camera', 9
    message.data = np.arange(3 * message.step, dtype=np.uint8)
    fast = read_image(serialize(message, IMAGE), IMAGE)
    assert isinstance(fast, RawImage) and fast.stamp == 9_000_000_000
    assert np.array_equal(decode_image(fast), decode_image(message))


def test_a_compressed_image_keeps_its_bytes() -> None:
    message = empty(COMPRESSED)
    message.format, message.data = 'jpeg', np.arange(7, dtype=np.uint8)
    fast = read_image(serialize(message, COMPRESSED), COMPRESSED)
    assert isinstance(fast, CompressedImage)
    assert (fast.format, bytes(fast.data)) == ('jpeg', bytes(range(7)))


@pytest.mark.parametrize('kept', [0, 3, 11, 40, 100, -1])
def test_truncated_messages_are_refused(kept: int) -> None:
    odometry = empty(ODOMETRY)
    odometry.pose.pose.orientation.w = 1.0
    with pytest.raises(BagError, match='corrupt message'):
        read_odometry(serialize(odometry, ODOMETRY)[:kept])
    image = empty(COMPRESSED)
    image.data = np.zeros(200, dtype=np.uint8)
    with pytest.raises(BagError, match='corrupt message'):
        read_image(serialize(image, COMPRESSED)[:kept], COMPRESSED)
