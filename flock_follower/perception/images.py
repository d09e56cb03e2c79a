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

"""
Converts image messages to gray arrays of shape (height, width), uint8.

``decode`` takes the payload of ``sensor_msgs/Image``; a mono8 payload is returned as a view
without a copy (read-only if the payload is). ``decode_compressed`` takes that of
``CompressedImage``.

``file_size`` checks before the decoding that a JPEG or PNG file is complete and of a plausible
size. Decoders do not check this: with one wrong byte in the length of a PNG chunk OpenCV allocates
gigabytes, and a small JPEG can state a width of 65535 pixels. If a JPEG is truncated, OpenCV 4
fills the missing rows with old memory, often the previous image with its marker.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
import re
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array

#: The largest image decoded, pixels: 8K, more than any camera in flight sends.
MAX_PIXELS: Final[int] = 7680 * 4320
_PNG: Final[bytes] = b'\x89PNG\r\n\x1a\n'
_JPEG: Final[bytes] = b'\xff\xd8'
_JPEG_SCAN: Final[bytes] = b'\xff\xda'
_JPEG_END: Final[bytes] = b'\xff\xd9'
# Start of frame: every marker from 0xC0 to 0xCF but tables (C4), extensions (C8), arithmetic (CC).
_JPEG_FRAMES: Final[frozenset[int]] = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_FILL: Final[int] = 0xFF
FARTHEST_PIXEL = 16384.0  # px: a line with a point farther outside is not drawn
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel


def file_size(data: bytes) -> tuple[int, int]:
    """
    Return width and height, px, of a JPEG or PNG file.

    :raises ValueError: if it is neither, is larger than ``MAX_PIXELS``, its structure does not
        fit into its length, or its end is missing.
    """
    if data.startswith(_PNG):
        width, height = _png_size(data)
    elif data.startswith(_JPEG):
        width, height = _jpeg_size(data)
    else:
        raise ValueError(f'compressed image of {len(data)} bytes: neither JPEG nor PNG')
    if not 0 < width * height <= MAX_PIXELS:
        raise ValueError(f'compressed image of {width}x{height} px: must have 1 to '
                         f'{MAX_PIXELS} px')
    return width, height


def _png_size(data: bytes) -> tuple[int, int]:
    """
    Return the size in IHDR, of a file that goes on to IEND.

    Every chunk is a length, a name, the data and a checksum.
    """
    size, start = (0, 0), len(_PNG)
    while start + 8 <= len(data):
        length, name = int.from_bytes(data[start:start + 4], 'big'), data[start + 4:start + 8]
        if start + 12 + length > len(data):
            raise ValueError(f'compressed image of {len(data)} bytes: cut short, or damaged')
        if name == b'IHDR':
            size = (int.from_bytes(data[start + 8:start + 12], 'big'),
                    int.from_bytes(data[start + 12:start + 16], 'big'))
        elif name == b'IEND':
            return size
        start += 12 + length
    raise ValueError(f'compressed image of {len(data)} bytes: a PNG without its end')


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Return the size in the frame header; earlier segments begin with their length."""
    start = len(_JPEG)
    while start + 9 <= len(data) and data[start] == _JPEG_FILL:
        marker = data[start + 1]
        if marker == _JPEG_FILL:  # padding
            start += 1
            continue
        if marker in _JPEG_FRAMES:
            # The end of an image follows its last scan; that of a thumbnail comes before.
            if data.rfind(_JPEG_END) < data.rfind(_JPEG_SCAN):
                raise ValueError(f'compressed image of {len(data)} bytes: a JPEG without its end')
            return (int.from_bytes(data[start + 7:start + 9], 'big'),
                    int.from_bytes(data[start + 5:start + 7], 'big'))
        start += 2 + int.from_bytes(data[start + 2:start + 4], 'big')
    raise ValueError(f'compressed image of {len(data)} bytes: cut short, or damaged')


GrayImage = NDArray[np.uint8]


#: Encoding (``sensor_msgs/image_encodings``) -> bytes per pixel, OpenCV's conversion to gray.
#: ROS names a Bayer pattern by its first row and column, OpenCV by its second: RGGB is BayerBG.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    'mono8': (1, None),
    '8UC1': (1, None),
    '8UC3': (3, cv2.COLOR_BGR2GRAY),
    '8UC4': (4, cv2.COLOR_BGRA2GRAY),
    'nv12': (1, None),  # rows of brightness, then those of color
    'nv21': (1, None),
    'nv24': (1, None),
    'bgr8': (3, cv2.COLOR_BGR2GRAY),
    'rgb8': (3, cv2.COLOR_RGB2GRAY),
    'bgra8': (4, cv2.COLOR_BGRA2GRAY),
    'rgba8': (4, cv2.COLOR_RGBA2GRAY),
    'yuv422': (2, cv2.COLOR_YUV2GRAY_UYVY),
    'uyvy': (2, cv2.COLOR_YUV2GRAY_UYVY),
    'yuv422_yuy2': (2, cv2.COLOR_YUV2GRAY_YUY2),
    'yuyv': (2, cv2.COLOR_YUV2GRAY_YUY2),
    'bayer_rggb8': (1, cv2.COLOR_BayerBG2GRAY),
    'bayer_bggr8': (1, cv2.COLOR_BayerRG2GRAY),
    'bayer_gbrg8': (1, cv2.COLOR_BayerGR2GRAY),
    'bayer_grbg8': (1, cv2.COLOR_BayerGB2GRAY),
}
#: Encodings of 16 bits by those of 8 bits to which decode() narrows them.
_WIDE: dict[str, str] = {
    'mono16': 'mono8', 'bgr16': 'bgr8', 'rgb16': 'rgb8', 'bgra16': 'bgra8', 'rgba16': 'rgba8',
    **{f'bayer_{pattern}16': f'bayer_{pattern}8' for pattern in ('rggb', 'bggr', 'gbrg', 'grbg')}}
_ENCODINGS |= {wide: (2 * _ENCODINGS[narrow][0], _ENCODINGS[narrow][1])
               for wide, narrow in _WIDE.items()}


def compute_in_one_thread() -> None:
    """
    Restrict OpenCV, and OpenBLAS if numpy uses it, to the calling thread.

    Other threads of OpenCV cost 6 % of a core without a gain. Those of OpenBLAS spin for some
    milliseconds after every product of larger matrices, and cost more than the product itself.
    """
    cv2.setNumThreads(1)
    maps = Path('/proc/self/maps')
    for library in map(ctypes.CDLL, set(re.findall(
            r'/.*openblas.*', maps.read_text(encoding='utf-8') if maps.exists() else ''))):
        for build in ('openblas{}', 'openblas{}64_', 'scipy_openblas{}', 'scipy_openblas{}64_'):
            getattr(library, build.format('_set_num_threads'), int)(1)


class DecodedImage:
    """
    An image message that was decoded: the fields of the message, and its ``pixels``.

    :param spent: CPU time of decoding it, s.
    """

    def __init__(self, message: Any, pixels: GrayImage, spent: float) -> None:
        self._message, self.pixels, self.spent = message, pixels, spent

    def __getattr__(self, field: str) -> Any:
        """Return a field of the message."""
        return getattr(self._message, field)


def decode_image(message: Any) -> GrayImage:
    """
    Return the pixels of an Image or CompressedImage message, (H, W) uint8; of a DecodedImage too.

    :raises ValueError: if they cannot be decoded.
    """
    if isinstance(message, np.ndarray):
        return message
    if isinstance(message, DecodedImage):
        return message.pixels
    if hasattr(message, 'format'):
        return decode_compressed(message.data)
    return decode(message.encoding, message.height, message.width, message.step,
                  bool(message.is_bigendian), message.data)


def decode(encoding: str, height: int, width: int, step: int, is_bigendian: bool,
           data: Any) -> GrayImage:
    """
    Return an Image's payload as (height, width) uint8.

    :param encoding: as in ``sensor_msgs/image_encodings``.
    :param step: bytes per row, padding included.
    :param is_bigendian: byte order of 16-bit pixels.
    :param data: the payload: bytes, ``array.array('B')`` or any other buffer of bytes.
    :raises ValueError: for an unknown encoding, an impossible step, or short data.
    """
    if encoding not in _ENCODINGS:
        raise ValueError(f'encoding = {encoding!r}: must be one of {", ".join(_ENCODINGS)}')
    size, conversion = _ENCODINGS[encoding]
    if height <= 0 or width <= 0:
        raise ValueError(f'image = {width}x{height}: must be at least 1x1 px')
    if step < width * size:
        raise ValueError(f'step = {step}: a row of {width} px in {encoding} takes '
                         f'at least {width * size} bytes')
    payload = np.frombuffer(data, dtype=np.uint8)
    needed = (height - 1) * step + width * size  # the last row needs no padding
    if payload.size < needed:
        raise ValueError(f'data has {payload.size} bytes: {width}x{height} px in {encoding} with '
                         f'step {step} takes at least {needed}')
    stride = step if height > 1 else width * size  # the step of a single row has no meaning
    rows = np.lib.stride_tricks.as_strided(payload, (height, width * size), (stride, 1))
    if encoding in _WIDE:
        rows = _narrowed(np.ascontiguousarray(rows).view('>u2' if is_bigendian else '<u2'))
        size //= 2
    if conversion is None:
        return rows
    pixels = np.ascontiguousarray(rows if size == 1 else rows.reshape(height, width, size))
    gray: Any = cv2.cvtColor(pixels, conversion)
    return gray


def decode_compressed(data: Any) -> GrayImage:
    """
    Return a JPEG or PNG payload as (height, width) uint8.

    :raises ValueError: if OpenCV cannot decode it, or ``file_size`` refuses it.
    """
    payload = np.frombuffer(data, dtype=np.uint8)
    file_size(payload.tobytes())
    # The calibration is for the sensor's own rows: an EXIF orientation must not turn them.
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(payload, flags)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(f'compressed image of {payload.size} bytes: cannot be decoded')
    return image if image.dtype == np.uint8 else _narrowed(image)


def _narrowed(pixels: Any) -> GrayImage:
    """
    Return 16-bit pixels as their 8 highest bits in use (10- and 12-bit sensors stay bright).

    Sensors of as many bits have hot pixels beyond them: one in a thousand does not count.
    """
    used = int(np.partition(pixels.ravel(), -1 - pixels.size // 1000)[-1 - pixels.size // 1000])
    shift = max(0, used.bit_length() - 8)
    return np.minimum(pixels >> shift, 255).astype(np.uint8)


def draw_line(canvas: Any, pixels: Array, color: Any) -> None:
    """Draw a line through pixels (n, 2), unless a point is NaN or far outside."""
    if (np.abs(pixels) < FARTHEST_PIXEL).all():
        fixed = np.rint(pixels * 2**_SHIFT).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(canvas, [fixed], False, color, 2, cv2.LINE_AA, _SHIFT)


def gray_levels(image: GrayImage, pixels: Array) -> Any:
    """Return the brightness (n,) at pixels (n, 2); outside the image, that of its border."""
    return cv2.remap(image, pixels.astype(np.float32)[:, None], None, cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REPLICATE).ravel().astype(np.float32)
