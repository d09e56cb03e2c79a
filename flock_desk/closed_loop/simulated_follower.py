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
One simulated follower: the real ``pipeline.Follower``, who operates it, and its odom frame.

A lone follower's odom frame is the world's. In a flock each has one of its own, which begins
where it stands and along where it faces, as visual-inertial odometry does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flock_desk.closed_loop.lookout import ASKEW, Sighted, YAW_NOISE
from flock_desk.closed_loop.operations import OperatedVehicle
from flock_desk.closed_loop.world import GATE_STEPS
from flock_desk.scenarios.leader import STEP
from flock_desk.scenarios.scenario import Scenario, VioErrors
from flock_follower.flock.exchange import Sharing
from flock_follower.follower import ControlCycle, Follower, Listener, Tick
from flock_follower.geometry import Array, quaternion_from_yaw, quaternion_to_matrix
from flock_follower.mavlink.dialects import DIALECTS
from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.gate import Gate
from flock_follower.messages import (
    AccelerationState,
    OdometryState,
    to_nanoseconds,
    with_acceleration,
)
from flock_follower.planner.inputs import OwnState
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.modes import State
from flock_follower.planner.params import FOLLOWER, LEADER, Member, PlannerParams
from flock_follower.planner.sight import View
from flock_follower.planner.step import Decision

_AFTER = 1  # ns by which ticks come after what arrives at their moment
_ZERO, _LEVEL = np.zeros(3), np.eye(3)
_UNKNOWN = np.zeros((6, 6))
_ANY_YAW = np.pi ** 2 / 3.0  # rad^2: the variance of one of which nothing is known


class OdomFrame:
    """
    The frame of one odometry: its name, and where in the world it is.

    :param origin: (3,), m; None where it is the world's own.
    :param yaw: of its x axis, rad.
    """

    def __init__(self, name: str = 'odom', origin: Array | None = None, yaw: float = 0.0) -> None:
        self.name, self.yaw, self._origin = name, yaw, origin
        self._axes = quaternion_to_matrix(quaternion_from_yaw(yaw))

    def point(self, point: Array) -> Array:
        """Return a point (3,) of the world as it is in this frame."""
        return point if self._origin is None else (point - self._origin) @ self._axes

    def vector(self, vector: Array) -> Array:
        """Return a vector (3,) of the world as it is in this frame."""
        return vector if self._origin is None else vector @ self._axes

    def covariance(self, covariance: Array) -> Array:
        """Return a covariance (3, 3) of the world as it is in this frame."""
        if self._origin is None:
            return covariance
        turned: Array = self._axes.T @ covariance @ self._axes
        return turned

    def outside(self, vector: Array) -> Array:
        """Return a vector (3,) of this frame as it is in the world."""
        return vector if self._origin is None else self._axes @ vector


class SimulatedFollower(Listener):
    """
    One row's follower, and who operates it; listens to what the follower does.

    :param frame: of its odometry.
    :param start: where its vehicle begins (3,), m.
    :param view: field of view of its camera; () if cameras look to all sides.
    :param name: of its vehicle.
    :param cpu_time: see ``Follower``.
    """

    def __init__(self, scenario: Scenario, guard: bool, run: int, frame: OdomFrame, start: Array,
                 view: View, name: str, cpu_time: Callable[[], float]) -> None:
        # Scenarios judge the planner in open space: the bounds of the envelope are far.
        limits = GateLimits(a_max=scenario.flight.a_max, v_max=scenario.flight.v_max,
                            height_max=1000.0, radius_max=10000.0)
        autopilot = tuple(DIALECTS)[run % len(DIALECTS)] if scenario.operations else 'px4'

        def new_control() -> Gate:
            gate = Gate(limits)
            gate.compensates_wind = not DIALECTS[autopilot].compensates_wind
            return gate
        planner = PlannerLoop()
        planner.view, planner.ground = view, 0.0
        # Ticks come after everything of their moment, cycles in the middle between two ticks.
        self.follower = Follower(
            planner, _params(scenario, guard, name), new_control(), self,
            cycle_phase=GATE_STEPS // 2 * STEP, cpu_time=cpu_time,
            sharing=Sharing(name) if scenario.company.words else None)
        self.follower.advance(_AFTER)
        self.vehicle = OperatedVehicle(scenario, autopilot, self.follower, new_control, start)
        self.decision = Decision(State.IDLE)
        self.cpu = 0.0
        """CPU time of the last tick, s."""
        self.failed = False
        self.spoken: list[OdometryState] = []
        """What it has told the others since somebody took it from here."""
        self._errors, self._alone = scenario.odometry, scenario.flock is None
        self._frame = frame
        self._known: OwnState | None = None
        self._handed: dict[str, float] = {}
        self._now = 0.0
        self._looked = -1.0

    def sense(self, now: float, own: OwnState | None) -> None:
        """Take the newest odometry there is."""
        if own is None or own is self._known or self.failed:
            return
        self._known, frame = own, self._frame
        pose, twist = (_UNKNOWN, _UNKNOWN) if self._alone else _covariances(self._errors, now)
        self.follower.odometry(to_nanoseconds(now), OdometryState(
            to_nanoseconds(own.stamp), frame.name, 'base_link', frame.point(own.position),
            quaternion_from_yaw(own.yaw - frame.yaw), frame.vector(own.velocity), _ZERO, pose,
            twist, _LEVEL))

    def hear(self, now: float, word: OdometryState) -> None:
        """Take what another follower tells."""
        if not self.failed:
            self.follower.word(to_nanoseconds(now), word)

    def plan(self, now: float, seen: list[Sighted], looked: list[float]) -> None:
        """Tick with the newest estimates; ``looked`` are the stamps of the newest images, s."""
        if self.failed:
            return
        for stamp in looked:
            if stamp > self._looked:
                self._looked = stamp
                self.follower.frame(to_nanoseconds(now), to_nanoseconds(stamp))
        for n in seen:
            # To hand in the same again does the planner no harm; the words would count it twice.
            if self._alone or self._handed.get(n.name) != n.stamp:
                self._handed[n.name] = n.stamp
                self._see(now, n)
        self.follower.advance(to_nanoseconds(now) + _AFTER)

    def _see(self, now: float, n: Sighted) -> None:
        frame, pose, twist = self._frame, np.zeros((6, 6)), np.zeros((6, 6))
        pose[:3, :3] = frame.covariance(n.position_covariance)
        twist[:3, :3] = frame.covariance(n.velocity_covariance)
        pose[5, 5] = _ANY_YAW if n.yaw is None else YAW_NOISE ** 2 + ASKEW ** 2
        quaternion = quaternion_from_yaw((n.yaw or 0.0) - frame.yaw)
        acceleration = quaternion_to_matrix(quaternion).T @ frame.vector(n.acceleration)
        stamp = to_nanoseconds(n.stamp)
        self.follower.neighbor(to_nanoseconds(now), with_acceleration(OdometryState(
            stamp, frame.name, n.name, frame.point(n.position), quaternion,
            frame.vector(n.velocity), _ZERO, pose, twist, _LEVEL),
            AccelerationState(stamp, n.name, acceleration)))

    def obey(self, now: float, position: Array, velocity: Array, yaw: float,
             estimate: Array, altitude: float) -> tuple[Array, float | None]:
        """
        Return the acceleration and yaw that the vehicle flies from now on.

        :param altitude: by its barometer, m.
        """
        self._now = now
        self.follower.estimate(to_nanoseconds(now), self._frame.vector(estimate))
        self.follower.height(to_nanoseconds(now), altitude, float(position[2]))
        self.follower.advance(to_nanoseconds(now) + _AFTER)
        return self.vehicle.step(now, position, velocity, yaw)

    def fail(self, now: float) -> None:
        """Let the computer of its vehicle die: the autopilot, left alone, hovers."""
        self.failed, self.decision = True, Decision(State.IDLE)
        self.follower.bridge_died(to_nanoseconds(now))

    def words(self, time: int, words: list[OdometryState]) -> None:
        if not self.failed:
            self.spoken += words

    def tick(self, tick: Tick) -> None:
        if not self.failed:
            self.decision, self.cpu = tick.decision, tick.cpu

    def cycle(self, cycle: ControlCycle) -> None:
        setpoint = cycle.setpoint
        if not self._alone:
            setpoint = setpoint._replace(
                acceleration=self._frame.outside(setpoint.acceleration),
                yaw=None if setpoint.yaw is None else setpoint.yaw + self._frame.yaw)
        self.vehicle.send(setpoint, self._now)


def _params(scenario: Scenario, guard: bool, name: str) -> PlannerParams:
    """Return what the planner of a vehicle of a name is told."""
    params = scenario.flight.planner(guard)
    return params if scenario.flock is None else replace(params, vehicles={
        other: Member(LEADER if other == scenario.flock.names[0] else FOLLOWER)
        for other in scenario.flock.names if other != name})


def _covariances(errors: VioErrors, time: float) -> tuple[Array, Array]:
    """Return the covariances (6, 6) of pose and twist that an odometry has after a time, s."""
    walks = np.array([errors.position_walk, errors.position_walk, errors.height_walk])
    pose = np.diag([*(errors.position ** 2 + time * walks ** 2),
                    *[errors.tilt ** 2 + errors.tilt_bias ** 2] * 2,
                    errors.attitude ** 2 + time * errors.yaw_walk ** 2])
    twist = np.diag([errors.velocity ** 2 + errors.velocity_white ** 2] * 3
                    + [errors.gyro_bias ** 2 + errors.gyro ** 2] * 3)
    return pose, twist
