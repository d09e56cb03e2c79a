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
The world around the followers of a scenario: leader, air, vehicle and sensors, stepped by STEP.

Nothing here plans or reads a clock; whoever steps it hands in what the vehicles shall fly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.simulation.scenarios.leader import course, STEP, turn_rate
from flock_follower.simulation.scenarios.scenario import Scenario
from flock_follower.simulation.scenarios.wind import wind_course
from flock_follower.simulation.sensors.ranging import SimulatedRanging
from flock_follower.simulation.sensors.sensing import (
    facing,
    Filters,
    in_view,
    PerceptionNoise,
    relative_noise,
)
from flock_follower.simulation.sensors.vio import Due, GaussMarkov, turned, Vio
from flock_follower.simulation.vehicles.vehicle import attitude, GRAVITY, Quadrotor

ODOMETRY_STEPS, IMAGE_STEPS, GATE_STEPS = 2, 4, 6
DEAD_RECKONING = 0.1  # m/s after 1 s: how far the autopilot's velocity walks without odometry


class World:
    """Everything but planner and gate, for n runs at once."""

    def __init__(self, scenario: Scenario, runs: Sequence[int], noise: PerceptionNoise) -> None:
        self.scenario, self.noise = scenario, noise
        n = len(runs)
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
        # Gusts change slowly: one value per gate tick is enough.
        self._wind = np.stack([wind_course(
            scenario.wind, count // GATE_STEPS + 1, GATE_STEPS * STEP,
            scenario.random(run, 'wind')) for run in runs], axis=1)
        altitude = 0.0 if scenario.takes_off else scenario.start.altitude
        self.vehicle = Quadrotor(np.tile([0.0, 0.0, altitude], (n, 1)), np.zeros(n))
        self.leader, self.leader_velocity = self._leader[0], self._leader_velocity[0]
        self._setpoints = _Delayed.drawn(scenario, runs)
        self._thrust_error = GaussMarkov(
            [scenario.random(run, 'thrust') for run in runs], 1, scenario.response.thrust_error,
            scenario.response.thrust_memory, GATE_STEPS * STEP)
        self._step = 0
        self._vio = Vio(self.vehicle.position, self.vehicle.velocity,
                        [scenario.random(run, 'vio') for run in runs], scenario.odometry,
                        ODOMETRY_STEPS * STEP)
        errors = scenario.odometry
        self._tilt = GaussMarkov([scenario.random(run, 'tilt') for run in runs], 2, errors.tilt,
                                 errors.tilt_memory, IMAGE_STEPS * STEP, errors.tilt_bias)
        self._sight: Array | None = None
        self._travel = self.vehicle.position.copy()  # (n, 3), the integral of vio's velocity
        self._due = Due(scenario.odometry.rate)
        self._odometry_latency = [
            scenario.random(run, 'odometry latency').uniform(*scenario.odometry.latency)
            + scenario.random(run, 'odometry delay').uniform(*scenario.response.odometry_delay)
            for run in runs]
        self._filters = Filters(n)
        self._ranging = SimulatedRanging(
            scenario.ranges, [scenario.random(run, 'ranges') for run in runs]
        ) if scenario.ranges.rate else None
        self._ranged: deque[_Sent] = deque(maxlen=40)
        self.told_distance: Array = np.full(n, np.nan)
        """By ranges, of leaders out of sight (n,), m; NaN where it is in sight."""
        self._images = [_Images.drawn(scenario, run) for run in runs]
        latency = np.stack([images.latency for images in self._images], axis=1)
        self._latency, self._noise = latency, np.stack([i.noise for i in self._images], axis=1)
        self._visible = np.stack([images.visible for images in self._images], axis=1)
        self._sent: deque[_Sent] = deque(maxlen=20)
        self._odometry_lost = False
        self._odometry: deque[list[OwnState]] = deque(maxlen=60)  # newest first
        self._drift: Array = np.zeros((n, 3))
        self._drift_rng = [scenario.random(run, 'dead reckoning') for run in runs]
        self.seen: Any = np.zeros(n, dtype=bool)
        self.in_sight: Any = np.ones(n, dtype=bool)
        """Whether the newest image would show each leader, were nothing in the way (n,)."""

    @property
    def distance(self) -> Array:
        """Return the true distances (n,), m."""
        return np.sqrt(np.sum((self.leader - self.vehicle.position) ** 2, axis=1))

    def advance(self, k: int) -> None:
        """Advance from step k - 1 to step k."""
        self._step = k
        if k % GATE_STEPS == 0:
            self.vehicle.thrust_error = self._thrust_error.step()[:, 0]
        acceleration, yaw = self._setpoints.at(k)
        self.vehicle.step(acceleration, yaw, STEP, wind=self._wind[(k - 1) // GATE_STEPS])
        self.leader, self.leader_velocity = self._leader[k], self._leader_velocity[k]
        if self.scenario.leader.heading == 'away':
            self._heading = self._heading + STEP * turn_rate(
                self._heading, self.leader - self.vehicle.position)
        else:
            self._heading = self._leader_heading[k]
        if k % ODOMETRY_STEPS == 0:
            before, now = self._vio.velocity, k * STEP
            self._vio.step(self.vehicle.position, self.vehicle.velocity)
            # As perception does: images are compared where own motion is smooth.
            self._travel = self._travel + 0.5 * ODOMETRY_STEPS * STEP * (
                before + self._vio.velocity)
            self._odometry_lost = self.scenario.fails('vio', now)
            if self._odometry_lost:
                fresh = np.stack([g.standard_normal(3) for g in self._drift_rng])
                self._drift = self._drift + DEAD_RECKONING * math.sqrt(
                    ODOMETRY_STEPS * STEP) * fresh
            else:
                self._drift = np.zeros_like(self._drift)
                if self._due.at(now):
                    yaw = self.vehicle.yaw + self._vio.yaw_error
                    self._odometry.appendleft([OwnState(now, p, v, y) for p, v, y in zip(
                        self._vio.position, self._vio.velocity, yaw.tolist())])
        if k % IMAGE_STEPS == 0:
            self._look(k)
        if self._ranging is not None and k % ODOMETRY_STEPS == 0 and not self._odometry_lost and (
                self._ranging.due(k * STEP)):
            self._measure(k * STEP, self._ranging)

    def _measure(self, now: float, ranging: SimulatedRanging) -> None:
        """Measure the distances, and tell what becomes of them."""
        told, distance, position, *others = ranging.step(
            now, self.leader - self.vehicle.position, self._travel, self._filters)
        self.told_distance = np.where(told, distance, np.nan)
        position = position + self._vio.position - self._travel
        self._ranged.append(_Sent(now, np.maximum(now + ranging.latency, self._placed(now)), [
            NeighborEstimate('leader', now, *state) if given else None
            for given, *state in zip(told.tolist(), position, *others)]))

    def _look(self, k: int) -> None:
        image, now = k // IMAGE_STEPS, k * STEP
        offsets = self.leader - self.vehicle.position
        leader = attitude(self._leader_axis[k], self._heading)
        self.in_sight = in_view(offsets, self.vehicle.rotation, self.noise) & facing(
            offsets, leader, self.scenario.sensing.marker_angle)
        found = self._visible[image] & self.in_sight
        if self._odometry_lost:
            found = np.zeros_like(found)  # nothing can be placed in a frame that is lost
        self.seen = self.seen | found
        tilt = np.concatenate([self._tilt.step(), np.zeros((len(offsets), 1))], axis=1)
        covariance = relative_noise(offsets, self.noise, self._turning(offsets))
        offsets = turned(offsets + np.cross(tilt, offsets), self._vio.yaw_error)
        scale = self.scenario.sensing.noise
        # Along and across the line of sight are the covariance's own axes.
        drawn = scale * np.einsum('nij,nj->ni', np.linalg.cholesky(covariance),
                                  self._noise[image, :, :3])
        # As in perception, the filters live where own motion is smooth, their results in odom.
        used = self._filters.update(now, self._travel + offsets + drawn,
                                    max(scale, 1e-3) ** 2 * covariance, found)
        position = self._filters.position + self._vio.position - self._travel
        velocity = (self._filters.velocity
                    + self.scenario.sensing.velocity_noise * self._noise[image, :, 3:])
        estimates = [NeighborEstimate('leader', now, *state) if seen else None
                     for seen, *state in zip(
                         used.tolist(), position, velocity, self._filters.position_covariance,
                         self._filters.velocity_covariance, self._filters.acceleration.copy())]
        arrivals = np.maximum(now + self._latency[image], self._placed(now))
        self._sent.append(_Sent(now, arrivals, estimates))

    def _placed(self, now: float) -> Array:
        """Return when perception has odometry (n,), s, that is not older than now."""
        placed = now if self._odometry and self._odometry[0][0].stamp == now else self._due.next
        arrivals: Array = placed + np.array(self._odometry_latency)
        return arrivals

    def _turning(self, offsets: Array) -> Array:
        """Return how fast the leaders have moved across the image since the last one, rad/s."""
        sight = np.einsum('nji,nj->ni', self.vehicle.rotation, offsets)
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        before, self._sight = sight if self._sight is None else self._sight, sight
        turning: Array = np.linalg.norm(sight - before, axis=1) / (IMAGE_STEPS * STEP)
        return turning

    def odometry(self, now: float) -> list[OwnState | None]:
        """Return the newest odometry that has arrived in each run; None where it is lost."""
        if self._odometry_lost:
            return [None] * len(self._odometry_latency)
        return [next((states[run] for states in self._odometry
                      if states[run].stamp + late <= now + 1e-9), None)
                for run, late in enumerate(self._odometry_latency)]

    def estimates(self, now: float) -> list[list[NeighborEstimate]]:
        """Return the newest estimates of the leader that have arrived in each run, if any."""
        newest, ranged = self._newest(self._sent, now), self._newest(self._ranged, now)
        for seen, told in zip(newest, ranged):
            if told and not (seen and seen[0].stamp >= told[0].stamp):
                seen += told
        return newest

    def _newest(self, sent: deque[_Sent], now: float) -> list[list[NeighborEstimate]]:
        newest: list[list[NeighborEstimate]] = [[] for _ in self._images]
        for _, arrivals, estimates in reversed(sent):
            for run, (arrival, estimate) in enumerate(zip(arrivals.tolist(), estimates)):
                if not newest[run] and estimate is not None and arrival <= now + 1e-9:
                    newest[run].append(estimate)
            if all(newest):
                break
        return newest

    def looked(self, now: float) -> list[float | None]:
        """Return the stamp of the newest image that was processed in each run, s, if any."""
        return [next((sent.stamp for sent in reversed(self._sent)
                      if sent.arrivals[run] <= now + 1e-9), None)
                for run in range(len(self._images))]

    def flown(self) -> list[tuple[Array, Array, float, Array]]:
        """Return each vehicle's position, velocity, yaw, and the velocity its autopilot knows."""
        vehicle = self.vehicle
        return list(zip(vehicle.position, vehicle.velocity, vehicle.yaw.tolist(),
                        vehicle.velocity + self._drift))

    def obey(self, setpoints: list[tuple[Array, float | None]]) -> None:
        """Let the vehicles fly accelerations (3,), and yaws where they are given."""
        self._setpoints.take(self._step, setpoints)


class _Sent(NamedTuple):
    """What perception made of an image."""

    stamp: float
    """s."""
    arrivals: Array
    """When it reaches the planner of each run (n,), s."""
    estimates: list[NeighborEstimate | None]
    """Of each run."""


class _Delayed:
    """
    The setpoints on their way to the vehicles.

    :param steps: after how many steps each run's vehicle obeys (n,).
    """

    def __init__(self, steps: Any) -> None:
        self._steps, self._runs = steps, np.arange(len(steps))
        slots = int(steps.max()) + 2
        self._coming: Array = np.full((slots, len(steps), 4), np.nan)  # acceleration and yaw
        self._flown: Array = np.zeros((len(steps), 4))

    @classmethod
    def drawn(cls, scenario: Scenario, runs: Sequence[int]) -> _Delayed:
        return cls(np.array([round(scenario.random(run, 'delay').uniform(
            *scenario.response.delay) / STEP) for run in runs]))

    def take(self, step: int, setpoints: list[tuple[Array, float | None]]) -> None:
        """Take accelerations (3,), and yaws where they are given, that leave after a step."""
        rows = np.array([[*a, np.nan if yaw is None else yaw] for a, yaw in setpoints])
        self._coming[(step + 1 + self._steps) % len(self._coming), self._runs] = rows

    def at(self, step: int) -> tuple[Array, Array]:
        """Return the accelerations (n, 3) and yaws (n,) that are flown in a step."""
        coming = self._coming[step % len(self._coming)]
        self._flown = np.where(np.isnan(coming), self._flown, coming)
        self._coming[step % len(self._coming)] = np.nan
        return self._flown[:, :3], self._flown[:, 3]


@dataclass(frozen=True)
class _Images:
    """What chance decides about the images of one run."""

    latency: Array
    noise: Array
    visible: Any

    @classmethod
    def drawn(cls, scenario: Scenario, run: int) -> _Images:
        sensing, rng = scenario.sensing, scenario.random(run, 'images')
        count = round(scenario.duration / STEP) // IMAGE_STEPS + 1
        times = np.arange(count) * IMAGE_STEPS * STEP
        latency = rng.uniform(*sensing.latency) * (1.0 + rng.uniform(-0.1, 0.1, count))
        visible = rng.random(count) < sensing.recall
        for outage in scenario.outages:
            if outage.what == 'marker':
                visible &= (times < outage.at) | (times >= outage.at + outage.duration)
        for begin in rng.uniform(0.0, scenario.duration, rng.poisson(
                sensing.light_changes * scenario.duration / 60.0)):
            visible &= (times < begin) | (times >= begin + rng.uniform(*sensing.light_change))
        return cls(latency, rng.standard_normal((count, 6)), visible)
