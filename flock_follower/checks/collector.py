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

from collections.abc import Container
from functools import partial
import math
from typing import Any, Final

import numpy as np

from flock_follower.checks.image_motion import measure_shifts, OwnPath, small
from flock_follower.checks.observations import (
    NodeStatus,
    Observations,
    OwnMotion,
    Picture,
    TopicSeen,
)
from flock_follower.checks.pictures import camera_model
from flock_follower.checks.pose_topics import Arrival, judge_poses
from flock_follower.geometry import Array, quaternion_to_matrix
from flock_follower.messages import NANOSECONDS, stamp_to_nanoseconds, to_nanoseconds
from flock_follower.messages.poses import from_pose
from flock_follower.messages.topic_names import COMPRESSED_IMAGES, full_name, RAW_IMAGES
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.parameters.neighbors_file import NeighborConfig
from flock_follower.parameters.sections import PARAMETER_FILES
from flock_follower.parameters.spec import filled
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import decode_image, GrayImage
from flock_follower.perception.markers import Detections
from flock_follower.perception.measurement import PosePrior
from flock_follower.perception.observed_wait import MAX_WAIT
from flock_follower.perception.pose import locate, target
from flock_follower.perception.prints import BORDER_WIDTHS, Fault, turned_print, wrong_border
from flock_follower.perception.search import everywhere
from flock_follower.perception.tracker import camera_mounting

N_PICTURES: Final = 25  # images that are searched for markers
PICTURE_PERIOD: Final = 0.1  # s, least time between two of these images
PAIR_GAP: Final = (0.03, 0.16)  # s, least and largest time between two images that are compared
N_PAIRS: Final = 90  # pairs of images whose shift is measured
MIRRORED, INVERTED = 'print mirrored', 'print inverted'
#: The name of all topics with the poses of another detector.
POSES: Final = 'poses'


class Collector:
    """
    Fills ``observations``.

    :param duration: length of the observation, s: the longer, the smaller the share of images that
        are searched.
    """

    def __init__(self, observations: Observations, duration: float) -> None:
        self.observations = observations
        self._picture_period = max(PICTURE_PERIOD, duration / N_PICTURES)
        self._pair_period = duration / N_PAIRS
        self._kept: list[tuple[Picture, GrayImage]] = []
        self._next_picture = self._next_pair = -math.inf
        self._small: tuple[float, Array] | None = None
        self._odometry: list[tuple[int, Any]] = []
        self._poses: dict[str, list[Arrival]] = {}
        """Poses by another detector, by the full name of the topic."""

    def take(self, name: str, topic: str, message: Any, arrival: float) -> None:
        """
        Take a message that arrived at a time, s.

        :param name: our name of the topic; '' if its content is not used.
        :param message: None if only its arrival counts.
        """
        seen, header = self.observations, getattr(message, 'header', None)
        stamp = 0.0 if header is None else stamp_to_nanoseconds(header.stamp) / NANOSECONDS
        known = seen.topics.setdefault(topic, TopicSeen())
        known.arrivals.append(arrival)
        known.stamps.append(stamp)
        if message is None:
            return
        if name == 'odom' and seen.own is None:
            self._odometry.append((to_nanoseconds(arrival), message))
        elif name in (RAW_IMAGES, COMPRESSED_IMAGES):
            self._image(message, arrival, stamp)
        elif name == 'camera_info':
            seen.calibration = message
        elif name == '/diagnostics':
            self.diagnostics(message)
        elif name == POSES:
            self._take_pose(topic, message, arrival)

    def _take_pose(self, topic: str, message: Any, arrival: float) -> None:
        try:
            pose = from_pose(message)
        except ValueError:  # an invalid stamp: the latency shows it
            return
        self._poses.setdefault(topic, []).append(Arrival(arrival, pose))

    def diagnostics(self, message: Any) -> None:
        """Take a DiagnosticArray; the newest of each name counts."""
        for status in message.status:
            level = status.level
            self.observations.statuses[status.name] = NodeStatus(
                level[0] if isinstance(level, bytes) else int(level), status.message,
                {item.key: item.value for item in status.values})
            files = self.observations.statuses[status.name].values.get(PARAMETER_FILES)
            known = self.observations.files.setdefault(status.name, [])
            if files is not None and files not in known:
                known.append(files)

    def _image(self, message: Any, arrival: float, stamp: float) -> None:
        """Take an Image or CompressedImage: only some are decoded."""
        if arrival < min(self._next_pair, self._next_picture):
            return
        picture = Picture(stamp, getattr(message, 'width', 0), getattr(message, 'height', 0),
                          getattr(message, 'encoding', '') or getattr(message, 'format', ''),
                          len(message.data))
        due = arrival >= self._next_picture
        if due:
            self._next_picture = arrival + self._picture_period
        try:
            pixels = decode_image(message)
        except ValueError as error:
            picture.fault = str(error)
            self.observations.pictures += [picture] if due else []
            return
        if arrival >= self._next_pair:
            self._measure_shift(stamp, arrival, pixels)
        if due:
            picture.height, picture.width = pixels.shape
            coarse = pixels[::4, ::4]
            picture.brightness, picture.contrast = float(coarse.mean()), float(coarse.std())
            self._kept.append((picture, pixels))

    def _measure_shift(self, stamp: float, arrival: float, pixels: GrayImage) -> None:
        """Measure the shift since the previous image, if the time between both is suitable."""
        reduced, before = small(pixels), self._small
        if before is not None and stamp - before[0] < PAIR_GAP[0]:
            return  # the next one is further off
        if before is None or stamp - before[0] > PAIR_GAP[1]:
            self._small = stamp, reduced
            return
        self.observations.shifts.append(
            [before[0], stamp, *measure_shifts(before[1], reduced, pixels.shape[1]).ravel()])
        self._small, self._next_pair = None, arrival + self._pair_period

    def finish(self, config: NeighborConfig) -> None:
        """
        Read the odometry if that was not done, and search the images for markers.

        ``sightings`` gets a row for each configured marker whose edges show its position: stamp,
        s; id; position (3), m, of the marker in the camera's optical frame.
        """
        seen, markers = self.observations, config.by_marker()
        if seen.own is None:
            seen.own = read_own_motion(seen, self._odometry)
        seen.dictionary = config.dictionary
        seen.marker_sides = {number: marker.side_length for number, (_, marker) in markers.items()}
        try:
            camera = camera_model(seen)
        except ValueError:
            camera = None  # reported with the calibration
        self._judge_poses(config)
        if not seen.has_markers:
            self._kept.clear()
        states = seen.own.states
        path = OwnPath(states) if len(states) > 1 else None
        thoroughly = partial(everywhere, markers=[marker for _, marker in markers.values()])
        for picture, pixels in self._kept:
            found = everywhere(pixels, config.dictionary)
            for search in (thoroughly, _with_wide_borders):  # which take longer
                if not markers.keys() & set(found.ids.tolist()):
                    found = _concatenate(found, search(pixels, config.dictionary))
            if not len(found.ids):
                picture.misprints += _never_detected(pixels, config.dictionary, markers)
            fits = camera is not None and pixels.shape == (camera.height, camera.width)
            up = _upwards(seen, path, picture.stamp) if len(found.ids) else None
            seen.sightings += self._measure(
                picture, pixels, camera if fits else None, found, config, up)
            seen.pictures.append(picture)
        self._kept.clear()

    def _judge_poses(self, config: NeighborConfig) -> None:
        """Take the poses by another detector as relative_pose does."""
        seen, frame = self.observations, getattr(self.observations.calibration, 'header', None)
        seen.frames_topic = config.frames_topic
        mounting = camera_mounting(*(seen.value('relative_pose', name, [0.0, 0.0, 0.0])
                                     for name in ('camera_position', 'camera_rpy')))
        if all(n.source is None for n in config.neighbors):
            seen.sources = {}
            return
        seen.sources = judge_poses(
            config, {n.name: self._poses.get(full_name(n.source.topic, seen.namespace), [])
                     for n in config.neighbors if n.source is not None and n.source.topic},
            seen.own.states if seen.own else [],
            {frame.frame_id: mounting} if frame is not None and frame.frame_id else {},
            seen.static, seen.value('relative_pose', 'max_wait', MAX_WAIT))

    def _measure(self, picture: Picture, pixels: GrayImage, camera: CameraModel | None,
                 found: Detections, config: NeighborConfig, up: Array | None
                 ) -> list[list[float]]:
        """
        Record the markers that are found in an image; return their rows of ``sightings``.

        :param camera: None if unknown: then each quadrilateral with a valid code counts as a
            marker.
        :param up: (3,), the upward direction in the camera's axes; None if unknown.
        """
        rows, by_marker = [], config.by_marker()
        for number, corners in zip(found.ids.tolist(), found.corners):
            side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
            if number not in by_marker:
                picture.markers[number] = side
                continue
            neighbor, marker = by_marker[number]
            fault = wrong_border(pixels, corners, config.dictionary, marker)
            if fault is None and camera is not None:
                measured = locate(pixels, camera, target(neighbor, config.dictionary),
                                  neighbor.markers.index(marker), corners, PosePrior(None, up))
                if measured is None:
                    picture.outlines.append(number)
                    continue
                fault = turned_print(measured.T_camera_body, up, marker)
                if measured.spacing is not None:
                    position = (measured.T_camera_body @ marker.T_body_marker).translation
                    rows.append([picture.stamp, float(number), *position.tolist()])
            if fault is None:
                picture.markers[number] = side
            else:
                picture.misprints.append(fault)
        return rows


def read_own_motion(seen: Observations, messages: list[tuple[int, Any]]) -> OwnMotion:
    """Return Odometry messages, each with its arrival, ns, as our nodes read them."""
    try:
        params = filled(SourceParams(), seen.parameters['relative_pose'], 'odom_')
    except (KeyError, ValueError):
        params = SourceParams()
    motion = OwnMotion(OdometrySource(params, seen.static))
    for arrival, message in messages:
        motion.take(message, arrival)
    return motion


def _upwards(seen: Observations, path: OwnPath | None, stamp: float) -> Array | None:
    """Return the upward direction (3,) in the camera's axes at a stamp, s; None if unknown."""
    if path is None:
        return None
    quaternions, known = path.attitude(np.array([stamp]))
    up: Array = (quaternion_to_matrix(quaternions[0]) @ seen.camera_rotation)[2]
    return up if known[0] else None


def _with_wide_borders(image: GrayImage, dictionary: str) -> Detections:
    """Return the markers with a border of two or three cells, and some with one."""
    return _concatenate(*(
        everywhere(image, dictionary, border=border) for border in BORDER_WIDTHS[1:]))


def _never_detected(image: GrayImage, dictionary: str, ours: Container[int]) -> list[Fault]:
    """Return the faults of our markers in an image without any that can be detected."""
    return [Fault(reason, f'marker {number} is {reason.removeprefix("print ")}', remedy)
            for reason, changed, remedy in (
                (MIRRORED, np.ascontiguousarray(image[:, ::-1]),
                 'print it as the command marker draws it; does the camera mirror its images?'),
                (INVERTED, 255 - image, 'print it black on white'))
            for number in everywhere(changed, dictionary).ids.tolist() if number in ours]


def _concatenate(*found: Detections) -> Detections:
    """Return all the markers of several searches."""
    return Detections(np.concatenate([each.ids for each in found]),
                      np.concatenate([each.corners for each in found]))
