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

"""Every encoding to gray and back from bytes, rows with padding, and payloads that lie."""

from __future__ import annotations

from array import array
import time
import tracemalloc

import cv2
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.perception.images import compute_in_one_thread, decode, decode_compressed

GRAY = np.random.default_rng(5).integers(0, 256, (12, 10), dtype=np.uint8)
COLORS = {'red': (255, 0, 0), 'green': (0, 255, 0), 'blue': (0, 0, 255)}
BRIGHTNESS = {'red': 76, 'green': 150, 'blue': 29}  # ITU-R BT.601


def decode_array(encoding: str, pixels: np.ndarray, bigendian: bool = False) -> np.ndarray:
    height, width = pixels.shape[:2]
    return decode(encoding, height, width, pixels.nbytes // height, bigendian, pixels.tobytes())


@pytest.mark.parametrize('color', COLORS)
@pytest.mark.parametrize('encoding', ['rgb8', 'bgr8', 'rgba8', 'bgra8'])
def test_color_becomes_its_brightness(encoding: str, color: str) -> None:
    rgb = COLORS[color]
    channels = rgb[::-1] if encoding.startswith('bgr') else rgb
    if encoding.endswith('a8'):
        channels = (*channels, 7)
    pixels = np.tile(np.array(channels, dtype=np.uint8), (4, 6, 1))
    np.testing.assert_array_equal(decode_array(encoding, pixels), BRIGHTNESS[color])


@pytest.mark.parametrize('color', COLORS)
@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_patterns_are_named_by_their_first_row(pattern: str, color: str) -> None:
    # A scene of one color: only the pixels behind filters of that color are bright.
    mosaic = np.zeros((20, 24), dtype=np.uint8)
    for k, letter in enumerate(pattern):
        if letter == color[0]:
            mosaic[k // 2::2, k % 2::2] = 255
    gray = decode_array(f'bayer_{pattern}8', mosaic)
    assert gray.shape == mosaic.shape
    np.testing.assert_allclose(gray[4:-4, 4:-4], BRIGHTNESS[color], atol=1)


@pytest.mark.parametrize(('encoding', 'first'), [
    ('yuv422', 1), ('uyvy', 1), ('yuv422_yuy2', 0), ('yuyv', 0)])
def test_yuv_gives_its_y(encoding: str, first: int) -> None:
    pixels = np.full((12, 20), 200, dtype=np.uint8)
    pixels[:, first::2] = GRAY
    gray = decode(encoding, 12, 10, 20, False, pixels.tobytes())
    np.testing.assert_array_equal(gray, GRAY)


@pytest.mark.parametrize('encoding', ['mono8', '8UC1'])
def test_mono_is_a_view_without_a_copy(encoding: str) -> None:
    data = array('B', GRAY.tobytes())
    gray = decode(encoding, 12, 10, 10, False, data)
    np.testing.assert_array_equal(gray, GRAY)
    data[0] ^= 0xFF
    assert gray[0, 0] == data[0]


@pytest.mark.parametrize('bigendian', [False, True])
@pytest.mark.parametrize('bits', [10, 12, 16])
def test_mono16_keeps_the_highest_bits_in_use(bits: int, bigendian: bool) -> None:
    values = GRAY.astype(np.uint16) << (bits - 8)
    values[0, 0] = 2**bits - 1
    gray = decode_array('mono16', values.astype('>u2' if bigendian else '<u2'), bigendian)
    expected = GRAY.copy()
    expected[0, 0] = 255
    np.testing.assert_array_equal(gray, expected)


@pytest.mark.parametrize('encoding', ['mono8', 'bgr8', 'mono16', 'yuv422', 'bayer_rggb8'])
def test_padding_at_the_end_of_rows_is_skipped(encoding: str) -> None:
    size = {'bgr8': 3, 'mono16': 2, 'yuv422': 2}.get(encoding, 1)
    rng = np.random.default_rng(6)
    rows = rng.integers(0, 256, (12, 10 * size), dtype=np.uint8)
    padded = np.hstack([rows, rng.integers(0, 256, (12, 5), dtype=np.uint8)])
    plain = decode(encoding, 12, 10, 10 * size, False, rows.tobytes())
    np.testing.assert_array_equal(
        decode(encoding, 12, 10, 10 * size + 5, False, padded.tobytes()), plain)
    # Some drivers leave out the padding of the last row.
    np.testing.assert_array_equal(
        decode(encoding, 12, 10, 10 * size + 5, False, padded.tobytes()[:-5]), plain)


@pytest.mark.parametrize(('arguments', 'message'), [
    (('h264', 12, 10, 10, False, b'\0' * 120), "'h264': must be one of mono8, .*bayer_grbg8"),
    (('mono8', 12, 10, 10, False, b'\0' * 119), '119 bytes: .* at least 120'),
    (('mono8', 12, 10, 10, False, b''), '0 bytes'),
    (('bgr8', 12, 10, 29, False, b'\0' * 360), 'step = 29: .* at least 30 bytes'),
    (('mono8', 0, 10, 10, False, b''), 'image = 10x0'),
    (('mono8', 12, 0, 0, False, b''), 'image = 0x12'),
    (('mono8', -12, 10, 10, False, b'\0' * 120), 'image = 10x-12'),
    (('mono8', 12, 10, -10, False, b'\0' * 120), 'step = -10'),
    (('mono8', 2**32 - 1, 10, 2**32 - 1, False, b'\0' * 120), '120 bytes: .* at least'),
    (('mono16', 2**31, 2**31, 2**32, False, b'\0' * 120), '120 bytes: .* at least')])
def test_impossible_images_are_refused_by_name(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        decode(*arguments)


@pytest.mark.parametrize('encoding', ['rgb16', 'bgra16', 'bayer_grbg16'])
def test_colors_of_16_bits_become_their_brightness(encoding: str) -> None:
    channels = {'rgb16': 3, 'bgra16': 4}.get(encoding, 1)
    pixels = np.full((12, 10, channels), 3 << 8, dtype='>u2')
    pixels[0, 0] = 2**10 - 1  # 10 bits in use
    gray = decode_array(encoding, pixels, True)
    assert gray.shape == (12, 10)
    np.testing.assert_allclose(gray[4:, 4:], 192, atol=1)


@pytest.mark.parametrize('encoding', ['nv12', 'nv21'])
def test_planes_of_color_after_the_brightness_are_left_out(encoding: str) -> None:
    data = GRAY.tobytes() + bytes(60)
    np.testing.assert_array_equal(decode(encoding, 12, 10, 10, False, data), GRAY)


@pytest.mark.parametrize('bits', [10, 16])
def test_png_of_16_bits_keeps_the_highest_bits_in_use(bits: int) -> None:
    values = GRAY.astype(np.uint16) << (bits - 8)
    values[0, 0] = 2**bits - 1
    gray = decode_compressed(cv2.imencode('.png', values)[1].tobytes())
    np.testing.assert_array_equal(gray[1:], GRAY[1:])


@pytest.mark.parametrize('extension', ['.png', '.jpg'])
def test_compressed_images_are_decoded(extension: str) -> None:
    smooth = cv2.GaussianBlur(np.kron(GRAY, np.ones((8, 8), dtype=np.uint8)), (0, 0), 4.0)
    payload = cv2.imencode(extension, smooth)[1].tobytes()
    gray = decode_compressed(array('B', payload))
    assert gray.shape == smooth.shape
    assert np.abs(gray.astype(int) - smooth).max() <= (0 if extension == '.png' else 12)


ENCODINGS = ['mono8', '8UC1', 'bgr8', 'rgb8', 'bgra8', 'rgba8', 'mono16', 'yuv422', 'uyvy',
             '8UC3', 'nv12', 'rgb16', 'bayer_rggb16', 'yuv422_yuy2',
             'yuyv', 'bayer_rggb8', 'bayer_bggr8', 'bayer_gbrg8', 'bayer_grbg8']
SIZES = st.integers(-2, 40) | st.sampled_from([2**16, 2**31, 2**32 - 1, 2**63, 2**70])


def decoded_in_bounds(encoding: str, height: int, width: int, step: int, bigendian: bool,
                      length: int) -> np.ndarray:
    """Decode so many bytes, and fail where that takes much more memory than they do."""
    data = np.arange(length, dtype=np.uint8).tobytes()
    tracemalloc.start()
    try:
        gray = decode(encoding, height, width, step, bigendian, data)
        return gray.copy()  # reads every pixel: they are in memory that is there
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 16 * length + 100_000


@given(encoding=st.sampled_from(ENCODINGS) | st.text(), height=SIZES, width=SIZES,
       step=SIZES | st.integers(40, 200), bigendian=st.booleans(), length=st.integers(0, 4000))
def test_any_message_is_image_of_its_size_or_value_error(
        encoding: str, height: int, width: int, step: int, bigendian: bool, length: int) -> None:
    try:
        gray = decoded_in_bounds(encoding, height, width, step, bigendian, length)
    except ValueError as error:
        assert str(error)
    else:
        assert gray.shape == (height, width) and gray.dtype == np.uint8


def test_hot_pixels_do_not_darken_a_twelve_bit_image() -> None:
    pixels = np.full((60, 80), 4000, dtype='<u2')
    pixels[3, 4] = 65535
    gray = decode('mono16', 60, 80, 160, False, pixels.tobytes())
    assert gray[30, 40] == 250
    assert gray[3, 4] == 255


def test_large_products_use_one_thread() -> None:
    compute_in_one_thread()
    matrix = np.ones((400, 400))
    whole, own = time.process_time(), time.thread_time()
    for _ in range(20):
        matrix.dot(matrix)
    own = time.thread_time() - own
    assert time.process_time() - whole < 1.2 * own
