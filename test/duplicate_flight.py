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

"""A leader that is hidden for 3 s, with a second print of its marker on a wall behind it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from flock_desk.camera.leader import second_print, T_BODY_OPTICAL
from flock_desk.camera.lens import Camera
from flock_desk.camera.renderer import Renderer, Sensor
from flock_follower.geometry import Array, quaternion_from_rpy, Transform
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import load
from flock_follower.perception.tracker import Sighting, Tracker
from flock_follower.resources import resource

CONFIG = load(resource('config/neighbors.yaml'))
LENS = Camera()
CAMERA = CameraModel(np.array([[LENS.focal_x, 0.0, LENS.centre_x],
                               [0.0, LENS.focal_y, LENS.centre_y], [0.0, 0.0, 1.0]]),
                     np.array(LENS.distortion), LENS.model, LENS.width, LENS.height)
IMAGE_RATE, ODOMETRY_RATE = 25, 200  # Hz
HIDDEN, BACK, END = 2.0, 5.0, 7.0  # s


class Frame(NamedTuple):
    """What one image told, and what is true."""

    time: float
    sighting: Sighting
    leader: Array
    """Position (3,), m."""
    print: Array
    """The body's (3,), m, that a leader with this marker would have."""

    @property
    def error(self) -> float:
        """Return by how far the leader's estimate is off, m; 0 where there is none."""
        found = self.sighting.estimates.get('leader')
        return 0.0 if found is None else float(np.linalg.norm(found.position - self.leader))

    @property
    def nees(self) -> float:
        """Return the normalised error squared of its position; 0 where there is none."""
        found = self.sighting.estimates.get('leader')
        if found is None:
            return 0.0
        off = found.position - self.leader
        return float(off @ np.linalg.solve(found.covariance[:3, :3], off))


class DuplicateFlight:
    """
    The course of one flight, drawn with a seed.

    :param appears: when the print can be seen first, s.
    :param gone: when it was seen last, s.
    :param known: when the leader can be seen first, s.
    """

    def __init__(self, seed: int, *, appears: float = 0.0, gone: float = END,
                 known: float = 0.0) -> None:
        rng = self._rng = np.random.default_rng([seed, 25])
        self.seed, self._appears, self._gone, self._known = seed, appears, gone, known
        self._swing = rng.uniform(0.0, 0.3, 3) * rng.integers(0, 2)  # m: it hovers, or moves
        self._rates, self._phases = rng.uniform(0.6, 1.2, 3), rng.uniform(0.0, 6.0, 3)
        self._place = np.array([rng.uniform(1.6, 2.2), rng.uniform(-0.2, 0.2), 1.0])
        away, side = rng.uniform(1.2, 2.2), rng.choice([-1.0, 1.0])
        across = rng.uniform(0.5, 0.8)
        offset = np.array([np.sqrt(away**2 - across**2), side * across, rng.uniform(-0.2, 0.3)])
        self.wall = Transform.from_quaternion(
            self._place + offset, quaternion_from_rpy(0.0, 0.0, rng.uniform(-0.3, 0.3)))
        self._alone, self._beside_print = (
            Renderer(LENS, Sensor(sub_poses=1), seed=seed, fineness=2, prints=prints)
            for prints in ((), [([second_print()], self.wall)]))

    def leader(self, time: float) -> Transform:
        """Return its body in odom."""
        swing = self._swing * np.sin(self._rates * time + self._phases)
        return Transform.from_quaternion(self._place + swing, quaternion_from_rpy(
            0.03 * np.sin(1.3 * time), 0.04 * np.sin(1.9 * time), 0.2 * np.sin(0.7 * time)))

    def own(self, time: float) -> Transform:
        """Return the follower's body in odom."""
        place = np.array([0.15 * np.sin(1.1 * time), 0.1 * np.sin(0.9 * time + 1.0),
                          1.0 + 0.05 * np.sin(0.8 * time)])
        return Transform.from_quaternion(place, quaternion_from_rpy(
            0.03 * np.sin(1.7 * time), 0.03 * np.sin(2.3 * time + 0.5), 0.05 * np.sin(time)))

    def odometry(self, time: float) -> OdometrySample:
        """Return the odometry of a time, with noise."""
        step = 1e-4
        body, before, after = (self.own(time + s) for s in (0.0, -step, step))
        velocity = (after.translation - before.translation) / (2.0 * step)
        W = body.rotation.T @ (after.rotation - before.rotation) / (2.0 * step)
        noise = self._rng.standard_normal((3, 3))
        return OdometrySample(
            time, body.translation + 0.001 * noise[0], body.quaternion,
            velocity + 0.01 * noise[1],
            np.array([W[2, 1], W[0, 2], W[1, 0]]) + 0.002 * noise[2])

    def image(self, time: float) -> GrayImage:
        """Return what the camera sees."""
        shown = self._known <= time and not HIDDEN <= time < BACK
        renderer = self._beside_print if self._appears <= time < self._gone else self._alone
        return renderer.image(round(time * IMAGE_RATE), [self.own(time) @ T_BODY_OPTICAL],
                              [self.leader(time)] if shown else [])

    def frames(self, tracker: Tracker | None = None, end: float = END) -> Iterator[Frame]:
        """Yield what a tracker makes of every image."""
        tracker = tracker or Tracker(CONFIG, T_BODY_OPTICAL)
        per_image = ODOMETRY_RATE // IMAGE_RATE
        for k in range(round(end * ODOMETRY_RATE)):
            time = k / ODOMETRY_RATE
            tracker.feed_odometry(self.odometry(time))
            if k % per_image == 1:
                yield Frame(time, tracker.process_image(time, self.image(time), CAMERA),
                            self.leader(time).translation, self.wall.translation)


def wrong(frames: Sequence[Frame]) -> list[float]:
    """Return the times of estimates that are off by more than 0.3 m with a NEES above 30."""
    return [frame.time for frame in frames if frame.error > 0.3 and frame.nees > 30.0]
