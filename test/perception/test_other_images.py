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

"""Tracking on images from elsewhere: shade and motion over warped markers and real photographs."""

from __future__ import annotations

from collections.abc import Callable

from marker_images import Hovering, TAIL
import numpy as np
import pytest
from warped_marker import WarpedMarker

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.perception.images import GrayImage
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.tracker import camera_mounting, Sighting

pytestmark = pytest.mark.slow
IMAGES, FIRST = 26, 5  # of a flight, and how many of them are as clear as can be
Show = Callable[[int, Transform, WarpedMarker], GrayImage]


def course(k: int, seed: int) -> Transform:
    """Return T_camera_marker in image k of a flight away from the camera, weaving."""
    a, b, c, d = np.random.default_rng([seed, 1]).uniform(0.0, 6.28, 4)
    turn = [0.15 + 0.1 * np.sin(k / 15 + c), 0.1 + 0.4 * np.sin(k / 18 + d), 0.05]
    place = np.array([0.05 * np.sin(k / 12 + a), 0.04 * np.cos(k / 9 + b), 1.0])
    return Transform(rotation_vector_to_matrix(turn) @ np.diag([1.0, -1.0, -1.0]),
                     (1.2 + 1.6 * k / IMAGES) * place)


class Flight:
    """What a hovering follower sees of the leader, image by image, after a few clear ones."""

    def __init__(self, show: Show, seed: int) -> None:
        world = WarpedMarker(seed)
        drone = Hovering(world.camera, camera_mounting([0.1, 0.0, 0.0], [0.0] * 3))
        self.sightings: list[Sighting] = []
        self.measured: list[tuple[Measurement, Transform]] = []
        for k in range(IMAGES):
            pose = course(k, seed)
            sighting = drone.see(world.image([pose], k) if k < FIRST else show(k, pose, world))
            if k >= FIRST:
                self.sightings.append(sighting)
                self.measured += [(m, pose @ TAIL.inverse())
                                  for m in sighting.measurements.values()]

    @property
    def recall(self) -> float:
        return float(np.mean([bool(s.estimates) for s in self.sightings]))

    def errors(self) -> Array:
        """Return (n, 6): of the place of the reference, m, and the rotation to the truth, rad."""
        return np.array([np.concatenate([
            truth.apply(m.reference) - m.T_camera_body.apply(m.reference),
            matrix_to_rotation_vector(truth.rotation @ m.T_camera_body.rotation.T)])
            for m, truth in self.measured])

    def range_error(self) -> float:
        """Return the root mean square of the error along the line of sight, a share of range."""
        ranges = np.array([m.T_camera_body.translation[2] for m, _ in self.measured])
        return float(np.sqrt(np.mean((self.errors()[:, 2] / ranges)**2)))

    def nees(self) -> float:
        """Return the mean normalized square of the errors of place, per dimension."""
        return float(np.mean([e[:3] @ np.linalg.solve(m.covariance[:3, :3], e[:3]) / 3.0
                              for (m, _), e in zip(self.measured, self.errors())]))


@pytest.mark.parametrize(('light', 'gamma'), [(0.1, 2.2), (0.3, 1.0)])
def test_hard_shadow_edge_across_marker_costs_nothing(light: float,
                                                      gamma: float) -> None:
    def show(k: int, pose: Transform, world: WarpedMarker) -> GrayImage:
        shade = 0.07 * k + 1.0, 0.55 * np.sin(k / 7.0), light
        return world.image([pose], k, shade=shade, gamma=gamma)

    flight = Flight(show, seed=0)
    assert flight.recall >= 0.98
    assert all(s.stage == 'track' for s in flight.sightings if s.estimates)
    assert flight.range_error() < 0.003
    assert flight.nees() < 1.5


def along(pose: Transform, cells: float, direction: float, world: WarpedMarker) -> list[Transform]:
    """Return the poses of a marker that moves by some cells in the image while it is exposed."""
    steps = (np.arange(int(6 * cells) + 1) + 0.5) / (int(6 * cells) + 1) - 0.5
    path = cells * world.cell * np.array([np.cos(direction), np.sin(direction), 0.0])
    return [Transform(pose.rotation, pose.translation + step * path) for step in steps]


@pytest.mark.parametrize('cells', [0.5, 1.5])
def test_smear_over_cells_leaves_marker_tracked(cells: float) -> None:
    def show(k: int, pose: Transform, world: WarpedMarker) -> GrayImage:
        return world.image(along(pose, cells, 0.15 * k, world), k)

    flight = Flight(show, seed=0)
    assert flight.recall >= 0.95
    assert flight.range_error() < 0.006
    assert np.linalg.norm(flight.errors()[:, 3:], axis=1).max() < 0.35
    assert flight.nees() < 2.0
