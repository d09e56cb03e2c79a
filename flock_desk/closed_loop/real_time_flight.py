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
A running flight of two vehicles: the leader on its course, the follower by its commands.

Its owner steps the vehicles and takes the output of the sensors: odometry after every step, an
image when one is due. Times are integer nanoseconds since the start; no clock is
read here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flock_desk.camera.lens import Camera
from flock_desk.camera.renderer import leader as leader_faces
from flock_desk.camera.renderer import Renderer, second_print, Sensor, T_BODY_OPTICAL
from flock_desk.closed_loop.flown import EmbeddedVehicle, FlownLeader, FlownVehicle
from flock_desk.closed_loop.scenario_run import BEFORE_START, ScenarioRun
from flock_desk.scenarios.scenario import Print, Scenario
from flock_desk.sensors.sensing import Radios
from flock_desk.sensors.vio import Due, Odometry, VioEstimator
from flock_desk.vehicles.embedded import STEP_TIME
from flock_follower.geometry import (
    quaternion_from_yaw,
    quaternion_to_matrix,
    Transform,
)

STEP_NS = round(STEP_TIME * 1e9)
IMAGE_RATE = 30  # Hz
FIRST_IMAGE_NS = 12_500_000  # not at the time of a step: cameras seldom are
#: An image that is due for longer than this is left out, ns: if the machine does not keep up,
#: odometry and vehicle come first.
LATEST_NS = 30_000_000
MAX_SKIPPED_SHARE = 0.02  # of the images: more that are left out show in the flight
CAMERA_SENSOR = Sensor(sub_poses=2)  # poses in an exposure
_NO_PIXELS = np.zeros((0, 0), np.uint8)  # of an image that is not rendered


class RenderedImage(NamedTuple):
    """One image, and the truth at its stamp."""

    stamp_ns: int
    due_ns: int
    """Time of delivery."""
    time: float
    """Scenario time at the stamp, s; negative before the scenario begins."""
    pixels: NDArray[np.uint8]
    follower: Odometry
    leader: Odometry | None
    """None without one."""
    usable: bool
    """Whether the leader can be seen in it, and placed by odometry."""


class RealTimeFlight:
    """
    One run of a scenario; its time begins when the follower is first engaged in offboard mode.

    :param camera: None: images have no pixels, for a detector that is simulated.
    :param latest_ns: an image that is later than this is skipped.
    :param leader: a leader flown elsewhere; None: the scenario's own leader.
    """

    def __init__(self, scenario: Scenario, run: int, vehicle: FlownVehicle,
                 camera: Renderer | None, latest_ns: int = LATEST_NS,
                 leader: FlownLeader | None = None) -> None:
        self.scenario = ScenarioRun(scenario, run, isinstance(vehicle, EmbeddedVehicle))
        self.time_ns = 0
        self.began_ns: int | None = None
        self.skipped_images = 0  # since the scenario began
        self.vehicle = vehicle
        self.camera = camera
        self._latest_ns = latest_ns
        self._images = 0
        self._leader = leader or self.scenario
        self.follower = vehicle.step(0)
        """The follower's true motion at the last step."""
        self._vio = VioEstimator(self.follower, scenario.random(run, 'vio'), scenario.odometry,
                                 STEP_TIME)
        self._due = Due(scenario.odometry.rate)
        self._odometry_latency_ns = round(1e9 * scenario.random(run, 'odometry latency').uniform(
            *scenario.odometry.latency))
        self._under_way: deque[tuple[int, Odometry]] = deque()
        errors = scenario.ranges
        self._radios = (Radios(errors, [scenario.random(run, 'ranges')]), Due(errors.rate)
                        ) if errors.rate else None

    @property
    def time(self) -> float:
        """Return the time of the scenario, s; negative until it begins."""
        return self._scenario_time(self.time_ns)

    @property
    def distance(self) -> float:
        """Return the true distance between the vehicles, m; NaN without a leader."""
        leader = self._leader.motion(self.time_ns, self.time)
        return (math.nan if leader is None
                else float(np.linalg.norm(leader.position - self.follower.position)))

    def after_step(self, engaged: bool) -> list[tuple[int, Odometry]]:
        """Count a step of the autopilot; return the odometry that arrives, with stamps, ns."""
        self.time_ns += STEP_NS
        self.follower = state = self.vehicle.step(self.time_ns)
        if self.began_ns is None and engaged and self.vehicle.offboard:
            self.began_ns = self.time_ns
            self.skipped_images = 0
        self._leader.step(state, self.time, self.vehicle.offboard)
        estimate = self._vio.step(state)
        if self._due.at(state.time) and not self.scenario.scenario.fails('vio', self.time) and (
                self.vehicle.knows(self.time_ns)):
            self._under_way.append((self.time_ns, estimate))
        arrived = []
        while (self._under_way
               and self._under_way[0][0] + self._odometry_latency_ns <= self.time_ns):
            arrived.append(self._under_way.popleft())
        return arrived

    def measured(self) -> float | None:
        """Return the distance that radios measure at the last step, m; None if none is due."""
        if self._radios is None or math.isnan(self.distance):
            return None
        radios, due = self._radios
        if not due.at(self.time_ns * 1e-9):
            return None
        return float(radios.measure(np.array([self.distance]))[0])

    def look(self, now_ns: int) -> RenderedImage | None:
        """Return the next image if its exposure is over; skip images that are too late."""
        while True:
            stamp_ns = FIRST_IMAGE_NS + self._images * 1_000_000_000 // IMAGE_RATE
            end_ns = stamp_ns + round(0.5e9 * CAMERA_SENSOR.exposure)
            in_time = now_ns - stamp_ns <= self._latest_ns
            if end_ns > self.time_ns or (in_time and not self._leader.knows(end_ns)):
                return None  # the leader's next pose may be under way
            self._images += 1
            if in_time and self.vehicle.knows(stamp_ns):
                return self._frame(stamp_ns)
            self.skipped_images += 1

    def _frame(self, stamp_ns: int) -> RenderedImage:
        time = self._scenario_time(stamp_ns)
        hidden = self.scenario.hides(time)
        leader = self._leader.motion(stamp_ns, time)
        usable = not (hidden or leader is None or self.scenario.scenario.fails('vio', time))
        pixels = _NO_PIXELS if self.camera is None else self._render(self.camera, stamp_ns, hidden)
        return RenderedImage(stamp_ns, stamp_ns + round(1e9 * self.scenario.delay()), time, pixels,
                             self.vehicle.at(stamp_ns), leader, usable)

    def _render(self, camera: Renderer, stamp_ns: int, hidden: bool) -> NDArray[np.uint8]:
        """Return the pixels of an image, with the leader if it is not hidden."""
        moments = [round(1e9 * t) for t in CAMERA_SENSOR.times(stamp_ns * 1e-9)]
        motions = [self._leader.motion(t, self._scenario_time(t)) for t in moments]
        leaders = [] if hidden else [body_pose(motion) for motion in motions if motion is not None]
        return camera.image(
            self._images, [body_pose(self.vehicle.at(t)) @ T_BODY_OPTICAL for t in moments],
            leaders)

    def _scenario_time(self, time_ns: int) -> float:
        return BEFORE_START if self.began_ns is None else (time_ns - self.began_ns) * 1e-9


def body_pose(state: Odometry) -> Transform:
    """Return the pose of the body in the odometry's frame."""
    return Transform(quaternion_to_matrix(state.quaternion), state.position)


def real_time_camera(seed: int, prints: Sequence[Print] = (),
                     dictionary: str = 'DICT_4X4_50') -> Renderer:
    """
    Return a camera of the sample bag's kind, in its world, that renders in milliseconds.

    :param dictionary: of the leader's marker.
    :raises ValueError: if it is unknown.
    """
    placed = [([second_print()], Transform.from_quaternion(
        np.array(each.position), quaternion_from_yaw(each.yaw))) for each in prints]
    return Renderer(Camera(), CAMERA_SENSOR, seed=seed, fineness=2, prints=placed,
                    body=leader_faces(second_print(dictionary)))


def calibration(camera: Camera) -> dict[str, Any]:
    """Return the calibration as the fields of a ``sensor_msgs/CameraInfo``."""
    k = [camera.focal_x, 0.0, camera.center_x, 0.0, camera.focal_y, camera.center_y,
         0.0, 0.0, 1.0]
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    return {'height': camera.height, 'width': camera.width, 'distortion_model': camera.model,
            'd': list(camera.distortion), 'k': k, 'p': p,
            'r': [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]}
