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
The size of a marker at rest, from the ratio of the change of distance to the camera's path.

The measured distance to a marker at rest must change by as much as the camera moves towards the
marker. If it changes by more, or less, the configured size (or the focal length) is wrong. Both
changes are measured along the mean line of sight, so a mounting error has almost no effect.

A moving leader can cause the same symptom: if the leader moves away by half the distance that the
follower flies, the configured marker size seems too small. So a ratio counts only if it explains
nearly all changes of the distance.
"""

from __future__ import annotations

from collections import Counter
from typing import Final, NamedTuple

import numpy as np

from flock_follower.checks.findings import (
    ERROR,
    Finding,
    first,
    OK,
    SIGNIFICANT_SIGMAS,
    UNMEASURED,
    WARNING,
)
from flock_follower.checks.image_motion import OwnPath
from flock_follower.checks.observations import Observations
from flock_follower.geometry import Array, quaternion_to_matrix

#: Least number of sightings.
MIN_SIGHTINGS = 12
#: Least RMS way of the camera along the line of sight, m.
MIN_WAY = 0.1
#: A marker is at rest if at most this share of the changes of range is unexplained.
MAX_UNEXPLAINED = 0.15
#: Least and largest ratio of the true size to the configured one that is tried.
RATIO_BOUNDS = (0.4, 2.5)
#: Lasting errors of odometry are partly fitted as motion: errors of the size of tags on walls, in
#: 34 visits, were up to 6.3 plain deviations.
ERROR_FACTOR: Final = 3.0
_MAX_CORRELATION = 0.9  # of neighboring residuals, at most
#: Relative error of the size from which on there is a warning.
SIZE_WARNING = 0.05
#: Relative error of the size from which on there is an error.
SIZE_ERROR = 0.1
HOW: Final = 'stand the leader on the ground, and move the camera 1 m towards it and back'


class Ratio(NamedTuple):
    """
    Ratio of the changes of the measured distance to the true changes, and its standard deviation.

    ``way``: RMS displacement of the camera, m; ``left``: RMS of the unexplained changes, m.
    """

    ratio: float
    deviation: float
    way: float
    left: float

    @property
    def at_rest(self) -> bool:
        """Return whether the marker was at rest, and the camera moved."""
        return (self.way >= MIN_WAY and RATIO_BOUNDS[0] <= self.ratio <= RATIO_BOUNDS[1]
                and self.left <= MAX_UNEXPLAINED * min(self.ratio, 1.0) * self.way)


def check_marker_size(seen: Observations, path: OwnPath) -> Finding:
    """Check the size of the neighbor's marker that was seen most often."""
    what, wanted = 'marker size', 'as far as odometry moves'
    number, _ = Counter(int(row[1]) for row in seen.sightings).most_common(1)[0]
    rows = np.array(sorted(row for row in seen.sightings if row[1] == number))
    quaternions, known = path.attitude(rows[:, 0])
    rotations = np.array([quaternion_to_matrix(q) for q in quaternions[known]])
    found = distance_ratio(
        rows[known, 2:] @ seen.camera_rotation.T, path.motion(rows[known, 0])[0], rotations,
        np.array(seen.value('relative_pose', 'camera_position', [0.0, 0.0, 0.0])))
    if (found is None or not found.at_rest
            or SIGNIFICANT_SIGMAS * found.deviation > 3.0 * SIZE_WARNING):
        moves = found is not None and found.way >= MIN_WAY and not found.at_rest
        return Finding(UNMEASURED, what, 'the leader moves' if moves else HOW, wanted)
    off, side = abs(found.ratio - 1.0), seen.marker_sides.get(number, 0.0)
    wrong = off > max(SIZE_WARNING, SIGNIFICANT_SIGMAS * found.deviation)
    measured = f'moves {found.ratio:.2f} ± {found.deviation:.2f} times as far'
    advice = (
        f'measure marker {number}, its black square from edge to edge: {side / found.ratio:.3f} m '
        f'would fit, config/neighbors.yaml has {side:g}. If that is right: is the calibration '
        'of this lens, and the scale of the odometry right?')
    return first(what, wanted, (wrong and off > SIZE_ERROR, ERROR, measured, advice),
                 (wrong, WARNING, measured, advice), (True, OK, measured, ''))


def distance_ratio(arms: Array, positions: Array, rotations: Array, camera: Array
                   ) -> Ratio | None:
    """
    Return the ratio of measured to true changes of the distance; None if sightings are few.

    :param arms: (n, 3), m, from the camera to the marker as seen, along base_link's axes.
    :param positions: (n, 3), m, and :param rotations: (n, 3, 3) of base_link in odom.
    :param camera: (3,), m, position of the camera on base_link.
    """
    if len(arms) < MIN_SIGHTINGS:
        return None
    seen = (rotations @ arms[:, :, None])[:, :, 0]
    sight = seen.mean(axis=0) / max(float(np.linalg.norm(seen.mean(axis=0))), 1e-9)
    distance, way = seen @ sight, -(positions + rotations @ camera) @ sight
    distance, way = distance - distance.mean(), way - way.mean()
    squares = max(float(way @ way), 1e-12)
    ratio = float(distance @ way) / squares
    left = distance - ratio * way
    lasting = float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-12)
    lasting = min(max(lasting, 0.0), _MAX_CORRELATION)
    variance = float(left @ left) / (len(left) - 2) * (1.0 + lasting) / (1.0 - lasting)
    return Ratio(ratio, ERROR_FACTOR * float(np.sqrt(variance / squares)),
                 float(np.sqrt(np.mean(way**2))), float(np.sqrt(np.mean(left**2))))
