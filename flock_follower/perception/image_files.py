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
Whether a JPEG or PNG file is whole, and of what size, before anybody decodes it.

Decoders believe their input: one wrong byte in the length of a PNG chunk makes OpenCV allocate
gigabytes for seconds, and a small JPEG can claim to be 65535 pixels wide. OpenCV 4 returns a JPEG
cut short with the missing rows as the memory was: often the image before, with the marker where it
has been. A node that runs in the air looks first.
"""

from __future__ import annotations

from typing import Final

#: The largest image decoded, pixels: 8K, more than any camera in flight sends.
MAX_PIXELS: Final[int] = 7680 * 4320
_PNG: Final[bytes] = b'\x89PNG\r\n\x1a\n'
_JPEG: Final[bytes] = b'\xff\xd8'
_JPEG_SCAN: Final[bytes] = b'\xff\xda'
_JPEG_END: Final[bytes] = b'\xff\xd9'
# Start of frame: every marker from 0xC0 to 0xCF but tables (C4), extensions (C8), arithmetic (CC).
_JPEG_FRAMES: Final[frozenset[int]] = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_FILL: Final[int] = 0xFF


def file_size(data: bytes) -> tuple[int, int]:
    """
    Return width and height, px, of a JPEG or PNG file.

    :raises ValueError: where it is neither, is larger than ``MAX_PIXELS``, its structure does not
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

    Every chunk is a length, a name, so many bytes and a checksum.
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
    """Return the size in the frame header; before it come segments that begin with a length."""
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
