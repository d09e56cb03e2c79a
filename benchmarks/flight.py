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
A flight that is played through several detectors, in turns.

They take turns every thirty images, so that a slow moment of the machine is nobody's alone, and
yet each finds its own code and data in the caches. If images are rare, a turn is shorter: odometry
is kept for 2 s. The measure is this process's CPU time; decoding is outside.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
import gc
from pathlib import Path
import time
from typing import Any, NamedTuple

from detectors import ARUCO, detectors, Look
from earlier import commit_of, Earlier
import numpy as np

from flock_desk.camera.renderer import SIDE_LENGTH, T_BODY_MARKER, T_BODY_OPTICAL
from flock_desk.runs.frame_errors import FrameErrors
from flock_desk.sample_bag import START_NS
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import slerp
from flock_follower.messages import NANOSECONDS, OdometryState, stamp_to_nanoseconds
from flock_follower.messages.state_reader import from_odometry
from flock_follower.odometry.buffer import OdometryBuffer
from flock_follower.parameters.neighbors_file import NeighborConfig
from flock_follower.perception import markers as neighbors
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.pending_images import Perceiver
from flock_follower.perception.time_offset import MountedCamera
from flock_follower.perception.tracker import Sighting, Tracker
from flock_follower.planner.params import PlannerParams
from flock_follower.system.files import resource

BAGS = Path(__file__).resolve().parents[1] / 'build' / 'bags'
TURN = 30  # images in a row that a method gets
LONGEST_TURN = 0.6 * OdometryBuffer.HORIZON  # s from the first image of a turn to its end
MAX_WAIT = 0.05  # s that an image waits for odometry, as in the node
WRONG = np.deg2rad(20.0)
#: A velocity less certain than this, m/s, does not count: the planner does not use it either.
VELOCITY_STD = PlannerParams().max_velocity_std


class Figures(NamedTuple):
    """What one method reached on one flight; NaN if it has no such thing."""

    cpu_ms_mean: float
    cpu_ms_p50: float
    cpu_ms_p99: float
    recall: float
    distance_bias_m: float
    distance_rms_m: float
    velocity_rms_m_s: float
    turned_share: float
    nees_position: float
    nees_velocity: float


class State(NamedTuple):
    """A leader as a detector alone sees it, in odom; it has nothing to say on its errors."""

    position: Array
    rotation: Array
    velocity: Array
    covariance: Array = np.full((6, 6), np.nan)


class Waiting(Tracker):
    """A tracker whose images are decoded, and processed later, in a turn."""

    def wanted(self, *_: Any) -> bool:
        """Return that an image is decoded."""
        return True

    def process_image(self, *_: Any) -> Sighting:
        """Return nothing yet."""
        return Sighting()


def perceiver(config: NeighborConfig,
              mountings: Sequence[Transform] = ()) -> Perceiver:
    """Return what perceives with one camera, or with several, named '0', '1' and so on."""
    several = {str(k): MountedCamera(place) for k, place in enumerate(mountings)}
    return Perceiver(Waiting(config, several or T_BODY_OPTICAL), max_wait=MAX_WAIT)


class Flight:
    """
    Plays a bag through every method, turn by turn.

    :param count: images to play, 0 for all.
    :param dictionary: of the leader's marker.
    :param omitted: names of detectors that do not take part.
    :param earlier: packages of earlier commits that take part, see ``earlier.py``.
    """

    def __init__(self, bag: Path, count: int, dictionary: str = ARUCO, *,
                 omitted: Sequence[str] = (), earlier: Sequence[str] = ()) -> None:
        self.config = replace(neighbors.load(resource('config/neighbors.yaml')),
                              dictionary=dictionary)
        self.detectors = {name: corners for name, corners in detectors(dictionary).items()
                          if name not in omitted}
        self.packages = earlier
        self.earlier = self._new_earlier()
        self.methods = (*self.detectors, *self.earlier, 'ours')
        self.milliseconds: dict[str, list[float]] = {m: [] for m in self.methods}
        self.errors = {m: FrameErrors(self.config.neighbors, T_BODY_OPTICAL, START_NS)
                       for m in self.methods}
        self.perceiver = perceiver(self.config)
        self.looks: dict[str, Look] = {}
        self.own: list[OdometryState] = []
        self.odometry: deque[Any] = deque(maxlen=3)  # the last messages
        self.last: dict[str, tuple[int, Array]] = {}  # where each detector saw the leader
        #: Stamps, ns and s, pixels and calibration.
        self.waiting: list[tuple[int, float, GrayImage, CameraModel]] = []
        self.turns = self.images = 0
        self.info: Any = None
        with open_bag(bag) as opened:
            for topic, msgtype, now, data in opened.messages():
                self.take(topic, msgtype, now, data)
                if self.images and self.images == count:
                    break
        self.race()

    def take(self, topic: str, msgtype: str, now: int, data: bytes) -> None:
        """Take a message that came at a time, ns, and process the images it sets free."""
        message = deserialize(data, msgtype)
        if topic == '/odom':
            self.own.append(from_odometry(message))
            self.odometry.append(message)
            self.perceiver.take_odometry(self.own[-1])
            for each in self.earlier.values():
                each.take_odometry(message)
            for errors in self.errors.values():
                errors.odometry(self.own[-1])
        elif topic == '/truth/odom':
            for errors in self.errors.values():
                errors.truth(from_odometry(message), own=True)
        elif topic == '/truth/neighbors':
            for errors in self.errors.values():
                errors.truth(from_odometry(message))
        elif topic == '/camera_info':
            self.info = message
            for each in self.earlier.values():
                each.take_camera_info(message)
            if self.perceiver.take_camera_info(message):
                model = self.perceiver.model()
                assert model is not None
                self.looks = {name: Look(model, corners, SIDE_LENGTH)
                              for name, corners in self.detectors.items()}
        else:
            stamp = stamp_to_nanoseconds(message.header.stamp)
            self.perceiver.take_image(message, stamp, now * 1e-9)
        self._race_in_time()
        while (ready := self.perceiver.process(now * 1e-9)) is not None:
            image, pixels = ready.image, ready.pixels
            assert image.model is not None and pixels is not None
            if not self.images:
                self.warm_up(pixels, image.model)
            self.waiting.append((image.stamp_ns, image.stamp, pixels, image.model))
            self.images += 1
            if len(self.waiting) == TURN:
                self.race()

    def _race_in_time(self) -> None:
        """Race before the odometry of the first image that waits is forgotten."""
        if self.waiting and self.own[-1].stamp - self.waiting[0][0] > LONGEST_TURN * NANOSECONDS:
            self.race()

    def race(self) -> None:
        """Give the images that wait to every method, another one first each time."""
        for k in range(len(self.methods)):
            method = self.methods[(self.turns + k) % len(self.methods)]
            for image in self.waiting:
                self.milliseconds[method].append(self.timed(method, *image))
        self.turns += 1
        self.waiting.clear()

    def timed(self, method: str, stamp: int, seconds: float, image: GrayImage,
              model: CameraModel) -> float:
        """Give an image to a method, store its result, and return the CPU time, ms."""
        look, earlier = self.looks.get(method), self.earlier.get(method)
        start = time.process_time_ns()
        if look is None:
            if earlier is not None:
                sighting = earlier.process_image(stamp, image)
            else:
                sighting = Tracker.process_image(self.perceiver.tracker, seconds, image, model)
            spent = time.process_time_ns() - start
            self.errors[method].frame(stamp, sighting.estimates, sighting.stages)
        else:
            seen = look(image)
            spent = time.process_time_ns() - start
            states: Any = {} if seen is None else {'leader': self.state(method, stamp, seen)}
            self.errors[method].frame(stamp, states, {})
        return spent * 1e-6

    def warm_up(self, image: GrayImage, model: CameraModel) -> None:
        """Let every method run untimed: first calls fill caches."""
        other = perceiver(self.config)
        other.take_camera_info(self.info)
        for state in self.own[-3:]:
            other.take_odometry(state)
            Tracker.process_image(other.tracker, 1e-9 * (state.stamp - self.own[-3:][0].stamp),
                                  image, model)
        for earlier in self._new_earlier().values():
            earlier.take_camera_info(self.info)
            for message in self.odometry:
                earlier.take_odometry(message)
                earlier.process_image(stamp_to_nanoseconds(message.header.stamp), image)
        for look in self.looks.values():
            look(image)
        gc.collect()
        gc.freeze()  # as the node does before it spins

    def _new_earlier(self) -> dict[str, Earlier]:
        return {commit_of(package): Earlier(package, self.config.dictionary, T_BODY_OPTICAL)
                for package in self.packages}

    def state(self, method: str, stamp: int, T_camera_marker: Transform) -> State:
        """Return a detector's state of the leader, its velocity from two positions."""
        before, after = next((a, b) for a, b in zip(self.own[-2::-1], self.own[:0:-1])
                             if a.stamp <= stamp)
        f = (stamp - before.stamp) / (after.stamp - before.stamp)
        own = Transform.from_quaternion(
            (1.0 - f) * before.position + f * after.position,
            slerp(before.quaternion, after.quaternion, f))
        pose = own @ T_BODY_OPTICAL @ T_camera_marker @ T_BODY_MARKER.inverse()
        velocity = np.full(3, np.nan)
        if method in self.last:
            then, place = self.last[method]
            velocity = (pose.translation - place) / ((stamp - then) * 1e-9)
        self.last[method] = stamp, pose.translation
        return State(pose.translation, pose.rotation, velocity)

    def figures(self) -> dict[str, Figures]:
        """Return what every method reached."""
        return {method: self._figures(method) for method in self.methods}

    def _figures(self, method: str) -> Figures:
        table = self.errors[method].table('leader')
        recall = float(np.isfinite(table['distance']).mean())
        # The truth of the last images may come after the end of a short run.
        found = np.isfinite(table['distance'] - table['true_distance'])
        off = (table['distance'] - table['true_distance'])[found]
        velocity, sigma = table['velocity'][found], table['velocity_sigma'][found]
        # A detector has no deviation, but no velocity either from its first sighting.
        usable = np.isfinite(velocity[:, 0]) & ~(np.sum(sigma**2, axis=1) > VELOCITY_STD**2)
        ms = np.array(self.milliseconds[method])
        return Figures(
            float(ms.mean()), *(float(np.percentile(ms, p)) for p in (50, 99)),
            recall, float(off.mean()), float(np.sqrt(np.mean(off**2))),
            float(np.sqrt(np.mean(np.sum(velocity[usable]**2, axis=1)))),
            float(np.mean(table['turned'][found] > WRONG)),
            *(float(np.mean(table[f'nees_{kind}'][found])) for kind in ('position', 'velocity')))
