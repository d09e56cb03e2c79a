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

"""The sample bag: its contents, and that it can be made again."""


import cv2
import numpy as np
import pytest

from flock_desk import sample_bag as sample
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.perception.markers import detect
from flock_follower.system.files import resource

pytestmark = pytest.mark.slow
TOPICS = {'/image_raw/compressed': 360, '/camera_info': 360, '/odom': 2401,
          '/truth/odom': 360, '/truth/neighbors': 360}


@pytest.fixture(scope='module')
def bag():
    """Return the raw messages of every topic."""
    messages = {topic: [] for topic in TOPICS}
    with open_bag(resource('bags/sample')) as opened:
        for message in opened.messages():
            messages[message.topic].append(message)
    return messages


@pytest.fixture(scope='module')
def recording():
    return sample.Recording(sample.VARIANTS['sample'])


def test_the_bag_is_small_and_holds_what_it_should(bag):
    size = sum(file.stat().st_size for file in resource('bags/sample').iterdir())
    assert size <= 12_000_000
    assert {topic: len(messages) for topic, messages in bag.items()} == TOPICS
    assert resource('bags/sample/parameters.yaml').read_text() == sample.PARAMETERS


@pytest.mark.parametrize('k', [0, 181])
def test_an_image_made_again_shows_the_marker_at_the_same_place(bag, recording, k):
    recorded = cv2.imdecode(deserialize(
        bag['/image_raw/compressed'][k].data, 'sensor_msgs/msg/CompressedImage').data, 0)
    corners = [detect(image, 'DICT_4X4_50').corners[0]
               for image in (recorded, recording.pixels(k))]
    assert np.abs(corners[0] - corners[1]).max() < 1.5  # px


def test_everything_else_made_again_is_the_same_byte_for_byte(bag, recording):
    assert recording.odom() == bag['/odom']
    assert [recording.camera_info(k) for k in range(360)] == bag['/camera_info']
    truth = [recording.truth(k) for k in range(360)]
    assert [t[0] for t in truth] == bag['/truth/odom']
    assert [t[1] for t in truth] == bag['/truth/neighbors']
