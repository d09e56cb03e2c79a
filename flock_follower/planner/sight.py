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
Field of view of the cameras, and occlusion of the faced neighbor: its marker should be visible.

A lens is a pinhole or an equidistant fisheye here, without distortion (``FieldOfView.of_camera``).

If a marker leaves the image, it is expected to come back, and the follower coasts. If a marker is
predicted well inside the image and is not found, an obstacle in the follower's way covers it, and
the follower brakes. No function reads a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    Array,
    GRAVITY,
    quaternion_from_rpy,
    quaternion_to_matrix,
    wrap_angle,
)
from flock_follower.planner.inputs import Neighbor, OwnState, propagate

IMAGE_MARGIN = 0.05  # rad from the edge of the image: half a marker, and a wobbling attitude
WIDEST = 1.4  # rad off the axis of a fisheye lens, and off the direction ahead: usable up to here


class FieldOfView(NamedTuple):
    """Field of view of a camera, as angles from the body's forward axis, rad."""

    left: float
    right: float
    up: float
    down: float
    heading: float = 0.0
    """Anticlockwise angle of the camera's axis, rad, if there are several cameras; the other
    angles count from it."""

    @classmethod
    def of_camera(cls, info: Any, rpy: ArrayLike, several: bool = False,
                  rectified: bool = False) -> FieldOfView:
        """
        Return the field of view of a camera.

        :param info: its CameraInfo.
        :param rpy: roll, pitch and yaw of the camera on the body, (3,), rad.
        :param several: whether there are several cameras, which may look to any side.
        :param rectified: whether its images are undistorted already, so that P is used.
        :raises ValueError: if it looks neither ahead nor to a side, or K or P is invalid.
        """
        angles, width, height = np.asarray(rpy, dtype=float).tolist(), info.width, info.height
        mounting = quaternion_to_matrix(quaternion_from_rpy(*angles))
        heading = math.atan2(mounting[1, 0], mounting[0, 0]) if several else 0.0
        matrix = np.reshape(info.p, (3, 4)) if rectified else np.reshape(info.k, (3, 3))
        (fx, _, cx, *_), (_, fy, cy, *_) = matrix[:2].tolist()
        if not (fx > 0.0 and fy > 0.0 and width > 0 and height > 0):
            raise ValueError(f'camera_info: fx = {fx:g}, fy = {fy:g}, {width} x {height} pixels: '
                             'must all be above 0')
        # The middles of the four sides of the image: forward, left, up of the camera.
        sides = np.array([[1.0, cx / fx, 0.0], [1.0, (cx - width) / fx, 0.0],
                          [1.0, 0.0, cy / fy], [1.0, 0.0, (cy - height) / fy]])
        fisheye = info.distortion_model == 'equidistant' and not rectified
        if fisheye:
            sides[:, 1:] = np.tan(np.clip(sides[:, 1:], -WIDEST, WIDEST))
        ahead = quaternion_to_matrix(quaternion_from_rpy(0.0, 0.0, -heading)) @ mounting
        sides = sides @ ahead.T
        if fisheye and ahead[0, 0] > math.cos(WIDEST):
            sides[:, 0] = np.maximum(sides[:, 0], np.hypot(*sides[:, 1:].T) / math.tan(WIDEST))
        if np.any(sides[:, 0] <= 0.0):
            raise ValueError(
                f'rpy = {angles}: a camera that looks up or down: the neighbor is not kept in its '
                'sight' if several else f'camera_rpy = {angles}: the camera must look ahead')
        aside = np.arctan2(sides[:2, 1], sides[:2, 0]).tolist()
        up = np.arctan2(sides[2:, 2], sides[2:, 0]).tolist()
        if not several and not (aside[1] < 0.0 < aside[0] and up[1] < 0.0 < up[0]):
            raise ValueError(f'camera_rpy = {angles}: the forward direction must be in the image')
        return cls(max(aside), -min(aside), max(up), -min(up), heading)

    def angle_outside(self, bearing: float, edge: float = 0.0) -> float:
        """Return the angle, rad, from the image, shrunk by ``edge``, to a bearing; 0 inside."""
        off = wrap_angle(bearing - self.heading)
        return max(off - self.left + edge, edge - self.right - off, 0.0)


FieldsOfView = tuple[FieldOfView, ...]
"""Fields of view of all cameras; () if unknown."""


def visible(view: FieldsOfView, offset: Array, yaw: float, forward: float, margin: float) -> bool:
    """
    Return whether a neighbor is in an image, at least a margin, m, inside its edge.

    :param offset: its position minus the ego one (3,), m; :param yaw: the ego one, rad.
    :param forward: ego acceleration ahead, m/s^2, which tilts the camera.
    """
    x, y, z = offset.tolist()
    distance = math.hypot(x, y)
    if distance <= margin:
        return False
    edge = math.atan(margin / math.hypot(distance, z))
    elevation, bearing = math.atan2(z, distance), math.atan2(y, x) - yaw
    return any(f.angle_outside(bearing, edge) <= 0.0 and edge - f.down <= elevation + math.atan(
        forward * math.cos(f.heading) / GRAVITY) <= f.up - edge for f in view)


def vertical(view: FieldsOfView, bearing: float) -> tuple[float, float]:
    """
    Return the largest angles up and down, rad, in the images that are nearest to a bearing.

    :param bearing: from the forward axis, rad.
    """
    off = [f.angle_outside(bearing) for f in view]
    seeing = [f for f, outside in zip(view, off) if outside <= min(off)]
    return max(f.up for f in seeing), max(f.down for f in seeing)


#: Consecutive processed images without the marker that begin an occlusion, and with it to end it.
OCCLUSION_IMAGES = 3
#: The same, to begin, of a neighbor without markers: other detectors miss single images. Of a
#: detector that misses a quarter of them, three in a row are missed every 8 s at 10 Hz.
OCCLUSION_IMAGES_NO_MARKER = 5
MOST_PATIENT = 0.7  # s: age of an estimate from which on IMAGES count for any detector
#: Distance of the predicted marker to the image's edge, m: two markers of 0.2 m.
OCCLUSION_MARGIN = 0.4
_STAMP_TOLERANCE = 1e-6  # s: stamps that differ by less are of one image


class Occlusion(NamedTuple):
    """A neighbor is missing in consecutive images that should show it."""

    lost: float
    """Stamp of the last estimate before the occlusion, s."""
    found: float = math.inf
    """Stamp of the first of the estimates that may end the occlusion, s."""


def occlusion(before: Occlusion | None, n: Neighbor | None, me: OwnState,
              frames: Sequence[float], view: FieldsOfView, forward: float) -> Occlusion | None:
    """
    Return the occlusion of a neighbor by any object; None if it is not occluded.

    :param before: the occlusion in the last step.
    :param n: its newest estimate; None if there is none.
    :param me: ego state now.
    :param frames: stamps of the newest processed images, s, in their order.
    :param forward: ego acceleration ahead, m/s^2, which tilts the camera.
    """
    if n is None or n.received or not view:
        return None if n is None else before
    missed = sum(stamp > n.stamp + _STAMP_TOLERANCE for stamp in frames)
    if before is None:
        offset = propagate(n, me.stamp).position - me.position
        patient = not n.member.faces and me.stamp - n.stamp < MOST_PATIENT
        needed = OCCLUSION_IMAGES_NO_MARKER if patient else OCCLUSION_IMAGES
        lost = missed >= needed and visible(view, offset, me.yaw, forward, OCCLUSION_MARGIN)
        return Occlusion(n.stamp) if lost else None
    if missed >= OCCLUSION_IMAGES:
        return Occlusion(n.stamp)
    found = min(before.found, n.stamp) if n.stamp > before.lost + _STAMP_TOLERANCE else math.inf
    shown = sum(found - _STAMP_TOLERANCE <= stamp <= n.stamp + _STAMP_TOLERANCE
                for stamp in frames)
    return None if shown >= OCCLUSION_IMAGES else before._replace(found=found)
