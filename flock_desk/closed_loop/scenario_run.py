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

"""What a scenario does at a moment of one flight: the leader, the air, the light, what fails."""

from __future__ import annotations

import math

import numpy as np

from flock_desk.camera.renderer import Light
from flock_desk.scenarios.courses import course, STEP, turn_rate, wind_course
from flock_desk.scenarios.scenario import Scenario
from flock_desk.sensors.vio import Odometry
from flock_desk.vehicles.quadrotor import attitude
from flock_follower.geometry import (
    Array,
    GRAVITY,
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    Transform,
)

WIND_PERIOD = 0.05  # s between changes of the wind
PROCESSING = 0.02  # s from an image's exposure to the planner if nothing delays it
BEFORE = -1.0  # s: any time before the scenario begins
_CLOUDS = 9.0  # s from one cloud to the next, where the light changes at all
_GLARE = Light(veil=1.2)
_SHADOW = Light(gain=0.002)


class ScenarioRun:
    """
    One run of a scenario, at any time of it, s; before 0 the leader hovers in its first place.

    Of ``sensing`` only latency and light changes are used: images are rendered and marked by the
    real perception, which has noise and recall of its own.
    """

    def __init__(self, scenario: Scenario, run: int) -> None:
        self.scenario = scenario
        self._course = course(scenario, run)
        self._turning = BEFORE, 0.0, 0.0  # time, heading then, rate of it
        count = round(scenario.duration / WIND_PERIOD) + 1
        self._wind = wind_course(scenario.wind, count, WIND_PERIOD, scenario.random(run, 'wind'))
        self._latency_rng = scenario.random(run, 'images')
        self._latency = self._latency_rng.uniform(*scenario.sensing.latency)
        rng, sensing = scenario.random(run, 'light'), scenario.sensing
        begins = rng.uniform(0.0, scenario.duration,
                             rng.poisson(sensing.light_changes * scenario.duration / 60.0))
        self.light_changes = [
            (begin, begin + float(rng.uniform(*sensing.light_change)), bool(rng.integers(2)))
            for begin in np.sort(begins).tolist()]
        """Begin and end, s, and whether it is glare, else shadow."""

    def turn(self, time: float, follower: Array) -> None:
        """Let a leader that faces away from the follower, at a position (3,), go on turning."""
        if self.scenario.leader.heading != 'away':
            return
        heading = self._heading(time)
        self._turning = time, heading, float(
            turn_rate(heading, self._course.at(time)[0] - follower))

    def _heading(self, time: float) -> float:
        if self.scenario.leader.heading != 'away':
            return self._course.at(time)[3]
        since, heading, rate = self._turning
        return heading + rate * (time - since)

    def leader(self, time: float) -> Transform:
        """Return the leader's pose: it leans into its acceleration."""
        position, _, acceleration, _ = self._course.at(time)
        up = acceleration + np.array([0.0, 0.0, GRAVITY])
        return Transform(
            attitude(up / math.sqrt(up @ up), np.array(self._heading(time))), position)

    def leader_odometry(self, time: float) -> Odometry:
        """Return the leader's true motion; its covariances are zero."""
        pose, step = self.leader(time), 0.5 * STEP
        before, after = self.leader(time - step), self.leader(time + step)
        rate = matrix_to_rotation_vector(before.rotation.T @ after.rotation) / (2.0 * step)
        velocity = self._course.at(time)[1] if time > 0.0 else np.zeros(3)
        quaternion = matrix_to_quaternion(pose.rotation)
        return Odometry(time, pose.translation, quaternion,
                        quaternion_to_matrix(quaternion).T @ velocity, rate)

    def wind(self, time: float) -> Array:
        """Return the velocity (3,) of the air, m/s."""
        return self._wind[min(max(int(time / WIND_PERIOD), 0), len(self._wind) - 1)]

    def blinding(self, time: float) -> Light | None:
        """Return the glare or shadow that hides everything, if there is any."""
        return next((_GLARE if glare else _SHADOW for begin, end, glare in self.light_changes
                     if begin <= time < end), None)

    def light(self, time: float) -> Light:
        """Return the light: clouds, and glare or shadow that hides everything."""
        if not self.scenario.sensing.light_changes:
            return Light()
        clouds = Light(gain=1.0 + 0.3 * math.sin(2.0 * math.pi * time / _CLOUDS))
        return self.blinding(time) or clouds

    def delay(self) -> float:
        """
        Return how long the next image is under way, s.

        That is the latency of the scenario, which varies by a tenth, without what the nodes take.
        """
        latency = self._latency * (1.0 + self._latency_rng.uniform(-0.1, 0.1))
        return float(max(latency - PROCESSING, 0.0))
