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

"""A neighbor that flies past, as its filter tracks it."""

from __future__ import annotations

from marker_images import known
import numpy as np

from flock_follower.geometry import Array, quaternion_from_yaw, quaternion_to_matrix, Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.perception.neighbor_filter import (
    Estimate,
    FilterParams,
    NeighborFilter,
    UpdateOutcome,
)

TAIL = np.array([-0.2, 0.0, 0.05])  # what is measured: where the marker is on the body
NOISE = np.diag([0.005, 0.005, 0.01, 0.02, 0.02, 0.01])**2
DT = 1.0 / 30.0
START, VELOCITY, RATE = np.array([3.0, 1.0, 2.0]), np.array([0.8, -0.4, 0.1]), 0.5


def truth(t: float) -> Transform:
    """Return T_odom_body of a neighbor in steady flight, turning about z."""
    return Transform(quaternion_to_matrix(quaternion_from_yaw(0.3 + RATE * t)),
                     START + t * VELOCITY)


def measured(body: Transform, rng: np.random.Generator | None = None) -> Transform:
    """Return T_odom_body, with noise of the covariance NOISE at the tail if rng is given."""
    if rng is None:
        return body
    e = rng.multivariate_normal(np.zeros(6), NOISE)
    rotation = rotation_vector_to_matrix(e[3:]) @ body.rotation
    return Transform(rotation, body.apply(TAIL[None])[0] + e[:3] - rotation @ TAIL)


def error(estimate: Estimate, body: Transform, velocity: Array) -> Array:
    """Return the error state (15,) of an estimate of a neighbor that does not accelerate."""
    return np.concatenate([
        body.translation - estimate.position, velocity - estimate.velocity,
        matrix_to_rotation_vector(body.rotation @ estimate.rotation.T),
        np.array([0.0, 0.0, RATE]) - estimate.angular_velocity, -estimate.acceleration])


def moved(body: Transform, *offset: float) -> Transform:
    return Transform(body.rotation, body.translation + np.array(offset))


def update(tracker: NeighborFilter, t: float, body: Transform) -> UpdateOutcome:
    return tracker.update(t, body, TAIL, NOISE)


def tracked(seconds: float, noisy: bool = True,
            params: FilterParams | None = None) -> NeighborFilter:
    """Return a filter that has followed the steady flight from 0 to ``seconds``."""
    rng = np.random.default_rng(0) if noisy else None
    tracker = NeighborFilter(params)
    for k in range(round(seconds / DT) + 1):
        update(tracker, k * DT, measured(truth(k * DT), rng))
    return tracker


def now(tracker: NeighborFilter, t: float) -> Estimate:
    return known(tracker.predict(t))


def mirrored(body: Transform) -> Transform:
    """Return a body turned about its tail."""
    rotation = rotation_vector_to_matrix([0.0, 0.0, 0.9]) @ body.rotation
    return Transform(rotation, body.apply(TAIL[None])[0] - rotation @ TAIL)
