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
A simulated flock for tests of messages: leader and followers that fly, drift, see and send.

No vehicle follows another: places are formulas of time. Every follower's odometry begins at a
place and yaw of its own and walks at random; it sees the vehicles that SHAPES names, with noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import math

import numpy as np

from flock_follower.flock.alignment import Frame, yaw_rotation
from flock_follower.flock.exchange import Sharing
from flock_follower.geometry import Array, quaternion_from_yaw, wrap_angle
from flock_follower.messages import NANOSECONDS, OdometryState, to_nanoseconds

STEP = 1.0 / 30.0
#: Steps between two looks, and from an image to its sighting.
LOOKS, LATE = 2, 2
#: ns at which flights begin: as real clocks, too large for a float to hold exactly.
EPOCH = 1_700_000_000 * NANOSECONDS
LEADER = 'leader'

#: Place of each follower behind the leader, m, and the vehicles that its camera sees.
SHAPES: dict[str, tuple[list[tuple[float, float]], list[list[int]]]] = {
    # In line: each sees the one before it.
    'line': ([(-1.6, 0.0), (-3.2, 0.0), (-4.8, 0.0), (-6.4, 0.0)], [[0], [1], [2], [3]]),
    # The first two see the leader, the outer two see them.
    'wedge': ([(-1.4, 1.0), (-1.4, -1.0), (-2.8, 2.0), (-2.8, -2.0)],
              [[0], [0], [0, 1], [0, 2]]),
    # Round the leader, looking at it.
    'ring': ([(-1.7, 0.0), (0.0, 1.7), (1.7, 0.0), (0.0, -1.7)], [[0], [0], [0], [0]]),
    'side by side': ([(-1.7, 0.8), (-1.7, -0.8)], [[0], [0]]),
    'one sees the other': ([(-1.7, 0.0), (-3.4, 0.0)], [[], [1]]),
}


@dataclass
class Conditions:
    """What is varied."""

    shape: str = 'line'
    seed: int = 0
    loss: float = 0.0
    delay: float = 0.02
    """Of messages, s."""
    sight_std: float = 0.02
    """Of a place seen, per axis, m ..."""
    sight_memory: float = 0.0
    """... and for how long its error lasts, s."""
    outliers: float = 0.0
    """Share of sightings of something else, up to 2 m off."""
    attitude_std: float = 0.0
    """Of the yaw of a vehicle seen, rad; 0: no attitude is sent."""
    askew: float = 0.0
    """By how much markers hang askew, rad."""
    still: bool = False
    """Whether all hover."""
    clocks: Mapping[str, float] = field(default_factory=dict)
    """By how much a clock is ahead, s."""


@dataclass
class Report:
    """The states of one vehicle that another received in a flight."""

    errors: list[float] = field(default_factory=list)
    """Of the received place at the stamp, relative to the ego one, m."""
    chi2: list[float] = field(default_factory=list)
    """Of its prediction to the time of use."""
    since: float | None = None
    """When it was received first, s."""
    ticks: int = 0


class MadeUpFlock:
    """The flock; ``run`` lets it fly, and fills ``received`` and ``nees``."""

    def __init__(self, conditions: Conditions | None = None) -> None:
        self.conditions = conditions or Conditions()
        self.rng = np.random.default_rng(self.conditions.seed)
        places, sees = SHAPES[self.conditions.shape]
        self.names = [LEADER, *(f'follower_{k + 1}' for k in range(len(places)))]
        self.places = [(0.0, 0.0), *places]
        self.sees: list[list[int]] = [[], *[list(row) for row in sees]]
        count = len(self.names)
        self.turn = self.rng.uniform(-math.pi, math.pi, count)
        self.origin = self.rng.uniform(-20.0, 20.0, (count, 3)) * [1.0, 1.0, 0.05]
        self.wobble = self.rng.uniform(0.0, 2.0 * math.pi, (count, 3))
        self.sharing = {name: Sharing(name) for name in self.names[1:]}
        self.time = 0.0
        self.true = np.array([self.place(k, 0.0) for k in range(count)])
        self.odometry = self.origin.copy()
        self.history: list[tuple[Array, Array, Array]] = []
        self.wire: list[tuple[float, str, OdometryState]] = []
        self.received: dict[tuple[str, str], Report] = {}
        self.nees: list[float] = []
        self.events: dict[str, int] = {}
        self.silent: set[str] = set()
        self.lasting: dict[tuple[int, int], Array] = {}
        self.spoil: Callable[[str, OdometryState], list[OdometryState]] | None = None
        """Replaces a message on its way."""

    def place(self, k: int, time: float) -> Array:
        """Return the true place of a vehicle, (3,), m."""
        if self.conditions.still:
            return np.array([*self.places[k], 1.5 + 0.2 * k])
        speed, swing, rate = 0.4, 0.8, 0.35
        x, y = speed * time, swing * math.sin(rate * time)
        heading = math.atan2(swing * rate * math.cos(rate * time), speed)
        c, s = math.cos(heading), math.sin(heading)
        ahead, aside = self.places[k]
        own = 0.12 * np.sin([0.7, 0.9, 0.5] * np.full(3, time) + self.wobble[k])
        return np.array([x + c * ahead - s * aside, y + s * ahead + c * aside, 1.5]) + own

    def velocity(self, k: int, time: float) -> Array:
        """Return its true velocity, (3,), m/s."""
        return (self.place(k, time + 1e-3) - self.place(k, time - 1e-3)) / 2e-3

    def yaw(self, k: int, time: float) -> float:
        """Return its true yaw, rad: it looks at the first vehicle in its view, else ahead."""
        target = self.true[self.sees[k][0]] if self.sees[k] else self.true[k] + [1.0, 0.0, 0.0]
        towards = target - self.true[k]
        return math.atan2(towards[1], towards[0])

    def run(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / STEP)):
            self._advance()

    def stamp(self, time: float, name: str) -> int:
        """Return a time on the clock of a vehicle, ns."""
        return EPOCH + to_nanoseconds(time + self.conditions.clocks.get(name, 0.0))

    def _advance(self) -> None:
        rng = self.rng
        self.time += STEP
        step, count = len(self.history), len(self.names)
        true = np.array([self.place(k, self.time) for k in range(count)])
        # Odometry walks at random, by 0.1 deg and 2 cm in a second, and trembles by 5 mm.
        self.turn = self.turn + math.radians(0.1) * math.sqrt(STEP) * rng.normal(size=count)
        walk = 0.02 * math.sqrt(STEP) * rng.normal(size=(count, 3))
        for k in range(count):
            self.odometry[k] += yaw_rotation(self.turn[k]) @ (true[k] - self.true[k]) + walk[k]
        self.true = true
        self.history.append((true, self.odometry.copy(), self.turn.copy()))
        for k, name in enumerate(self.names[1:], 1):
            shown = self.odometry[k] + 0.005 * rng.normal(size=3)
            self.sharing[name].take_own(self.state(k, name, k, shown, self.time))
            if step % LOOKS == 0:
                self._look(k, name)
        if step % 3 == 0:
            for k, name in enumerate(self.names[1:], 1):
                self._send(k, name)

    def state(self, k: int, child: str, of: int, place: Array, time: float,
              position_variance: float = 0.0, yaw_variance: float = 0.0,
              yaw_error: float = 0.0) -> OdometryState:
        """Return a vehicle's state in the odometry of k, from its place in that."""
        pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
        pose[:3, :3] = position_variance * np.eye(3)
        pose[3:, 3:] = yaw_variance * np.eye(3)
        twist[:3, :3] = 0.05 ** 2 * np.eye(3)
        turn = yaw_rotation(self.turn[k])
        velocity = turn @ self.velocity(of, time) + 0.03 * self.rng.normal(size=3)
        yaw = self.yaw(of, time) + self.turn[k] + yaw_error
        return OdometryState(self.stamp(time, self.names[k]), 'odom', child, place,
                             quaternion_from_yaw(yaw), velocity, np.zeros(3), pose, twist,
                             np.eye(3))

    def _look(self, k: int, name: str) -> None:
        how, rng = self.conditions, self.rng
        if len(self.history) <= LATE:
            return
        true, odometry, turn = self.history[-1 - LATE]
        for of in self.sees[k]:
            place = odometry[k] + yaw_rotation(turn[k]) @ (true[of] - true[k])
            place = place + self._sight_error(k, of)
            self.sharing[name].take_seen(self.state(
                k, self.names[of], of, place, self.time - LATE * STEP, how.sight_std ** 2,
                how.attitude_std ** 2, how.askew + how.attitude_std * rng.normal()))

    def _sight_error(self, k: int, of: int) -> Array:
        how, rng = self.conditions, self.rng
        if rng.random() < how.outliers:
            return rng.uniform(-2.0, 2.0, 3)
        fading = math.exp(-LOOKS * STEP / how.sight_memory) if how.sight_memory else 0.0
        error = (fading * self.lasting.get((k, of), np.zeros(3))
                 + how.sight_std * math.sqrt(1.0 - fading ** 2) * rng.normal(size=3))
        self.lasting[k, of] = error
        return error

    def _send(self, k: int, name: str) -> None:
        how, sharing = self.conditions, self.sharing[name]
        due = [each for each in self.wire if each[0] <= self.time + 1e-9 and each[1] == name]
        self.wire = [each for each in self.wire if each[1] != name or each[0] > self.time + 1e-9]
        for _, _, state in due:
            sharing.take_message(state, self.stamp(self.time, name))
        now = self.stamp(self.time, name)
        reported = sharing.neighbors(now)
        messages = [] if name in self.silent else sharing.messages(now)
        for message in messages:
            for other in self.names[1:]:
                if other != name and self.rng.random() >= how.loss:
                    spoiled = [message] if self.spoil is None else self.spoil(name, message)
                    self.wire += [(self.time + how.delay, other, w) for w in spoiled]
        for reason, _ in sharing.new_events():
            self.events[reason] = self.events.get(reason, 0) + 1
        self._judge(k, name, reported)

    def relative(self, k: int, of: int, step: int, at: int | None = None) -> Array:
        """Return where a vehicle is in k's odometry at a step, which is k's own of ``at``."""
        true, odometry, turn = self.history[step if at is None else at]
        return odometry[k] + yaw_rotation(turn[k]) @ (self.history[step][0][of] - true[k])

    def _judge(self, k: int, name: str, reported: list[OdometryState]) -> None:
        last = len(self.history) - 1
        for state in reported:
            of = self.names.index(state.child)
            record = self.received.setdefault((name, state.child), Report())
            if record.since is None:
                record.since = self.time
            age = (self.stamp(self.time, name) - state.stamp) / NANOSECONDS
            then = max(last - round(age / STEP), 0)
            error = state.position - self.relative(k, of, then, last)
            ahead = state.position + age * state.velocity - self.relative(k, of, last)
            record.errors.append(float(np.linalg.norm(error)))
            record.chi2.append(float(ahead @ np.linalg.solve(
                state.pose_covariance[:3, :3], ahead)))
            record.ticks += 1
        for j, other in enumerate(self.names[1:], 1):
            sender = self.sharing[name].senders.get(other)
            if sender is not None and sender.frame is not None and not sender.unusable_reason(
                    self.stamp(self.time, name)):
                self.nees.append(self.misfit(k, j, sender.frame))

    def misfit(self, k: int, j: int, frame: Frame) -> float:
        """Return chi^2 (4 degrees of freedom) of a frame's alignment."""
        world = self.true[j] + yaw_rotation(-self.turn[j]) @ (frame.anchor - self.odometry[j])
        place = self.odometry[k] + yaw_rotation(self.turn[k]) @ (world - self.true[k])
        error = np.array([wrap_angle(frame.yaw - (self.turn[k] - self.turn[j])),
                          *(frame.place - place)])
        return float(error @ np.linalg.solve(frame.covariance, error))
