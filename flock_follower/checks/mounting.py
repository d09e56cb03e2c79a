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

"""The mounting of the camera: each axis by itself."""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Final

import numpy as np

from flock_follower.checks.findings import ERROR, Finding, first, OK, UNMEASURED, WARNING
from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
    rpy_from_matrix,
)

#: Errors, rad, of a warning and of an error; an error must exceed so many deviations.
LOOKS, BAD_LOOKS, SURE = math.radians(4.0), math.radians(8.0), 3.0
MOUNTED: Final = f'within {math.degrees(LOOKS):.0f} deg of camera_rpy'
_AXES: Final = ('roll', 'pitch', 'yaw')
_WAYS: Final = (('rolled left', 'rolled right'), ('looks higher', 'looks lower'),
                ('looks further right', 'looks further left'))


def check_mounting(turn: Array, deviations: Array, rpy: Sequence[float]) -> Finding:
    """
    Return the finding about roll, pitch and yaw of the camera.

    :param turn: the rotation vector (3,), rad, along base_link's axes, by which the camera is
        mounted otherwise than configured; :param deviations: (3,) of it.
    :param rpy: the configured ``camera_rpy``, rad.
    """
    margin = SURE * deviations
    wrong = np.abs(turn) > np.maximum(LOOKS, margin)
    unknown = ', '.join(axis for axis, bad, by in zip(_AXES, wrong, margin)
                        if not bad and by > LOOKS)
    looks = ', '.join(f'{way[angle > 0.0]} by {abs(math.degrees(angle)):.0f} deg'
                      for way, angle, bad in zip(_WAYS, turn.tolist(), wrong) if bad)
    fitting = ','.join(str(round(angle, 3) + 0.0) for angle in rpy_from_matrix(
        rotation_vector_to_matrix(np.where(wrong, turn, 0.0))
        @ quaternion_to_matrix(quaternion_from_rpy(*rpy))).tolist())
    measured = f'camera {looks} than configured{f"; {unknown} unknown" if unknown else ""}'
    advice = (f'camera_rpy:=[{fitting}] would fit, in relative_pose and planner; or is the pose '
              'of the odometry on the body (odom_child_rpy) wrong?')
    return first(
        'camera mounting', MOUNTED,
        (np.any(wrong & (np.abs(turn) > BAD_LOOKS)), ERROR, measured, advice),
        (wrong.any(), WARNING, measured, advice),
        (unknown, UNMEASURED, f'{unknown} unknown: roll, pitch and yaw it by hand, 30 deg', ''),
        (True, OK, f'off by {math.degrees(np.abs(turn).max()):.0f} deg', ''))
