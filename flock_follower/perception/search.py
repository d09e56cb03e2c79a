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
Cameras that expose one row after another: when a neighbour was exposed, and where it was then.

Row r of an image h high is exposed r / h * readout_time after the first, whose time is the stamp.
A neighbour is taken to be seen when the row of its markers' middle was. The rows above and below
see it earlier and later, a little from there: the marker looks sheared or stretched, which a fit
takes for another attitude and range. How the marker moves past the camera is known, mostly from
the own rates, so its corners are put where they were with the middle, and the pose with them.

Where in an image to look for markers, and how hard.
"""

from __future__ import annotations

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception import markers as aruco
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edge_fit import marker_corners, refine
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import Neighbor


def delay(camera: CameraModel, readout_time: float, seen: Array) -> float:
    """
    Return how long after the first row a point (3,) in the optical frame was exposed, s.

    :param readout_time: from the first row to the last, s.
    """
    row = float(camera.project(seen[None])[0, 1])
    # Written so that NaN is the middle.
    share = row / camera.height if 0.0 <= row <= camera.height else 0.5
    return readout_time * share


def straightened(camera: CameraModel, readout_time: float, neighbor: Neighbor,
                 T_camera_body: Transform, reference: Array, velocity: Array,
                 rates: Array) -> Transform:
    """
    Return the pose of a neighbour at the time of one row, from the pose fitted to all of them.

    :param reference: the point (3,) on its body whose row that is, m.
    :param velocity: of that point seen from the camera, m/s, and :param rates: rad/s, at which the
        body turns there: (3,) along the camera's axes.
    """
    points = np.concatenate([
        marker.T_body_marker.apply(marker_corners(marker.side_length))
        for marker in neighbor.markers
        if _faces(T_camera_body @ marker.T_body_marker)] or [np.zeros((0, 3))])
    if not len(points):
        return T_camera_body
    seen = T_camera_body.apply(points)
    middle = T_camera_body.apply(reference)
    rows = camera.project(np.concatenate([seen, middle[None]]))[:, 1]
    later = readout_time / camera.height * (rows[:-1] - rows[-1])
    moved = later[:, None] * (velocity + np.cross(rates, seen - middle))
    found = refine(camera.project(seen - moved), camera, points, reference, T_camera_body)
    return T_camera_body if found is None else found.pose


def _faces(T_camera_marker: Transform) -> bool:
    normal = T_camera_marker.rotation[:, 2]
    return float(normal.dot(T_camera_marker.translation)) < 0.0


#: Sides of the adaptive threshold's window, px: one finds a marker of the size it is scaled to;
#: three, OpenCV's own, find more, also in the dark, and take three times as long.
ONE_WINDOW = aruco.DetectionParams(windows=(15, 15, 10))
THREE_WINDOWS = aruco.DetectionParams(windows=(3, 23, 10), min_perimeter=0.03, threshold=4.0)
#: Near an expected place the image is scaled so that the marker's side has this many px.
SIDE = 56.0
#: From this width on, px, a whole image is searched at half its size.
LARGE = 1280


def near(image: GrayImage, camera: CameraModel, dictionary: str, neighbor: Neighbor,
         expected: Transform, thorough: bool) -> aruco.Detections:
    """
    Return the markers about where a neighbour is expected (``T_camera_body``).

    :param thorough: whether to look with three windows instead of one.
    """
    outlines = [camera.project((expected @ marker.T_body_marker).apply(
        marker_corners(marker.side_length))) for marker in neighbor.markers]
    outlines = [outline for outline in outlines if np.all(np.isfinite(outline))]
    if not outlines:
        return aruco.NONE
    side = max(float(np.max(np.linalg.norm(o - np.roll(o, 1, axis=0), axis=1))) for o in outlines)
    places = np.concatenate(outlines)
    margin = max(24.0, 0.75 * side)
    height, width = image.shape
    x0, y0 = np.clip(places.min(axis=0) - margin, 0, (width, height)).astype(int).tolist()
    x1, y1 = np.clip(places.max(axis=0) + margin, 0, (width, height)).astype(int).tolist()
    if min(x1 - x0, y1 - y0) < margin:
        return aruco.NONE
    scale = float(np.clip(SIDE / max(side, 1.0), 0.1, 2.0))
    if 0.75 < scale < 1.3:
        scale = 1.0
    return _search(image, (x0, y0, x1, y1), scale, dictionary,
                   THREE_WINDOWS if thorough else ONE_WINDOW)


def everywhere(image: GrayImage, dictionary: str, thorough: bool) -> aruco.Detections:
    """Return the markers in an image; see :func:`near`."""
    height, width = image.shape
    return _search(image, (0, 0, width, height), 0.5 if width >= LARGE else 1.0, dictionary,
                   THREE_WINDOWS if thorough else ONE_WINDOW)


def _search(image: GrayImage, region: tuple[int, int, int, int], scale: float, dictionary: str,
            params: aruco.DetectionParams) -> aruco.Detections:
    x0, y0, x1, y1 = region
    part = image[y0:y1, x0:x1]
    if scale != 1.0:
        size = max(round(scale * (x1 - x0)), 1), max(round(scale * (y1 - y0)), 1)
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1.0
                          else cv2.INTER_LINEAR)
    found = aruco.detect(np.ascontiguousarray(part), dictionary, params)
    # Pixel centres are whole numbers: half a pixel off before scaling, and after.
    scales = np.array([part.shape[1] / (x1 - x0), part.shape[0] / (y1 - y0)])
    corners: Array = (found.corners + 0.5) / scales - 0.5 + np.array([x0, y0])
    return aruco.Detections(found.ids, corners)
