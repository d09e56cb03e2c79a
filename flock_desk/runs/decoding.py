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

"""Images of a bag, decoded in a second thread while the messages before them are processed."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
import time
from typing import Final

from flock_follower.bags.bag import BagMessage, deserialize
from flock_follower.perception.images import decode_image, DecodedImage

#: Number of images that are decoded ahead.
IMAGES_AHEAD: Final = 4


def decoded_ahead(messages: Iterable[BagMessage], topics: Collection[str]
                  ) -> Iterator[tuple[BagMessage, DecodedImage | None]]:
    """
    Yield messages in their order, each image of the topics decoded; None if that is impossible.

    OpenCV releases Python's lock while it decodes, so a second core is used.
    """
    waiting: deque[tuple[BagMessage, Future[DecodedImage | None] | None]] = deque()
    images = 0
    with ThreadPoolExecutor(1) as worker:
        for message in messages:
            image = worker.submit(_decode, message) if message.topic in topics else None
            waiting.append((message, image))
            images += image is not None
            while images > IMAGES_AHEAD:
                first, image = waiting.popleft()
                images -= image is not None
                yield first, image.result() if image else None
        for first, image in waiting:
            yield first, image.result() if image else None


def _decode(message: BagMessage) -> DecodedImage | None:
    """Return the decoded image; None if damaged: the caller decodes again for the error."""
    try:
        image = deserialize(message.data, message.msgtype)
        start = time.thread_time()
        pixels = decode_image(image)
    except ValueError:
        return None
    return DecodedImage(image, pixels, time.thread_time() - start)
