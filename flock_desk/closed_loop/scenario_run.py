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

"""The state of a scenario at a time of one flight: leader, air, light and delays."""

from __future__ import annotations

import math

import numpy as np

from flock_desk.scenarios.courses import course, COURSE_STEP, turn_rate, wind_course
from flock_desk.scenarios.scenario import Scenario
from flock_desk.sensors.vio import Odometry
from flock_desk.vehicles.quadrotor import attitude
from flock_follower.geometry import (
    Array,
    GRAVITY,
    matrix_to_quaternion,
    quaternion_from_yaw,
    Transform,
    yaw_from_quaternion,
)
from flock_follower.geometry.rotation_vectors import matrix_to_rotation_vector

WIND_PERIOD = 0.05  # s between changes of the wind
PROCESSING = 0.02  # s from an image's exposure to the planner if nothing delays it
BEFORE_START = -1.0  # s: any time before the scenario begins


class ScenarioRun:
    """
    One run of a scenario, at any time of it, s; before 0 the leader hovers in its first place.

    Only latency and light changes of ``sensing`` are used. Its noise and recall are not used,
    because the real perception processes rendered images.

    :param in_place: whether the follower starts at the scenario's place; else the scenario is
        moved to its place, height and heading once it is in offboard mode.
    """

    def __init__(self, scenario: Scenario, run: int, in_place: bool = True) -> None:
        self.scenario, self._in_place = scenario, in_place
        self._course = course(scenario, run)
        self._turning = BEFORE_START, 0.0, 0.0  # time, heading then, rate of it
        #: The scenario's frame in the vehicle's; None before the leader appears.
        self._frame: Transform | None = Transform() if in_place else None
        count = round(scenario.duration / WIND_PERIOD) + 1
        self._wind = wind_course(scenario.wind, count, WIND_PERIOD, scenario.random(run, 'wind'))
        self._latency_rng = scenario.random(run, 'images')
        self._latency = self._latency_rng.uniform(*scenario.sensing.latency)
        rng, sensing = scenario.random(run, 'light'), scenario.sensing
        begins = sensing.draw_light_changes(scenario.duration, rng)
        self.light_changes = [(begin, begin + float(rng.uniform(*sensing.light_change)))
                              for begin in np.sort(begins).tolist()]
        """Begin and end of each, s."""

    def step(self, follower: Odometry, time: float, offboard: bool) -> None:
        """Place the leader before a follower that has just entered offboard mode, facing away."""
        if not self._in_place and time < 0.0 and not offboard:
            self._frame = None
        elif self._frame is None and offboard:
            height = np.array([0.0, 0.0, self.scenario.start.altitude])
            self._frame = Transform.from_quaternion(
                follower.position - height,
                quaternion_from_yaw(yaw_from_quaternion(follower.quaternion)))
        if self._frame is not None and self.scenario.leader.heading == 'away':
            offset = self._course.at(time)[0] - self._frame.inverse().apply(follower.position)
            heading = self._heading(time)
            self._turning = time, heading, float(turn_rate(heading, offset))

    def motion(self, _: int, time: float) -> Odometry | None:
        """Return the leader's true motion; its covariances are zero. None before it appears."""
        if self._frame is None:
            return None
        step = 0.5 * COURSE_STEP
        pose, before, after = (self._frame @ self._pose(t) for t in (
            time, time - step, time + step))
        rate = matrix_to_rotation_vector(before.rotation.T @ after.rotation) / (2.0 * step)
        velocity = self._course.at(time)[1] if time > 0.0 else np.zeros(3)
        return Odometry(time, pose.translation, matrix_to_quaternion(pose.rotation),
                        pose.rotation.T @ self._frame.rotation @ velocity, rate)

    def knows(self, time_ns: int) -> bool:
        """Return True: the course is known."""
        return True

    def _pose(self, time: float) -> Transform:
        """Return the leader's pose on its course: it leans into its acceleration."""
        position, _, acceleration, _ = self._course.at(time)
        up = acceleration + np.array([0.0, 0.0, GRAVITY])
        return Transform(
            attitude(up / math.sqrt(up @ up), np.array(self._heading(time))), position)

    def _heading(self, time: float) -> float:
        since, heading, rate = self._turning
        return (heading + rate * (time - since) if self.scenario.leader.heading == 'away'
                else self._course.at(time)[3])

    def wind(self, time: float) -> Array:
        """Return the velocity (3,) of the air, m/s."""
        return self._wind[min(max(int(time / WIND_PERIOD), 0), len(self._wind) - 1)]

    def hides(self, time: float) -> bool:
        """Return whether an outage or the light hides the marker."""
        return self.scenario.fails('marker', time) or any(
            begin <= time < end for begin, end in self.light_changes)

    def delay(self) -> float:
        """
        Return the delay of the next image, s.

        This is the latency of the scenario, varied by 10 %, minus the latency of the nodes.
        """
        latency = self._latency * (1.0 + self._latency_rng.uniform(-0.1, 0.1))
        return float(max(latency - PROCESSING, 0.0))
