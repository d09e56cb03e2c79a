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

"""JPEG and PNG files are whole, and of a known and bounded size, before they are decoded."""

import cv2
import numpy as np
import pytest

from flock_follower.perception.images import decode_compressed, file_size, MAX_PIXELS

NOISE = np.random.default_rng(1).integers(0, 255, (120, 160), dtype=np.uint8)
COLOR = np.dstack([NOISE] * 3)
PNG = cv2.imencode('.png', NOISE)[1].tobytes()
JPEG = cv2.imencode('.jpg', NOISE)[1].tobytes()


def jpeg_of_size(width, height):
    start = JPEG.index(b'\xff\xc0') + 5
    return JPEG[:start] + height.to_bytes(2, 'big') + width.to_bytes(2, 'big') + JPEG[start + 4:]


@pytest.mark.parametrize('data', [
    PNG, JPEG, cv2.imencode('.jpg', COLOR)[1].tobytes(), cv2.imencode('.png', COLOR)[1].tobytes(),
    cv2.imencode('.jpg', NOISE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes(),
    JPEG[:2] + b'\xff\xff\xff' + JPEG[2:]],
    ids=['png', 'jpeg', 'color jpeg', 'color png', 'progressive', 'padded'])
def test_the_size_of_a_good_file_is_read(data):
    assert file_size(data) == (160, 120)
    assert decode_compressed(data).shape == (120, 160)


@pytest.mark.parametrize(('data', 'complaint'), [
    (b'', 'neither JPEG nor PNG'), (b'BM' + bytes(100), 'neither JPEG nor PNG'),
    (JPEG[:30], 'cut short, or damaged'), (PNG[:300], 'cut short, or damaged'),
    (PNG[:8], 'a PNG without its end'), (PNG[:-12], 'a PNG without its end'),
    (PNG[:8] + PNG[-12:], '0x0 px: must have'), (jpeg_of_size(0, 10), '0x10 px: must have'),
    (jpeg_of_size(30_000, 30_000), '30000x30000 px: must have 1 to 33177600 px'),
    (PNG[:33] + b'\xfa' + PNG[34:], 'cut short, or damaged'),
    (PNG[:16] + b'\x7f' + PNG[17:], 'px: must have')])
def test_a_damaged_file_is_refused_before_it_is_decoded(data, complaint, monkeypatch):
    monkeypatch.setattr(cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ValueError, match=complaint):
        decode_compressed(data)


def test_any_damaged_header_is_value_error_or_size():
    rng = np.random.default_rng(2)
    for data in (PNG, JPEG):
        for _ in range(300):
            spoilt = bytearray(data[:rng.integers(0, 700)])
            for place in rng.integers(0, max(len(spoilt), 1), 3):
                spoilt[place:place + 1] = bytes([rng.integers(256)])
            try:
                width, height = file_size(bytes(spoilt))
            except ValueError as error:
                assert 'compressed image of' in str(error)
            else:
                assert 0 < width * height <= MAX_PIXELS
