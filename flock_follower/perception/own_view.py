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

"""From where, and while moving how, the camera exposed an image or a row of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.odometry.history import OdometrySample
from flock_follower.perception.neighbor_state import Estimate


class View(NamedTuple):
    """
    The own state at that time, and the camera's pose in the smooth frame of ``OdometryBuffer``.

    ``delay`` is how long after the image's stamp that was by the camera's clock, s.
    """

    own: OdometrySample
    rotation: Array
    """Of the body, to odom, (3, 3)."""
    T_smooth_camera: Transform
    delay: float = 0.0

    @classmethod
    def of(cls, own: OdometrySample, T_body_camera: Transform, delay: float) -> View:
        """Return the view of a camera mounted at ``T_body_camera``."""
        body = own.smooth_pose
        return cls(own, body.rotation, body @ T_body_camera, delay)

    @property
    def turning(self) -> Array:
        """Return one's own angular velocity (3,), rad/s, in odom."""
        turning: Array = self.rotation.dot(self.own.angular_velocity)
        return turning

    def expected(self, estimate: Estimate | None) -> Transform | None:
        """Return ``T_camera_body`` of a neighbour, where its state is known."""
        return None if estimate is None else self.T_smooth_camera.inverse() @ estimate.pose

    def moving(self, sight: Array) -> Array:
        """Return by how much the state of what is seen (3,), m, away changes, (15,), per s."""
        (x, y, z), (u, v, w) = sight.tolist(), self.turning.tolist()
        a, b, c = self.own.velocity.tolist()
        # Of the place w x r + v, of the attitude w. In plain numbers: for every image, so small.
        return np.array([v * z - w * y + a, w * x - u * z + b, u * y - v * x + c, 0.0, 0.0, 0.0,
                         u, v, w, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def passing(self, T_camera_body: Transform, reference: Array,
                estimate: Estimate | None) -> tuple[Array, Array]:
        """
        Return how a neighbour moves past the camera: velocity of a point, m/s, and rates, rad/s.

        :param reference: the point (3,) on the body; :param estimate: its state, where known: else
            it is taken to fly along.
        """
        to_camera = self.T_smooth_camera.rotation.T
        own_rates = to_camera.dot(self.turning)
        lever = self.T_smooth_camera.translation - self.own.travel
        velocity = -np.cross(own_rates, T_camera_body.apply(reference))
        if estimate is not None:
            camera = self.own.velocity + np.cross(self.turning, lever)
            velocity = velocity + to_camera.dot(estimate.velocity - camera)
        return velocity, -own_rates
