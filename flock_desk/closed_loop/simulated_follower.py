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
One simulated follower: the real ``follower.Follower``, its operator, and its odom frame.

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
from flock_desk.scenarios.courses import STEP
from flock_desk.scenarios.scenario import Scenario, VioErrors
from flock_follower.flock.exchange import Sharing
from flock_follower.flocking import FlockingParams
from flock_follower.follower import ControlCycle, Follower, Listener, Tick
from flock_follower.geometry import (
    Array,
    quaternion_from_yaw,
    quaternion_to_matrix,
    Transform,
    yaw_from_quaternion,
)
from flock_follower.mavlink.dialects import DIALECTS
from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.gate import Gate
from flock_follower.messages import (
    AccelerationState,
    OdometryState,
    RELATIVE,
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


class SimulatedFollower(Listener):
    """
    The follower of one row and its operator; receives the follower's events.

    :param frame: name of the odom frame; :param T_odom_world: its place in the world.
    :param start: where its vehicle begins (3,), m.
    :param view: field of view of its camera; () if cameras look to all sides.
    :param name: of its vehicle.
    :param cpu_time: see ``Follower``; :param law: see ``controllers``.
    """

    def __init__(self, scenario: Scenario, guard: bool, run: int, frame: str,
                 T_odom_world: Transform, start: Array, view: View, name: str,
                 cpu_time: Callable[[], float], law: type[FlockingParams]) -> None:
        # Scenarios judge the planner in open space: the bounds of the envelope are far.
        limits = GateLimits(a_max=scenario.flight.a_max, v_max=scenario.flight.v_max,
                            height_max=1000.0, radius_max=10000.0,
                            relative_flight=scenario.flight.relative_flight)
        autopilot = tuple(DIALECTS)[run % len(DIALECTS)] if scenario.operations else 'px4'

        def new_control() -> Gate:
            gate = Gate(limits)
            gate.compensates_wind = not DIALECTS[autopilot].compensates_wind
            return gate
        planner = PlannerLoop()
        planner.view, planner.ground = view, 0.0
        # Ticks come after everything of their moment, cycles in the middle between two ticks.
        self.follower = Follower(
            planner, _params(scenario, guard, law, name), new_control(), self,
            cycle_phase=GATE_STEPS // 2 * STEP, cpu_time=cpu_time,
            sharing=Sharing(name) if scenario.company.words else None)
        self.follower.advance(_AFTER)
        self.vehicle = OperatedVehicle(scenario, autopilot, self.follower, new_control, start)
        self.decision = Decision(State.IDLE)
        self.cpu = 0.0
        """CPU time of the last tick, s."""
        self.failed = False
        self.outbox: list[OdometryState] = []
        """Messages to the others; the owner empties it."""
        self._errors, self._alone = scenario.odometry, scenario.flock is None
        self._frame, self._T_odom_world = frame, T_odom_world
        self._turn = yaw_from_quaternion(T_odom_world.quaternion)
        self._known: OwnState | None = None
        self._now = 0.0

    def sense(self, now: float, own: OwnState | None) -> None:
        """Take the newest odometry there is."""
        if own is None or own is self._known or self.failed:
            return
        self._known, to_odom = own, self._T_odom_world
        pose, twist = (_UNKNOWN, _UNKNOWN) if self._alone else _covariances(self._errors, now)
        self.follower.odometry(to_nanoseconds(now), OdometryState(
            to_nanoseconds(own.stamp), self._frame, 'base_link', to_odom.apply(own.position),
            quaternion_from_yaw(own.yaw + self._turn), to_odom.rotation @ own.velocity, _ZERO,
            pose, twist, _LEVEL))

    def lean(self, now: float, quaternion: Array) -> OdometryState | None:
        """Take the attitude by the autopilot; return the motion without odometry, if flown on."""
        return None if self.failed else self.follower.attitude(
            to_nanoseconds(now), quaternion, _ZERO)

    def receive(self, now: float, message: OdometryState) -> None:
        """Take a message of another follower."""
        if not self.failed:
            self.follower.receive(to_nanoseconds(now), message)

    def plan(self, now: float, looked: list[float], seen: list[Sighted]) -> None:
        """Tick with what has arrived: stamps of images, s, and estimates."""
        if self.failed:
            return
        for stamp in looked:
            self.follower.frame(to_nanoseconds(now), to_nanoseconds(stamp))
        for each in seen:
            self._see(now, each)
        self.follower.advance(to_nanoseconds(now) + _AFTER)

    def _see(self, now: float, n: Sighted) -> None:
        to_frame = Transform() if n.relative else self._T_odom_world
        axes, pose, twist = to_frame.rotation, np.zeros((6, 6)), np.zeros((6, 6))
        pose[:3, :3] = axes @ n.position_covariance @ axes.T
        twist[:3, :3] = axes @ n.velocity_covariance @ axes.T
        pose[5, 5] = _ANY_YAW if n.yaw is None else YAW_NOISE ** 2 + ASKEW ** 2
        quaternion = quaternion_from_yaw((n.yaw or 0.0) + yaw_from_quaternion(to_frame.quaternion))
        acceleration = quaternion_to_matrix(quaternion).T @ (axes @ n.acceleration)
        stamp = to_nanoseconds(n.stamp)
        self.follower.neighbor(to_nanoseconds(now), with_acceleration(OdometryState(
            stamp, RELATIVE if n.relative else self._frame, n.name, to_frame.apply(n.position),
            quaternion,
            axes @ n.velocity, _ZERO, pose, twist, _LEVEL),
            AccelerationState(stamp, n.name, acceleration)))

    def obey(self, now: float, position: Array, velocity: Array, yaw: float,
             estimate: Array, altitude: float) -> tuple[Array, float | None]:
        """
        Return the acceleration and yaw that the vehicle flies from now on.

        :param altitude: by its barometer, m.
        """
        self._now = now
        self.follower.estimate(to_nanoseconds(now), self._T_odom_world.rotation @ estimate)
        self.follower.height(to_nanoseconds(now), altitude, float(position[2]))
        self.follower.advance(to_nanoseconds(now) + _AFTER)
        return self.vehicle.step(now, position, velocity, yaw)

    def fail(self, now: float) -> None:
        """Let the computer of its vehicle die: the autopilot, left alone, hovers."""
        self.failed, self.decision = True, Decision(State.IDLE)
        self.follower.bridge_died(to_nanoseconds(now))

    def send(self, time: int, messages: list[OdometryState]) -> None:
        if not self.failed:
            self.outbox += messages

    def tick(self, tick: Tick) -> None:
        if not self.failed:
            self.decision, self.cpu = tick.decision, tick.cpu

    def cycle(self, cycle: ControlCycle) -> None:
        setpoint = cycle.setpoint
        self.vehicle.send(setpoint._replace(
            acceleration=self._T_odom_world.rotation.T @ setpoint.acceleration,
            yaw=None if setpoint.yaw is None else setpoint.yaw - self._turn), self._now)


def _params(scenario: Scenario, guard: bool, law: type[FlockingParams],
            name: str) -> PlannerParams:
    """Return the planner's parameters of a vehicle."""
    params = scenario.flight.planner(guard)
    params = replace(params, law=law(**vars(params.law)))
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
