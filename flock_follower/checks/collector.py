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

"""Takes messages one by one, from a node or a bag, and keeps what the checks judge."""

from __future__ import annotations

from collections import Counter
from typing import Any, Final

import numpy as np

from flock_follower.checks.image_motion import shift, small
from flock_follower.checks.observations import (
    Observations,
    odometry_row,
    Picture,
    Told,
    TopicSeen,
)
from flock_follower.checks.pictures import camera_model
from flock_follower.checks.sightings import sightings
from flock_follower.checks.topic_names import COMPRESSED_IMAGES, RAW_IMAGES
from flock_follower.geometry import Array
from flock_follower.messages import stamp_to_nanoseconds
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import decode_image, GrayImage
from flock_follower.perception.markers import Detections, dictionary_names, NeighborConfig
from flock_follower.perception.search import everywhere

#: Images that are looked at for markers, and how far apart they are at least, s; at least so many,
#: and for more only so many bytes are kept.
MOST_PICTURES: Final = 30
PICTURE_PERIOD: Final = 0.1
FEWEST_PICTURES: Final = 20
MOST_BYTES: Final = 60e6
#: Two images whose shift is measured are so far apart, s; so many pairs are wanted.
PAIR: Final = (0.03, 0.16)
PAIRS: Final = 60
#: Dictionaries to look in where no marker of ours is found: each family's largest.
OTHERS: Final = ('DICT_4X4_1000', 'DICT_5X5_1000', 'DICT_6X6_1000', 'DICT_7X7_1000',
                 'DICT_ARUCO_ORIGINAL', 'DICT_APRILTAG_25h9', 'DICT_APRILTAG_36h11')
SEARCHED: Final = 6  # pictures
SEEN_TWICE: Final = 2


class Collector:
    """
    Fills ``observations``.

    :param duration: how long what comes will last, s: of a long bag few images are looked at.
    """

    def __init__(self, observations: Observations, duration: float) -> None:
        self.observations = observations
        self._duration = duration
        self._pair_period = duration / PAIRS
        self._kept: list[tuple[Picture, GrayImage]] = []
        self._next_picture = self._next_pair = -np.inf
        self._small: tuple[float, Array] | None = None

    def heard(self, topic: str, arrival: float, stamp: float = 0.0) -> None:
        """Take that a message came; times in s."""
        seen = self.observations.topics.setdefault(topic, TopicSeen())
        seen.arrivals.append(arrival)
        seen.stamps.append(stamp)

    def take(self, name: str, message: Any, arrival: float) -> None:
        """Take a message of one of our topics, or of /diagnostics; others are only heard."""
        if name == 'odom':
            self.odometry(message, arrival)
        elif name in (RAW_IMAGES, COMPRESSED_IMAGES):
            self.image(message, arrival)
        elif name == 'camera_info':
            self.camera_info(message)
        elif name == 'mavlink/odom':
            self.autopilot(message, arrival)
        elif name == 'diagnostics':
            self.diagnostics(message)

    def odometry(self, message: Any, arrival: float) -> None:
        """Take an Odometry of ``odom``."""
        self.frames(message)
        self.observations.odometry.append(odometry_row(message, arrival))

    def frames(self, message: Any) -> None:
        """Take the frames of an Odometry of ``odom``."""
        frames = [message.header.frame_id, message.child_frame_id]
        if self.observations.frames[-1:] != [frames]:
            self.observations.frames.append(frames)

    def autopilot(self, message: Any, arrival: float) -> None:
        """Take an Odometry of ``mavlink/odom``."""
        self.observations.autopilot.append(odometry_row(message, arrival))

    def camera_info(self, message: Any) -> None:
        """Take a CameraInfo."""
        roi = message.roi
        self.observations.calibration = {
            'width': int(message.width), 'height': int(message.height),
            'model': str(message.distortion_model),
            **{name: [float(x) for x in getattr(message, name)] for name in 'kdp'},
            'window': [int(x) for x in (
                roi.x_offset, roi.y_offset, roi.width or message.width,
                roi.height or message.height, max(message.binning_x, 1),
                max(message.binning_y, 1))]}

    def image(self, message: Any, arrival: float) -> None:
        """Take an Image or CompressedImage; only some are decoded."""
        pair_due = arrival >= self._next_pair
        picture_due = pair_due and arrival >= self._next_picture  # each image is decoded once
        if not picture_due and not pair_due:
            return
        picture = Picture(
            stamp_to_nanoseconds(message.header.stamp) * 1e-9, getattr(message, 'width', 0),
            getattr(message, 'height', 0), getattr(message, 'encoding', '') or message.format,
            len(message.data))
        try:
            pixels = decode_image(message)
        except ValueError as error:
            picture.fault = str(error)
            if picture_due:
                self._next_picture = arrival + self._picture_period(0)
                self.observations.pictures.append(picture)
            return
        if pair_due:
            self._pair(picture.stamp, arrival, pixels)
        if picture_due:
            self._next_picture = arrival + self._picture_period(pixels.size)
            picture.height, picture.width = pixels.shape
            coarse = pixels[::4, ::4]
            picture.brightness, picture.contrast = float(coarse.mean()), float(coarse.std())
            self._kept.append((picture, pixels))

    def _picture_period(self, size: int) -> float:
        """Return how far apart images of so many bytes are looked at, s."""
        room = int(MOST_BYTES / max(size, 1))
        count = min(max(room, FEWEST_PICTURES), MOST_PICTURES)
        return max(PICTURE_PERIOD, self._duration / count)

    def _pair(self, stamp: float, arrival: float, pixels: GrayImage) -> None:
        """Measure how the image moved since the one before, if that is about as old."""
        reduced, before = small(pixels), self._small
        if before is not None and stamp - before[0] < PAIR[0]:
            return  # the next one is further off
        if before is None or stamp - before[0] > PAIR[1]:
            self._small = stamp, reduced
            return
        right, down, quality = shift(before[1], reduced, pixels.shape[1])
        self.observations.shifts.append([before[0], stamp, right, down, quality])
        self._small, self._next_pair = None, arrival + self._pair_period

    def diagnostics(self, message: Any) -> None:
        """Take a DiagnosticArray; the newest of each name counts."""
        for status in message.status:
            level = status.level
            self.observations.told[status.name] = Told(
                level[0] if isinstance(level, bytes) else int(level), status.message,
                {item.key: item.value for item in status.values})

    def finish(self, config: NeighborConfig) -> None:
        """Look for the markers in the images that were kept."""
        seen = self.observations
        seen.dictionary = config.dictionary
        seen.wanted_markers = {number: marker.neighbor.name
                               for number, marker in config.by_marker().items()}
        seen.marker_sides = {number: of.marker.side_length
                             for number, of in config.by_marker().items()}
        camera = self._camera()
        for picture, pixels in self._kept:
            found = everywhere(pixels, config.dictionary, False)
            if not set(found.ids.tolist()) & set(seen.wanted_markers):  # a third of the time
                found = everywhere(pixels, config.dictionary, True)
            picture.markers = _sides(found)
            picture.repeated = sorted(number for number, times in Counter(
                found.ids.tolist()).items() if times > 1)
            seen.pictures.append(picture)
            if camera is not None and pixels.shape == (camera.height, camera.width):
                seen.sightings += sightings(picture.stamp, pixels, camera, found, config)
        if not any(set(picture.markers) & set(seen.wanted_markers) for picture in seen.pictures):
            every = max(1, len(self._kept) // SEARCHED)
            seen.strangers = _strangers([pixels for _, pixels in self._kept[::every]],
                                        config.dictionary)
        self._kept.clear()

    def _camera(self) -> CameraModel | None:
        try:
            return camera_model(self.observations)
        except (KeyError, ValueError):
            return None  # told where calibrations are looked at


def _sides(found: Detections) -> dict[int, float]:
    """Return the mean side of each marker found, px, by its id."""
    return {int(number): float(np.mean(np.linalg.norm(
        corners - np.roll(corners, 1, axis=0), axis=1)))
        for number, corners in zip(found.ids, found.corners)}


def _strangers(images: list[GrayImage], dictionary: str) -> dict[str, list[int]]:
    """Return the markers of other dictionaries that are in at least two images, by dictionary."""
    found: dict[str, list[int]] = {}
    known = dictionary_names()
    for name in (dictionary, *(other for other in OTHERS if other in known)):
        count = Counter(number for image in images
                        for number in _sides(everywhere(image, name, True)))
        often = sorted(number for number, times in count.items()
                       if times >= min(SEEN_TWICE, len(images)))
        if often:
            found[name] = often
            break
    return found
