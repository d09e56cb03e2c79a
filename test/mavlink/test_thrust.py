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
"""A wrong hover thrust at all accepted limits: planner, bridge and autopilot together."""

import math

from bridge_flight import Flight, PERIOD
import numpy as np
import pytest

from flock_desk.vehicles.embedded import STEP_TIME
from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.velocity_check import MotionReport
from flock_follower.geometry import quaternion_from_yaw
from flock_follower.messages import NANOSECONDS, OdometryState
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.params import PlannerParams

LATE, SEEN_LATE = 0.05, 0.1  # s: odometry and images arrive so late
NOISE = 0.02  # m/s, of the velocity, with a memory of 0.3 s
HEIGHT = 3.0


def state(time, child, position, velocity, yaw=0.0):
    """Return a state in odom; its covariances are small."""
    return OdometryState(
        round(time * NANOSECONDS), 'odom', child, np.asarray(position),
        quaternion_from_yaw(yaw), np.asarray(velocity), np.zeros(3), 1e-4 * np.eye(6),
        1e-4 * np.eye(6), np.eye(3))


class FollowingFlight(Flight):
    """A flight with the real planner behind a leader that hovers."""

    def __init__(self, personality, v_max, a_max, error, seed=0):
        super().__init__(personality, seed=seed, altitude=HEIGHT,
                         limits=GateLimits(v_max=v_max, a_max=a_max))
        self.odometry = False  # by ``_sense``, late and noisy
        self.loop, self.params = PlannerLoop(), PlannerParams(v_max=v_max, a_max=a_max)
        self.loop.ground = 0.0
        self.error, self.begun, self.dies = error, math.inf, math.inf
        self.rng, self.noise, self.known = np.random.default_rng(seed), np.zeros(3), []
        self.heights, self.handed_over, self.leader_height = [], None, HEIGHT

    def fly(self, seconds):
        for _ in range(round(seconds / STEP_TIME)):
            self.vehicle.thrust_error = self.error(self.now - self.begun)
            self._sense(self.now)
            super().fly(STEP_TIME)
            if self.begun < math.inf:
                self.heights.append(float(self.vehicle.position[2]))
            if self.handed_over is None and self.bridge.gate.handover(self.now):
                self.handed_over = self.heights[-1]

    def _sense(self, now):
        memory = math.exp(-STEP_TIME / 0.3)
        self.noise = memory * self.noise + math.sqrt(
            1.0 - memory ** 2) * NOISE * self.rng.normal(size=3)
        self.known.append((now, self.vehicle.position.copy(),
                           self.vehicle.velocity + self.noise, self.vehicle.yaw))
        time, position, velocity, yaw = self.known[-1 - min(
            round(LATE / STEP_TIME), len(self.known) - 1)]
        arrival = round(now * NANOSECONDS)
        self.bridge.gate.take_motion(
            'odom', MotionReport(velocity, yaw, position), now - time, now)
        self.loop.take_odometry(state(time, 'base_link', position, velocity, yaw), arrival)
        if self.steps % 3 == 0:
            seen = now - SEEN_LATE
            self.loop.take_neighbor(state(
                seen, 'leader', [1.9, 0.0, self.leader_height], np.zeros(3)))
            self.loop.take_frame(arrival, round(seen * NANOSECONDS))
        if self.steps % PERIOD == 0:
            self.loop.take_bridge_state(self.bridge.state(now), 0.05)
        if self.steps % 10 == 0:
            _, command = self.loop.tick(arrival, self.params, 0.0)
            if command is not None and now < self.dies:
                self.bridge.gate.take_command(command, *command.ages(arrival)[:1], now)


def constant(error):
    return lambda time: error if time >= 0.0 else 0.0


def step(error):
    return lambda time: error if time >= 8.0 else 0.0


def drift(rate):
    return lambda time: rate * max(min(time, 60.0), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(('personality', 'v_max', 'a_max', 'error', 'planner_dies'), [
    ('px4', 0.3, 1.5, constant(-1.2), math.inf), ('px4', 0.1, 1.5, constant(-1.2), 5.0),
    ('px4', 2.0, 2.5, step(1.0), 7.0), ('px4', 0.5, 2.5, drift(-0.05), math.inf),
    ('px4', 0.3, 1.5, constant(-1.9), math.inf),
    ('arducopter', 0.3, 1.5, constant(-1.2), math.inf),
    *(pytest.param('px4', *each, marks=pytest.mark.sweep) for each in (
        (0.3, 1.5, constant(1.2), 5.0), (0.3, 1.5, constant(1.9), 5.0),
        (0.1, 1.5, step(-1.0), math.inf), (0.1, 1.5, constant(-0.6), math.inf)))])
def test_a_wrong_hover_thrust_keeps_the_height_or_is_handed_over(
        personality, v_max, a_max, error, planner_dies):
    flight = FollowingFlight(personality, v_max, a_max, error)
    flight.fly(1.5)
    flight.begun = flight.now
    flight.engage()
    flight.loop.engage(True)
    begun = flight.leader_height = flight.heights[-1]
    flight.dies = flight.now + planner_dies
    flight.fly_until(lambda: flight.mode != flight.modes.offboard, 11.0)
    worst = np.max(np.abs(np.array(flight.heights) - begun))
    assert worst < (0.5 if flight.handed_over is None else 1.0)
    if abs(error(12.0)) > 1.5:  # more than is offset
        assert flight.handed_over is not None and abs(flight.handed_over - begun) < 0.85
    elif planner_dies == math.inf:
        assert flight.handed_over is None
        assert abs(flight.heights[-1] - begun) < 0.25
