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

"""Where markers were seen in an image: exactly, so that their places can be compared."""

from __future__ import annotations

import math

from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import Detections, NeighborConfig
from flock_follower.perception.measurement import PosePrior
from flock_follower.perception.pose import locate, target


def sightings(stamp: float, image: GrayImage, camera: CameraModel, found: Detections,
              config: NeighborConfig) -> list[list[float]]:
    """
    Return a row for each marker of ours that was found, where its edges tell its place.

    Stamp, s; number; position (3), m, its deviation, m, and attitude (x, y, z, w) of the marker in
    the camera (optical).
    """
    rows, by_marker = [], config.by_marker()
    for number, corners in zip(found.ids.tolist(), found.corners):
        if number not in by_marker:
            continue
        neighbor, marker = by_marker[number]
        measured = locate(image, camera, target(neighbor, config.dictionary),
                          neighbor.markers.index(marker), corners, PosePrior())
        if measured is None or measured.spacing is None:
            continue
        T_camera_marker = measured.T_camera_body @ marker.T_body_marker
        rows.append([stamp, float(number), *T_camera_marker.translation.tolist(),
                     math.sqrt(float(measured.covariance[:3, :3].trace())),
                     *T_camera_marker.quaternion.tolist()])
    return rows
