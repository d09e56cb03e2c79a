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
The world around the followers of a scenario: leader, air, vehicles and sensors, stepped by STEP.

Nothing here plans or reads a clock; the caller passes in the setpoints. Every
follower is a row: those of the first run by their numbers, then those of the second, and so on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
import math
from typing import Any

import numpy as np

from flock_desk.closed_loop.lookout import (
    IMAGE_STEPS,
    Lookout,
    others,
    Scene,
)
from flock_desk.scenarios.courses import course, STEP, turn_rate, wind_course
from flock_desk.scenarios.flock import facing_ahead, places
from flock_desk.scenarios.scenario import Scenario
from flock_desk.sensors.sensing import PerceptionNoise
from flock_desk.sensors.vio import Due, GaussMarkov, Vio
from flock_desk.vehicles.estimator import Barometer
from flock_desk.vehicles.quadrotor import attitude, Quadrotor
from flock_follower.geometry import Array, GRAVITY
from flock_follower.messages import OdometryState
from flock_follower.planner.inputs import OwnState

ODOMETRY_STEPS, GATE_STEPS = 2, 6
ATTITUDE_ERROR, ATTITUDE_MEMORY = 0.01, 10.0  # rad of tilt, constant and varying; s
DEAD_RECKONING = 0.1  # m/s after 1 s: how far the autopilot's velocity walks without odometry


class World:
    """Everything but planner and gate, for n runs of m followers at once."""

    def __init__(self, scenario: Scenario, runs: Sequence[int], noise: PerceptionNoise) -> None:
        self.scenario, self.noise = scenario, noise
        self._flock = scenario.company
        n, m = len(runs), self._flock.followers
        self._rows = [(run, number) for run in runs for number in range(1, m + 1)]
        count = round(scenario.duration / STEP) + 1
        courses = [course(scenario, run) for run in runs]
        self._leader = np.stack([c.positions for c in courses], axis=1)
        self._leader_velocity = np.stack([c.velocities for c in courses], axis=1)
        # It leans into its acceleration.
        up = np.stack([c.accelerations for c in courses], axis=1)
        up[..., 2] += GRAVITY
        self._leader_axis = up / np.linalg.norm(up, axis=2, keepdims=True)
        self._leader_heading = np.stack([c.headings for c in courses], axis=1)
        self._heading: Array = self._leader_heading[0]
        # Gusts change slowly: one value per gate tick is enough. A flock is in one air.
        self._wind = np.repeat(np.stack([wind_course(
            scenario.wind, count // GATE_STEPS + 1, GATE_STEPS * STEP,
            scenario.random(run, 'wind')) for run in runs], axis=1), m, axis=1)
        self.leader, self.leader_velocity = self._leader[0], self._leader_velocity[0]
        self.others = others(self._flock)
        """The vehicles around each follower, by number (m, m); 0 is the leader."""
        self.starts = self._starts()
        """Where each begins (rows, 3), m ..."""
        self.yaws = np.zeros(n) if scenario.flock is None else np.tile(
            facing_ahead(places(scenario.flock)), n)
        """... and its yaw then (rows,), rad."""
        self.vehicle = Quadrotor(self.starts, self.yaws)
        self._setpoints = _Delayed([round(g.uniform(*scenario.response.delay) / STEP)
                                    for g in self._random('delay')], self.yaws)
        self._thrust_error = GaussMarkov(
            self._random('thrust'), 1, scenario.response.thrust_error,
            scenario.response.thrust_memory, GATE_STEPS * STEP)
        self._step = 0
        self._vio = Vio(self.vehicle.position, self.vehicle.velocity, self._random('vio'),
                        scenario.odometry, ODOMETRY_STEPS * STEP)
        self._travel = self.vehicle.position.copy()  # (rows, 3), integral of vio's velocity
        self._due = Due(scenario.odometry.rate)
        self._odometry_latency = [
            a.uniform(*scenario.odometry.latency) + b.uniform(*scenario.response.odometry_delay)
            for a, b in zip(self._random('odometry latency'), self._random('odometry delay'))]
        self.lookout = Lookout(scenario, runs, noise, self._odometry_latency)
        self._ranges_due = Due(scenario.ranges.rate) if scenario.measures_ranges else None
        self._odometry_lost = False
        self._odometry: deque[list[OwnState]] = deque(maxlen=60)  # newest first
        self._drift: Array = np.zeros((n * m, 3))
        self._drift_rng = self._random('dead reckoning')
        self._tilt = GaussMarkov(self._random('attitude'), 2, ATTITUDE_ERROR, ATTITUDE_MEMORY,
                                 ODOMETRY_STEPS * STEP, ATTITUDE_ERROR)
        self._barometer = Barometer(self._random('barometer'))

    def _random(self, what: str) -> list[np.random.Generator]:
        """Return the generators of one thing that chance decides, one for each row."""
        return [self.scenario.random(run, what, number) for run, number in self._rows]

    def _starts(self) -> Array:
        altitude = 0.0 if self.scenario.takes_off else self.scenario.start.altitude
        if self.scenario.flock is None:
            return np.tile([0.0, 0.0, altitude], (len(self._rows), 1))
        offsets = np.stack([place.offset for place in places(self.scenario.flock)])
        starts = (self.leader[:, None] + offsets).reshape(-1, 3)
        starts[:, 2] = altitude
        return starts

    @property
    def present(self) -> Any:
        """Return which vehicles are there (m + 1,), the leader first."""
        there: Any = np.ones(self._flock.followers + 1, dtype=bool)
        fails = self._flock.fails
        if fails is not None and self._step * STEP >= fails.at + fails.gone:
            there[fails.follower] = False
        return there

    @property
    def positions(self) -> Array:
        """Return the true positions (n, m + 1, 3), m, the leader first."""
        return self._with_leader(self.leader, self.vehicle.position)

    @property
    def velocities(self) -> Array:
        """Return the true velocities (n, m + 1, 3), m/s, the leader first."""
        return self._with_leader(self.leader_velocity, self.vehicle.velocity)

    @property
    def distances(self) -> Array:
        """Return the true distances (rows, m) to the others, m; infinite if one is gone."""
        positions, m = self.positions, len(self.others)
        offsets = positions[:, self.others] - positions[:, 1:, None]
        there = self.present
        both = there[self.others] & there[1:, None]
        return np.where(both, np.sqrt(np.sum(offsets ** 2, axis=3)), np.inf).reshape(-1, m)

    def of_others(self, values: Array) -> Array:
        """Return values (n, m + 1, ...) of all vehicles as those of the others (rows, m, ...)."""
        m = len(self.others)
        return values[:, self.others].reshape(-1, m, *values.shape[2:])

    def _with_leader(self, leader: Array, followers: Array) -> Array:
        n = len(leader)
        return np.concatenate(
            [leader[:, None], followers.reshape(n, -1, *followers.shape[1:])], axis=1)

    def advance(self, k: int) -> None:
        """Advance from step k - 1 to step k."""
        self._step = k
        if k % GATE_STEPS == 0:
            self.vehicle.thrust_error = self._thrust_error.step()[:, 0]
        acceleration, yaw = self._setpoints.at(k)
        self.vehicle.step(acceleration, yaw, STEP, wind=self._wind[(k - 1) // GATE_STEPS])
        self.leader, self.leader_velocity = self._leader[k], self._leader_velocity[k]
        if self.scenario.leader.heading == 'away':
            followers = self.vehicle.position.reshape(len(self.leader), -1, 3)
            self._heading = self._heading + STEP * turn_rate(
                self._heading, self.leader - followers[:, self.present[1:]].mean(axis=1))
        else:
            self._heading = self._leader_heading[k]
        if k % ODOMETRY_STEPS == 0:
            self._sense(k * STEP)
        if k % IMAGE_STEPS == 0:
            self._look(k)
        if self._ranges_due is not None and k % ODOMETRY_STEPS == 0 and (
                not self._odometry_lost and self._ranges_due.at(k * STEP)):
            self.lookout.measure_ranges(k * STEP, self._scene(), self._vio, self._travel,
                                        self._placed(k * STEP))

    def _placed(self, now: float) -> float:
        """Return when there is odometry that is not older than now, s."""
        here = bool(self._odometry) and self._odometry[0][0].stamp == now
        return now if here else self._due.next

    def _sense(self, now: float) -> None:
        before = self._vio.velocity
        self._vio.step(self.vehicle.position, self.vehicle.velocity)
        # As perception does: images are compared where own motion is smooth.
        self._travel = self._travel + 0.5 * ODOMETRY_STEPS * STEP * (before + self._vio.velocity)
        self._odometry_lost = self.scenario.fails('vio', now)
        if self._odometry_lost:
            fresh = np.stack([g.standard_normal(3) for g in self._drift_rng])
            self._drift = self._drift + DEAD_RECKONING * math.sqrt(ODOMETRY_STEPS * STEP) * fresh
            return
        self._drift = np.zeros_like(self._drift)
        if self._due.at(now):
            yaw = self.vehicle.yaw + self._vio.yaw_error
            self._odometry.appendleft([OwnState(now, p, v, y) for p, v, y in zip(
                self._vio.position, self._vio.velocity, yaw.tolist())])

    def _scene(self) -> Scene:
        positions, there = self.positions, self.present
        leader = attitude(self._leader_axis[self._step], self._heading)
        return Scene(positions[:, self.others] - positions[:, 1:, None],
                     self._with_leader(self._heading, self.vehicle.yaw),
                     self._with_leader(leader, self.vehicle.rotation), there[self.others])

    def _look(self, k: int) -> None:
        # Perception waits for the first odometry that is not older than the image.
        self.lookout.look(k, self._scene(), self._vio, self._travel, self._placed(k * STEP),
                          self._odometry_lost)
        if self.scenario.prints:
            self.lookout.look_at_prints(self.vehicle.position, self.vehicle.rotation, self._vio)

    def attitudes(self) -> Array:
        """Return the attitudes (rows, 3, 3) by the autopilots, FLU to ENU, with their errors."""
        tilt = self._tilt.step()
        x, y = tilt.T
        error = np.tile(np.eye(3), (len(tilt), 1, 1))
        error[:, 0, 2], error[:, 2, 0], error[:, 1, 2], error[:, 2, 1] = y, -y, -x, x
        return error @ self.vehicle.rotation

    def look_alone(self, motions: Sequence[OdometryState | None], attitudes: Array) -> None:
        """Let rows without odometry look, whose motion by attitude is given; in image steps."""
        if self._step % IMAGE_STEPS == 0 and any(motions):
            self.lookout.look_alone(self._step, self._scene(), motions, attitudes)

    def odometry(self, now: float) -> list[OwnState | None]:
        """Return the newest odometry that has arrived in each row; None if it is lost."""
        if self._odometry_lost:
            return [None] * len(self._rows)
        return [next((states[row] for states in self._odometry
                      if states[row].stamp + late <= now + 1e-9), None)
                for row, late in enumerate(self._odometry_latency)]

    def flown(self) -> list[tuple[Array, Array, float, Array]]:
        """Return each vehicle's position, velocity, yaw, and the velocity its autopilot knows."""
        vehicle = self.vehicle
        return list(zip(vehicle.position, vehicle.velocity, vehicle.yaw.tolist(),
                        vehicle.velocity + self._drift))

    def heights(self, now: float) -> Array:
        """
        Return the heights (rows,), m, that barometers measure; they rest on no odometry.

        To be called once in every control cycle: each call is a new sample of the noise.
        """
        return self._barometer.heights(self.vehicle.position[:, 2], now)

    def obey(self, setpoints: list[tuple[Array, float | None]]) -> None:
        """Let the vehicles fly accelerations (3,), and yaws where they are given."""
        self._setpoints.take(self._step, setpoints)


class _Delayed:
    """
    The setpoints on their way to the vehicles.

    :param steps: after how many steps the vehicle of each row obeys.
    :param yaws: that are flown until then (rows,), rad.
    """

    def __init__(self, steps: Sequence[int], yaws: Array) -> None:
        self._steps, self._rows = np.array(steps), np.arange(len(steps))
        slots = max(steps) + 2
        self._coming: Array = np.full((slots, len(steps), 4), np.nan)  # acceleration and yaw
        self._flown: Array = np.concatenate([np.zeros((len(steps), 3)), yaws[:, None]], axis=1)

    def take(self, step: int, setpoints: list[tuple[Array, float | None]]) -> None:
        """Take accelerations (3,), and yaws where they are given, that leave after a step."""
        rows = np.array([[*a, np.nan if yaw is None else yaw] for a, yaw in setpoints])
        self._coming[(step + 1 + self._steps) % len(self._coming), self._rows] = rows

    def at(self, step: int) -> tuple[Array, Array]:
        """Return the accelerations (rows, 3) and yaws (rows,) that are flown in a step."""
        coming = self._coming[step % len(self._coming)]
        self._flown = np.where(np.isnan(coming), self._flown, coming)
        self._coming[step % len(self._coming)] = np.nan
        return self._flown[:, :3], self._flown[:, 3]
