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
Surroundings of a scenario's followers: leader, air, vehicles, odometry, stepped by COURSE_STEP.

Nothing here plans or reads a clock; the caller passes in the setpoints. Each follower is a row:
first the followers of the first run in the order of their numbers, then those of the second run,
and so on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
import math
from typing import Any, NamedTuple

import numpy as np

from flock_desk.scenarios.courses import course, COURSE_STEP, turn_rate, wind_course
from flock_desk.scenarios.flock import facing_ahead, places
from flock_desk.scenarios.scenario import Scenario
from flock_desk.sensors.vio import Due, GaussMarkov, Vio
from flock_desk.vehicles.estimator import Barometer
from flock_desk.vehicles.quadrotor import attitude, Quadrotor
from flock_follower.geometry import Array, GRAVITY
from flock_follower.planner.inputs import OwnState

ODOMETRY_STEPS = 2  # of COURSE_STEP, between two messages of odometry
GATE_STEPS = 6  # of COURSE_STEP, between two setpoints
ATTITUDE_ERROR = 0.01  # rad of tilt, both constant and varying
ATTITUDE_MEMORY = 10.0  # s, correlation time of the varying tilt
DEAD_RECKONING = 0.1  # m/s after 1 s: how far the autopilot's velocity walks without odometry


class Moment(NamedTuple):
    """The places of all vehicles of a world at a step of it."""

    step: int
    followers: Array
    """(rows, 3), m."""
    present: Any
    """Which vehicles are there (m + 1,), the leader first."""

    @classmethod
    def of(cls, world: World) -> Moment:
        """Return the present one."""
        return cls(world.step, world.vehicle.position, world.present.copy())


class World:
    """Everything but planner, gate and perception, for n runs of m followers at once."""

    def __init__(self, scenario: Scenario, runs: Sequence[int]) -> None:
        self.scenario = scenario
        n, m = len(runs), scenario.company.followers
        self.rows = [(run, number) for run in runs for number in range(1, m + 1)]
        self.others: Any = np.array(
            [[v for v in range(m + 1) if v != f] for f in range(1, m + 1)])
        """The vehicles around each follower, by number (m, m); 0 is the leader."""
        self.present: Any = np.ones(m + 1, dtype=bool)
        """Which vehicles are there (m + 1,), the leader first."""
        count = round(scenario.duration / COURSE_STEP) + 1
        courses = [course(scenario, run) for run in runs]
        self._leader, self._leader_velocity, up, self._leader_heading = (
            np.stack([getattr(c, name) for c in courses], axis=1)
            for name in ('positions', 'velocities', 'accelerations', 'headings'))
        # It leans into its acceleration.
        up[..., 2] += GRAVITY
        self._leader_axis = up / np.linalg.norm(up, axis=2, keepdims=True)
        self._heading: Array = self._leader_heading[0]
        # Gusts change slowly: one value per gate tick is enough. A flock is in one air.
        self._wind = np.repeat(np.stack([wind_course(
            scenario.wind, count // GATE_STEPS + 1, GATE_STEPS * COURSE_STEP,
            scenario.random(run, 'wind')) for run in runs], axis=1), m, axis=1)
        self.starts, self.yaws = self._starts(n)
        """Where each begins (rows, 3), m, and its yaw then (rows,), rad."""
        self.vehicle = Quadrotor(self.starts, self.yaws)
        self.step = 0
        """The number of the present step."""
        self._flown: tuple[Array, Array] = np.zeros((n * m, 3)), self.yaws.copy()
        """The setpoints that are flown: accelerations (rows, 3), m/s^2, and yaws (rows,), rad."""
        self.vehicle.steer(*self._flown)
        delays = [round(g.uniform(*scenario.response.delay) / COURSE_STEP)
                  for g in self.random('delay')]
        self._rows_by_delay = {delay: [row for row, own in enumerate(delays) if own == delay]
                               for delay in set(delays)}
        """The rows whose vehicles obey so many steps after the next."""
        self._coming: deque[tuple[int, list[tuple[Array, float | None]]]] = deque(
            maxlen=max(delays) // GATE_STEPS + 2)
        """The setpoints on their way to the vehicles, and the step when they were sent."""
        self._thrust_error = GaussMarkov(
            self.random('thrust'), 1, scenario.response.thrust_error,
            scenario.response.thrust_memory, GATE_STEPS * COURSE_STEP)
        self.vio = Vio(self.vehicle.position, self.vehicle.velocity, self.random('vio'),
                       scenario.odometry, ODOMETRY_STEPS * COURSE_STEP)
        self.travel = self.vehicle.position.copy()
        """Integral of the velocity of ``vio`` (rows, 3), m."""
        self._due = Due(scenario.odometry.rate)
        self.odometry_latency: Array = np.array([
            a.uniform(*scenario.odometry.latency) + b.uniform(*scenario.response.odometry_delay)
            for a, b in zip(self.random('odometry latency'), self.random('odometry delay'))])
        self.odometry_lost = False
        self._odometry: deque[list[OwnState]] = deque(maxlen=60)  # newest first
        self._drift: Array = np.zeros((n * m, 3))
        self._drift_rng = self.random('dead reckoning')
        self._tilt = GaussMarkov(self.random('attitude'), 2, ATTITUDE_ERROR, ATTITUDE_MEMORY,
                                 ODOMETRY_STEPS * COURSE_STEP, ATTITUDE_ERROR)
        self._barometer = Barometer(self.random('barometer'))

    def random(self, what: str) -> list[np.random.Generator]:
        """Return the random generators of one purpose, one for each row."""
        return [self.scenario.random(run, what, number) for run, number in self.rows]

    def _starts(self, n: int) -> tuple[Array, Array]:
        altitude = 0.0 if self.scenario.takes_off else self.scenario.start.altitude
        if self.scenario.flock is None:
            return np.tile([0.0, 0.0, altitude], (n, 1)), np.zeros(n)
        found = places(self.scenario.flock)
        starts = (self._leader[0][:, None] + np.stack([place.offset for place in found]))
        starts[..., 2] = altitude
        return starts.reshape(-1, 3), np.tile(facing_ahead(found), n)

    @property
    def positions(self) -> Array:
        """Return the true positions, (n, m + 1, 3), m, the leader first."""
        return self._all(self._leader[self.step], self.vehicle.position)

    @property
    def offsets(self) -> Array:
        """Return the way from each follower to each of the others (n, m, m, 3), m, ENU."""
        return self._offsets(self.positions)

    def _offsets(self, positions: Array) -> Array:
        offsets: Array = positions[:, self.others] - positions[:, 1:, None]
        return offsets

    def _all(self, leader: Array, followers: Array) -> Array:
        """Return values of all vehicles (n, m + 1, ...), the leader first."""
        return np.concatenate([leader[:, None], followers.reshape(
            len(leader), -1, *followers.shape[1:])], axis=1)

    @property
    def velocities(self) -> Array:
        """Return the true velocities, (n, m + 1, 3), m/s, the leader first."""
        return self._all(self._leader_velocity[self.step], self.vehicle.velocity)

    @property
    def headings(self) -> Array:
        """Return the yaws of the others of all rows (rows * m,), rad."""
        return self._all(self._heading, self.vehicle.yaw)[:, self.others].ravel()

    @property
    def bodies(self) -> Array:
        """Return the rotations of the others of all rows (rows * m, 3, 3), FLU to ENU."""
        leader = attitude(self._leader_axis[self.step], self._heading)
        return self._all(leader, self.vehicle.rotation)[:, self.others].reshape(-1, 3, 3)

    @property
    def distances(self) -> Array:
        """Return the true distances, (rows, m) to the others, m; infinite if one is gone."""
        return self.distances_at([Moment.of(self)])[0]

    def distances_at(self, moments: Sequence[Moment]) -> Array:
        """Return the true distances of some moments, (moments, rows, m), as ``distances``."""
        steps, followers, present = zip(*moments)
        leader = self._leader[list(steps)]
        there = np.repeat(np.stack(present), leader.shape[1], axis=0)
        both = there[:, self.others] & there[:, 1:, None]
        offsets = self._offsets(self._all(leader.reshape(-1, 3), np.concatenate(followers)))
        return np.where(both, np.sqrt(np.sum(offsets ** 2, axis=3)), np.inf).reshape(
            len(moments), -1, len(self.others))

    def advance(self, k: int) -> None:
        """Advance from step k - 1 to step k."""
        now, fails = k * COURSE_STEP, self.scenario.company.fails
        if fails is not None and now >= fails.at + fails.gone:
            self.present[fails.follower] = False
        if k % GATE_STEPS == 0:
            self.vehicle.thrust_error = self._thrust_error.step()[:, 0]
        self._take_setpoints(k)
        self.vehicle.step(COURSE_STEP, wind=self._wind[(k - 1) // GATE_STEPS])
        self.step = k
        if self.scenario.leader.heading == 'away':
            followers = self.vehicle.position.reshape(len(self._heading), -1, 3)
            center = np.add.reduce(followers[:, self.present[1:]], axis=1) / np.count_nonzero(
                self.present[1:])
            self._heading = self._heading + COURSE_STEP * turn_rate(
                self._heading, self._leader[k] - center)
        else:
            self._heading = self._leader_heading[k]
        if k % ODOMETRY_STEPS == 0:
            self._sense(now)

    def placed(self, now: float) -> float:
        """Return the time, s, at which the odometry of now arrives."""
        here = bool(self._odometry) and self._odometry[0][0].stamp == now
        return now if here else self._due.next

    def _sense(self, now: float) -> None:
        before = self.vio.velocity
        self.vio.step(self.vehicle.position, self.vehicle.velocity)
        # As perception does: images are compared where own motion is smooth.
        self.travel = self.travel + 0.5 * ODOMETRY_STEPS * COURSE_STEP * (
            before + self.vio.velocity)
        self.odometry_lost = self.scenario.fails('vio', now)
        if self.odometry_lost:
            fresh = np.stack([g.standard_normal(3) for g in self._drift_rng])
            self._drift = self._drift + DEAD_RECKONING * math.sqrt(
                ODOMETRY_STEPS * COURSE_STEP) * fresh
            return
        self._drift = np.zeros_like(self._drift)
        if self._due.at(now):
            yaw = self.vehicle.yaw + self.vio.yaw_error
            self._odometry.appendleft([OwnState(now, p, v, y) for p, v, y in zip(
                self.vio.position, self.vio.velocity, yaw.tolist())])

    def attitudes(self) -> Array:
        """Return the attitudes, (rows, 3, 3) by the autopilots, FLU to ENU, with their errors."""
        tilt = self._tilt.step()
        x, y = tilt.T
        error = np.tile(np.eye(3), (len(tilt), 1, 1))
        error[:, 0, 2], error[:, 2, 0], error[:, 1, 2], error[:, 2, 1] = y, -y, -x, x
        return error @ self.vehicle.rotation

    def odometry(self, now: float) -> list[OwnState | None]:
        """Return the newest odometry that has arrived in each row; None if it is lost."""
        if self.odometry_lost:
            return [None] * len(self.rows)
        return [next((states[row] for states in self._odometry
                      if states[row].stamp + late <= now + 1e-9), None)
                for row, late in enumerate(self.odometry_latency.tolist())]

    def flown(self, now: float) -> list[tuple[Array, Array, float, Array, float]]:
        """
        Return each vehicle's position, velocity, yaw, and its autopilot's velocity and height, m.

        The height is the barometer's, independent of odometry. Call this once per control cycle:
        each call draws new noise.
        """
        vehicle = self.vehicle
        return list(zip(vehicle.position, vehicle.velocity, vehicle.yaw.tolist(),
                        vehicle.velocity + self._drift,
                        self._barometer.heights(vehicle.position[:, 2], now).tolist()))

    def obey(self, setpoints: list[tuple[Array, float | None]]) -> None:
        """Queue accelerations (3,), m/s^2, and yaws: a vehicle flies them after its delay."""
        self._coming.append((self.step, setpoints))

    def _take_setpoints(self, k: int) -> None:
        """Let setpoints arrive that were sent one delay of their vehicle ago."""
        accelerations, yaws = self._flown
        arrived = False
        for sent, setpoints in self._coming:
            for row in self._rows_by_delay.get(k - sent - 1, ()):
                acceleration, yaw = setpoints[row]
                accelerations[row] = acceleration
                yaws[row] = yaws[row] if yaw is None else yaw
                arrived = True
        if arrived:
            self.vehicle.steer(accelerations, yaws)
