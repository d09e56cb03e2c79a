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

"""Tests of the images that are decoded ahead: order, pixels, damaged ones."""

from __future__ import annotations

import numpy as np
import pytest

from flock_desk.runs.decoding import decoded_ahead, IMAGES_AHEAD
from flock_follower.bags.bag import BagMessage, serialize
from flock_follower.bags.message_types import empty
from flock_follower.perception.encoding import encode_jpeg
from flock_follower.perception.images import decode_image

IMAGE = 'sensor_msgs/msg/CompressedImage'


def image(stamp: int) -> BagMessage:
    message = empty(IMAGE)
    message.header.frame_id, message.format = 'camera', 'jpeg'
    message.data = np.frombuffer(
        encode_jpeg(np.full((16, 16), 10 * stamp, dtype=np.uint8), 95), dtype=np.uint8)
    return BagMessage('/image', IMAGE, stamp, serialize(message, IMAGE))


@pytest.mark.parametrize('count', [1, IMAGES_AHEAD, 3 * IMAGES_AHEAD])
def test_messages_keep_their_order(count: int) -> None:
    messages = [each for stamp in range(count)
                for each in (image(stamp), BagMessage('/odom', '', stamp, b''))]
    found = list(decoded_ahead(messages, ['/image']))
    assert [message for message, _ in found] == messages
    for message, decoded in found:
        assert (decoded is None) == (message.topic == '/odom')
        if decoded is not None:
            assert abs(float(decode_image(decoded).mean()) - 10 * message.stamp_ns) < 2.0
            assert decoded.header.frame_id == 'camera' and decoded.spent >= 0.0


def test_a_damaged_image_is_left_to_the_reader() -> None:
    whole = image(1)
    cut = whole._replace(data=whole.data[:len(whole.data) // 2])
    assert [decoded is None for _, decoded in decoded_ahead([cut, whole], ['/image'])] == [
        True, False]


def test_images_of_other_topics_stay_encoded() -> None:
    assert [decoded for _, decoded in decoded_ahead([image(1)], ['/other'])] == [None]
