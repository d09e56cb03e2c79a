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
Keeping a neighbour in the camera's field of view: what that asks of the horizontal command.

A vehicle that accelerates forward by a lowers its nose by a / g, and the camera with it; one that
is passed turns after the neighbour, at most at ``yaw_rate_max``. Height and yaw are controlled
elsewhere; here is what is left to ask of the horizontal acceleration:

    g (tan(lowest) - tan e) <= f . a <= g (tan(highest) - tan e)      e: elevation of the neighbour
    |t . (v_L - v_F)| <= 0.8 yaw_rate_max r                           f, t: towards it, and across

"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, quaternion_from_rpy, quaternion_to_matrix
from flock_follower.planner.guard import HalfSpace, SIGHT
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.prediction import Expected
from flock_follower.planner.yaw import OVERHEAD

GRAVITY = 9.80665  # m/s^2
MARGIN = 0.05  # rad from the edge of the image: half of a marker, and an attitude that wobbles
TURNING_SHARE = 0.8  # of the largest yaw rate, to follow a neighbour that passes
TURNING_TIME = 0.3  # s in which its passing is brought to what the yaw can follow


@dataclass(frozen=True)
class FieldOfView:
    """What a camera sees, as angles from the body's forward axis, rad: it must look ahead."""

    left: float
    right: float
    up: float
    down: float

    @classmethod
    def of_camera(cls, width: int, height: int, k: ArrayLike, rpy: ArrayLike) -> FieldOfView:
        """
        Return the field of view of a camera.

        :param width: of the image, pixels; :param height: likewise.
        :param k: the matrix K of its CameraInfo, (9,) or (3, 3).
        :param rpy: roll, pitch and yaw of the camera on the body, (3,), rad.
        :raises ValueError: where it does not look ahead, or K is none.
        """
        fx, _, cx, _, fy, cy, *_ = np.asarray(k, dtype=float).ravel().tolist()
        if not (fx > 0.0 and fy > 0.0 and width > 0 and height > 0):
            raise ValueError(f'camera_info: fx = {fx:g}, fy = {fy:g}, {width} x {height} pixels: '
                             'must all be above 0')
        angles = np.asarray(rpy, dtype=float).tolist()
        mounting = quaternion_to_matrix(quaternion_from_rpy(*angles))
        # The middles of the four sides, forward, left, up.
        sides = np.array([[1.0, cx / fx, 0.0], [1.0, (cx - width) / fx, 0.0],
                          [1.0, 0.0, cy / fy], [1.0, 0.0, (cy - height) / fy]]) @ mounting.T
        if np.any(sides[:, 0] <= 0.0):
            raise ValueError(f'camera_rpy = {angles}: the camera must look ahead')
        left, right = np.arctan2(sides[:2, 1], sides[:2, 0]).tolist()
        up, down = np.arctan2(sides[2:, 2], sides[2:, 0]).tolist()
        if not right < 0.0 < left or not down < 0.0 < up:
            raise ValueError(f'camera_rpy = {angles}: straight ahead must be in the image')
        return cls(left, -right, up, -down)

    def bounds(self, offset: Array, velocity: Array, it: Expected,
               params: PlannerParams) -> list[HalfSpace]:
        """
        Return what keeps a neighbour in sight, (3,) vectors in the frame of the odometry.

        :param offset: its position minus one's own, m; :param velocity: one's own, m/s.
        """
        x, y, z = offset.tolist()
        distance = math.hypot(x, y)
        if distance < OVERHEAD:
            return []
        forward = np.array([x, y, 0.0]) / distance
        left = np.array([-y, x, 0.0]) / distance
        slope = z / distance
        # Never forced to move by its height alone: that is the altitude's task.
        faster = max(GRAVITY * (math.tan(max(self.up - MARGIN, 0.0)) - slope), 0.0)
        slower = max(GRAVITY * (math.tan(max(self.down - MARGIN, 0.0)) + slope), 0.0)
        passing = float(left @ (it.velocity - velocity))
        turning = TURNING_SHARE * params.yaw_rate_max * distance
        across = float(left @ it.acceleration)
        return [HalfSpace(-forward, -faster, SIGHT), HalfSpace(forward, -slower, SIGHT),
                HalfSpace(left, (passing - turning) / TURNING_TIME + across, SIGHT),
                HalfSpace(-left, (-passing - turning) / TURNING_TIME - across, SIGHT)]
