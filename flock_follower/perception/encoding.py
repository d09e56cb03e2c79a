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

"""Images as JPEG files, for recordings and views; ``images`` decodes them."""

from __future__ import annotations

import cv2

from flock_follower.perception.images import GrayImage


def encode_jpeg(image: GrayImage, quality: int) -> bytes:
    """
    Return a (height, width) uint8 image as a JPEG file of a quality from 0 to 100.

    :raises ValueError: if OpenCV cannot encode it.
    """
    done, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f'image of {image.shape[1]}x{image.shape[0]} px: cannot be encoded')
    return bytes(data)
