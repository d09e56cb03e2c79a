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
"""

from __future__ import annotations

import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.corners import marker_corners, refine
from flock_follower.perception.neighbors import Neighbor


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
