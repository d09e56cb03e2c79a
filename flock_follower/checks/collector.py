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

"""Takes messages one by one, from a node or a bag, and keeps the observations in them."""

from __future__ import annotations

from collections import Counter
import math
from typing import Any, Final

import numpy as np

from flock_follower.checks.image_motion import shift, small
from flock_follower.checks.observations import NodeStatus, Observations, Picture, TopicSeen
from flock_follower.checks.pictures import camera_model
from flock_follower.checks.topic_names import COMPRESSED_IMAGES, RAW_IMAGES
from flock_follower.geometry import Array
from flock_follower.messages import NANOSECONDS, stamp_to_nanoseconds, to_nanoseconds
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import decode_image, GrayImage
from flock_follower.perception.markers import Detections, dictionary_names, NeighborConfig
from flock_follower.perception.measurement import PosePrior
from flock_follower.perception.pose import locate, target
from flock_follower.perception.search import everywhere

#: Number of images that are searched for markers, and least time between them, s. At least so
#: many, and for more only so many bytes, are kept.
MOST_PICTURES: Final = 30
PICTURE_PERIOD: Final = 0.1
FEWEST_PICTURES: Final = 20
MOST_BYTES: Final = 60e6
#: Time between two images whose shift is measured, s, and the number of pairs.
PAIR: Final = (0.03, 0.16)
PAIRS: Final = 90
#: Dictionaries to search if no marker of ours is found: the largest of each family.
OTHERS: Final = ('DICT_4X4_1000', 'DICT_5X5_1000', 'DICT_6X6_1000', 'DICT_7X7_1000',
                 'DICT_ARUCO_ORIGINAL', 'DICT_APRILTAG_25h9', 'DICT_APRILTAG_36h11')
SEARCHED: Final = 6  # pictures
SEEN_TWICE: Final = 2


class Collector:
    """
    Fills ``observations``.

    :param duration: length of the observation, s: of a long bag few images are searched.
    """

    def __init__(self, observations: Observations, duration: float) -> None:
        self.observations = observations
        self._duration = duration
        self._kept: list[tuple[Picture, GrayImage]] = []
        self._next_picture = self._next_pair = -math.inf
        self._small: tuple[float, Array] | None = None

    def take(self, name: str, topic: str, message: Any, arrival: float) -> GrayImage | None:
        """
        Take a message that arrived at a time, s; return the pixels of an image if decoded.

        :param name: our name of the topic; '' if its content is not used.
        :param message: None if only its arrival counts.
        """
        seen, header = self.observations, getattr(message, 'header', None)
        stamp = 0.0 if header is None else stamp_to_nanoseconds(header.stamp) / NANOSECONDS
        known = seen.topics.setdefault(topic, TopicSeen())
        known.arrivals.append(arrival)
        known.stamps.append(stamp)
        if message is None:
            return None
        if name == 'odom':
            frames = [message.header.frame_id, message.child_frame_id]
            if seen.frames[-1:] != [frames]:
                seen.frames.append(frames)
            if seen.own is None:
                seen.odometry.append((to_nanoseconds(arrival), message))
        elif name in (RAW_IMAGES, COMPRESSED_IMAGES):
            return self._image(message, arrival, stamp)
        if name == 'camera_info':
            seen.calibration = message
        elif name == 'mavlink/odom':
            q = message.pose.pose.orientation
            seen.autopilot.append((stamp, np.array([q.x, q.y, q.z, q.w])))
        elif name == '/diagnostics':
            self.diagnostics(message)
        return None

    def diagnostics(self, message: Any) -> None:
        """Take a DiagnosticArray; the newest of each name counts."""
        for status in message.status:
            level = status.level
            self.observations.statuses[status.name] = NodeStatus(
                level[0] if isinstance(level, bytes) else int(level), status.message,
                {item.key: item.value for item in status.values})

    def _image(self, message: Any, arrival: float, stamp: float) -> GrayImage | None:
        """Take an Image or CompressedImage; return its pixels: only some are decoded."""
        if arrival < self._next_pair:
            return None
        picture_due = arrival >= self._next_picture  # each image is decoded once
        picture = Picture(stamp, getattr(message, 'width', 0), getattr(message, 'height', 0),
                          getattr(message, 'encoding', '') or message.format, len(message.data))
        try:
            pixels = decode_image(message)
        except ValueError as error:
            picture.fault = str(error)
            if picture_due:
                self._next_picture = arrival + self._picture_period(0)
                self.observations.pictures.append(picture)
            return None
        self._pair(stamp, arrival, pixels)
        if picture_due:
            self._next_picture = arrival + self._picture_period(pixels.size)
            picture.height, picture.width = pixels.shape
            coarse = pixels[::4, ::4]
            picture.brightness, picture.contrast = float(coarse.mean()), float(coarse.std())
            self._kept.append((picture, pixels))
        return pixels

    def _picture_period(self, size: int) -> float:
        """Return the period of searched images, s, for images of a size, bytes."""
        count = min(max(int(MOST_BYTES / max(size, 1)), FEWEST_PICTURES), MOST_PICTURES)
        return max(PICTURE_PERIOD, self._duration / count)

    def _pair(self, stamp: float, arrival: float, pixels: GrayImage) -> None:
        """Measure the shift since the image before, if the time between them suits."""
        reduced, before = small(pixels), self._small
        if before is not None and stamp - before[0] < PAIR[0]:
            return  # the next one is further off
        if before is None or stamp - before[0] > PAIR[1]:
            self._small = stamp, reduced
            return
        self.observations.shifts.append(
            [before[0], stamp, *shift(before[1], reduced, pixels.shape[1]).ravel()])
        self._small, self._next_pair = None, arrival + self._duration / PAIRS

    def finish(self, config: NeighborConfig) -> None:
        """Search the images that were kept for markers."""
        seen, markers = self.observations, config.by_marker()
        seen.dictionary = config.dictionary
        seen.wanted_markers = {number: of.neighbor.name for number, of in markers.items()}
        seen.marker_sides = {number: of.marker.side_length for number, of in markers.items()}
        try:
            camera = camera_model(seen)
        except ValueError:
            camera = None  # reported with the calibration
        for picture, pixels in self._kept:
            found = everywhere(pixels, config.dictionary)
            if not markers.keys() & set(found.ids.tolist()):
                ours = everywhere(pixels, config.dictionary,
                                  [of.marker for of in markers.values()])
                found = ours if len(ours.ids) else found
            picture.markers = _sides(found)
            picture.repeated = sorted(number for number, times in Counter(
                found.ids.tolist()).items() if times > 1)
            seen.pictures.append(picture)
            if camera is not None and pixels.shape == (camera.height, camera.width):
                seen.sightings += sightings(picture.stamp, pixels, camera, found, config)
        if not any(markers.keys() & picture.markers.keys() for picture in seen.pictures):
            every = max(1, len(self._kept) // SEARCHED)
            seen.strangers = _strangers([pixels for _, pixels in self._kept[::every]],
                                        config.dictionary)
        self._kept.clear()


def sightings(stamp: float, image: GrayImage, camera: CameraModel, found: Detections,
              config: NeighborConfig) -> list[list[float]]:
    """
    Return a row for each marker of ours whose edges show its position.

    Stamp, s; id; position (3), m, its deviation, m, and attitude (x, y, z, w) of the marker in
    the camera (optical).
    """
    rows, by_marker = [], config.by_marker()
    for number, corners in zip(found.ids.tolist(), found.corners):
        if number not in by_marker:
            continue
        neighbor, marker = by_marker[number]
        measured = locate(image, camera, target(neighbor, config.dictionary),
                          neighbor.markers.index(marker), corners, PosePrior())
        if measured is not None and measured.spacing is not None:
            T_camera_marker = measured.T_camera_body @ marker.T_body_marker
            rows.append([stamp, float(number), *T_camera_marker.translation.tolist(),
                         math.sqrt(float(measured.covariance[:3, :3].trace())),
                         *T_camera_marker.quaternion.tolist()])
    return rows


def _sides(found: Detections) -> dict[int, float]:
    """Return the mean side of each marker found, px, by its id."""
    return {int(number): float(np.mean(np.linalg.norm(
        corners - np.roll(corners, 1, axis=0), axis=1)))
        for number, corners in zip(found.ids, found.corners)}


def _strangers(images: list[GrayImage], dictionary: str) -> dict[str, list[int]]:
    """Return the markers that are in at least two images, of the first dictionary with any."""
    known = dictionary_names()
    for name in (dictionary, *(other for other in OTHERS if other in known)):
        count = Counter(number for image in images
                        for number in _sides(everywhere(image, name)))
        if often := sorted(number for number, times in count.items()
                           if times >= min(SEEN_TWICE, len(images))):
            return {name: often}
    return {}
