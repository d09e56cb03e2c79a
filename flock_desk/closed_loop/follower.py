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
One simulated follower: the real ``follower.Follower``, its odom frame, operator and pilot.

The odom frame of a single follower is the world frame. In a flock each follower has its own odom
frame with the origin and heading of its start, as with visual-inertial odometry.

The operator arms, takes off, calls offboard and engage; the pilot takes over and gives back by
the mode switch; the bridge may die and start again. A simple autopilot with the modes of PX4 obeys
them: it flies take-off, hold and the pilot's climb by itself, and setpoints in its offboard mode,
with the measured delays and timeouts. MAVLink is simulated by the embedded autopilots only
(``vehicles``).
"""

from __future__ import annotations

from dataclasses import replace
import math
from typing import Final

import numpy as np

from flock_desk.closed_loop.camera_views import MARKER_TILT, Sighted, YAW_NOISE
from flock_desk.closed_loop.world import GATE_STEPS
from flock_desk.follower import Follower
from flock_desk.follower.outcomes import ControlCycle, Listener, Tick
from flock_desk.scenarios.courses import COURSE_STEP
from flock_desk.scenarios.scenario import ENGAGE_TIME, Operation, Scenario, VioErrors
from flock_desk.sensors.sensing import DIRECTIONS
from flock_follower.flock.exchange import Sharing
from flock_follower.flocking import FlockingParams
from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.gate import Gate
from flock_follower.gate.setpoint_rules import NONE, Setpoint
from flock_follower.gate.vehicle_status import AutopilotTraits, VehicleStatus
from flock_follower.geometry import (
    Array,
    quaternion_from_yaw,
    quaternion_to_matrix,
    Transform,
    yaw_from_quaternion,
)
from flock_follower.mavlink.dialects import PX4
from flock_follower.messages import OdometryState, RELATIVE, to_nanoseconds
from flock_follower.messages.accelerations import AccelerationState, with_acceleration
from flock_follower.perception.neighbor_motion import POSITION, VELOCITY
from flock_follower.planner.inputs import OwnState
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.modes import State
from flock_follower.planner.params import FOLLOWER, LEADER, Member, PlannerParams
from flock_follower.planner.sight import FieldsOfView
from flock_follower.planner.step import Decision

_TICK_DELAY_NS = 1  # ns by which ticks come after the messages of their moment

_HERE = Transform()
_ZERO_VECTOR = np.zeros(3)
_LEVEL_ATTITUDE = np.eye(3)
_NO_COVARIANCE = np.zeros((6, 6))
_ANY_YAW = np.pi ** 2 / 3.0  # rad^2: the variance of an unknown yaw
MANUAL, TAKEOFF = 'POSCTL', PX4.takeoff_modes[0]  # the pilot's mode, and that of the take-off
HEARTBEAT_PERIOD: Final = 1.0  # s
SETPOINT_TIMEOUT: Final = 0.5  # s: COM_OF_LOSS_T as recommended
CLIMB_SPEED: Final = 1.0  # m/s, of the take-off and of the pilot
UP_ENU: Final = np.array([0.0, 0.0, 1.0])  # unit vector
POSITION_GAIN = 1.5  # 1/s^2, of the autopilot's own position control
VELOCITY_GAIN = 2.2  # 1/s, of the autopilot's own position control


class SimulatedFollower(Listener):
    """
    The follower of one row, its operator, pilot and autopilot; receives the follower's events.

    :param frame: name of the odom frame; :param T_odom_world: its place in the world.
    :param start: where its vehicle begins (3,), m.
    :param view: field of view of its camera; () if cameras look to all sides.
    :param name: of its vehicle; :param law: see ``controllers``.
    """

    def __init__(self, scenario: Scenario, guard: bool, frame: str, T_odom_world: Transform,
                 start: Array, view: FieldsOfView, name: str, law: type[FlockingParams]) -> None:
        # Scenarios judge the planner in open space: the bounds of the envelope are far.
        self._limits = GateLimits(a_max=scenario.flight.a_max, v_max=scenario.flight.v_max,
                                  height_max=1000.0, radius_max=10000.0,
                                  relative_flight=scenario.flight.relative_flight)
        planner = PlannerLoop()
        planner.view, planner.ground = view, 0.0
        # Ticks come after everything of their moment, cycles in the middle between two ticks.
        self._follower = Follower(
            planner, _params(scenario, guard, law, name), self._new_control(), self,
            cycle_phase=GATE_STEPS // 2 * COURSE_STEP,
            sharing=Sharing(name) if scenario.company.words else None)
        self._follower.advance(_TICK_DELAY_NS)
        self.decision = Decision(State.IDLE)
        self.failed = False
        self.outbox: list[OdometryState] = []
        """Messages to the others; the owner empties it."""
        self._errors, self._alone = scenario.odometry, scenario.flock is None
        self._frame, self._T_odom_world = frame, T_odom_world
        self._turn = yaw_from_quaternion(T_odom_world.quaternion)
        self._known: OwnState | None = None
        self._now = 0.0
        usual = Operation('offboard', 0.0), Operation('engage',
                                                      ENGAGE_TIME - GATE_STEPS * COURSE_STEP)
        self._waiting = [(o.at, o.what, o.duration if o.what == 'restart' else o.height)
                         for o in sorted(scenario.operations or usual, key=lambda o: o.at)]
        """What is to come: time, s, an operation or its outcome, and its height or duration."""
        self._armed = not scenario.takes_off
        self._mode = PX4.offboard if self._armed else PX4.hold
        self._status: VehicleStatus | None = None
        self._goal = start
        self._yaw: float | None = None
        self._beat = self._setpoint_time = -math.inf
        self._setpoint: Setpoint | None = None
        self._asked = False
        """Whether offboard was called, by the operations and HEARTBEATs so far."""
        self.unasked = 0
        """Number of setpoints sent while offboard was not requested."""
        self.obeying = False
        """Whether the vehicle flies setpoints."""

    def _new_control(self) -> Gate:
        """Return the setpoint control of a newly started bridge."""
        gate = Gate(self._limits)
        gate.autopilot = AutopilotTraits(needs_wind_offset=not PX4.compensates_wind)
        return gate

    def sense(self, now: float, own: OwnState | None) -> None:
        """Take the newest odometry that has arrived."""
        if own is None or own is self._known or self.failed:
            return
        self._known, to_odom = own, self._T_odom_world
        pose, twist = (_NO_COVARIANCE,
                       _NO_COVARIANCE) if self._alone else _covariances(self._errors, now)
        self._follower.odometry(to_nanoseconds(now), OdometryState(
            to_nanoseconds(own.stamp), self._frame, 'base_link', to_odom.apply(own.position),
            quaternion_from_yaw(own.yaw + self._turn), to_odom.rotation.dot(own.velocity),
            _ZERO_VECTOR,
            pose, twist, _LEVEL_ATTITUDE))

    def lean(self, now: float, quaternion: Array) -> OdometryState | None:
        """Take the autopilot's attitude; return the motion without odometry, if it is flown."""
        return None if self.failed else self._follower.attitude(
            to_nanoseconds(now), quaternion, _ZERO_VECTOR)

    def receive(self, now: float, message: OdometryState) -> None:
        """Take a message of another follower."""
        if not self.failed:
            self._follower.receive(to_nanoseconds(now), message)

    def plan(self, now: float, looked: list[float], seen: list[Sighted]) -> None:
        """Tick with the arrivals: stamps of images, s, and estimates."""
        if self.failed:
            return
        for stamp in looked:
            self._follower.frame(to_nanoseconds(now), to_nanoseconds(stamp))
        for each in seen:
            self._see(now, each)
        self._follower.advance(to_nanoseconds(now) + _TICK_DELAY_NS)

    def _see(self, now: float, sighted: Sighted) -> None:
        name, n, yaw, relative = sighted
        to_frame, turn = (_HERE, 0.0) if relative else (self._T_odom_world, self._turn)
        axes, pose, twist = to_frame.rotation, np.zeros((6, 6)), np.zeros((6, 6))
        pose[:3, :3] = axes.dot(n.covariance[POSITION, POSITION]).dot(axes.T)
        twist[:3, :3] = axes.dot(n.covariance[VELOCITY, VELOCITY]).dot(axes.T)
        pose[5, 5] = _ANY_YAW if yaw is None else YAW_NOISE ** 2 + MARKER_TILT ** 2
        quaternion = quaternion_from_yaw((yaw or 0.0) + turn)
        acceleration = quaternion_to_matrix(quaternion).T.dot(axes.dot(n.acceleration))
        stamp = to_nanoseconds(n.stamp)
        self._follower.neighbor(to_nanoseconds(now), with_acceleration(OdometryState(
            stamp, RELATIVE if relative else self._frame, name, to_frame.apply(n.position),
            quaternion, axes.dot(n.velocity), _ZERO_VECTOR, pose, twist, _LEVEL_ATTITUDE),
            AccelerationState(stamp, name, acceleration)))

    def obey(self, now: float, position: Array, velocity: Array, yaw: float,
             estimate: Array, altitude: float) -> tuple[Array, float | None]:
        """
        Process all due events; return the acceleration and yaw to fly from now on.

        :param altitude: by its barometer, m.
        """
        time, self._now = to_nanoseconds(now), now
        self._follower.estimate(time, self._T_odom_world.rotation.dot(estimate))
        self._follower.height(time, altitude, float(position[2]))
        self._follower.advance(time + _TICK_DELAY_NS)
        for event in [each for each in self._waiting if each[0] <= now + 1e-9]:
            self._waiting.remove(event)
            self._yaw = yaw
            self._do(*event[1:], now, position)
        on_ground = self._mode == TAKEOFF or bool(position[2] < 0.05)
        if self._mode == TAKEOFF and position[2] > self._goal[2] - 0.2:
            self._mode = PX4.hold
            self._goal = np.array([*position[:2], self._goal[2]])
        self._report_status(now, on_ground)
        return self._fly(now, position, velocity)

    def _do(self, what: str, amount: float, now: float, position: Array) -> None:
        time, above = to_nanoseconds(now), position + amount * UP_ENU
        match what:
            case 'arm':
                self._armed = True
            case 'takeoff':
                self._mode, self._goal = TAKEOFF, above
            case 'offboard':
                self._asked = True
                self._follower.permit(time, now - 1e-3)
                # The bridge has to stream first, and to receive the mode by HEARTBEAT.
                self._waiting.append((now + PX4.stream_before_offboard, 'obeyed', 0.0))
            case 'obeyed':
                self._mode, self._goal = PX4.offboard, position
            case 'engage':
                self._follower.engage(time, True)
            case 'pilot':
                self._mode, self._goal = MANUAL, above
            case 'restart':
                self._asked = False
                self._follower.bridge_died(time)
                self._waiting.append((now + amount, 'started', 0.0))
            case 'started':
                self._follower.bridge_started(time, self._new_control())

    def _report_status(self, now: float, on_ground: bool) -> None:
        if now - self._beat < HEARTBEAT_PERIOD - 1e-9:
            return
        self._beat = now
        obeyed = self._status is not None and self._status.offboard
        self._status = VehicleStatus(self._armed, self._mode, self._mode == PX4.offboard)
        if obeyed and not self._status.offboard:
            self._asked = False
        self._follower.vehicle(to_nanoseconds(now), self._status, not on_ground)

    def _fly(self, now: float, position: Array,
             velocity: Array) -> tuple[Array, float | None]:
        silent = now - self._setpoint_time > SETPOINT_TIMEOUT
        offboard = self._mode == PX4.offboard
        if offboard and not silent and self._setpoint is not None:
            self.obeying = True
            self._goal = position.copy()
            return self._setpoint.acceleration, self._setpoint.yaw
        if offboard and self.obeying:
            self._mode = PX4.hold  # COM_OBL_RC_ACT 5
        self.obeying = False
        if not self._armed:
            return np.zeros(3), None
        nominal = np.clip(POSITION_GAIN * (self._goal - position), -VELOCITY_GAIN * CLIMB_SPEED,
                          VELOCITY_GAIN * CLIMB_SPEED) - VELOCITY_GAIN * velocity
        return nominal, self._yaw

    def fail(self, now: float) -> None:
        """Simulate the failure of the vehicle's computer: the autopilot then hovers."""
        if not self.failed:
            self.failed, self.decision = True, Decision(State.IDLE)
            self._follower.bridge_died(to_nanoseconds(now))

    def send(self, time: int, messages: list[OdometryState]) -> None:
        if not self.failed:
            self.outbox += messages

    def tick(self, tick: Tick) -> None:
        if not self.failed:
            self.decision = tick.decision

    def cycle(self, cycle: ControlCycle) -> None:
        setpoint = cycle.setpoint
        if setpoint.kind != NONE:
            self._setpoint, self._setpoint_time = setpoint._replace(
                acceleration=self._T_odom_world.rotation.T.dot(setpoint.acceleration),
                yaw=None if setpoint.yaw is None else setpoint.yaw - self._turn), self._now
            self.unasked += not self._asked


def _params(scenario: Scenario, guard: bool, law: type[FlockingParams],
            name: str) -> PlannerParams:
    """Return the planner's parameters of a vehicle."""
    params = scenario.flight.planner(guard)
    params = replace(params, law=law(**vars(params.law)))
    if scenario.flock is None:
        return params
    normals = [DIRECTIONS[side] for side in scenario.flock.faces]
    faces = tuple(math.atan2(y, x) for x, y, _ in normals if x or y)
    return replace(params, vehicles={
        other: Member(LEADER if other == scenario.flock.names[0] else FOLLOWER, faces=faces)
        for other in scenario.flock.names if other != name})


def _covariances(errors: VioErrors, time: float) -> tuple[Array, Array]:
    """Return the covariances (6, 6) of pose and twist that an odometry has after a time, s."""
    walks = np.array([errors.position_walk, errors.position_walk, errors.height_walk])
    pose = np.diag([*(errors.position ** 2 + time * walks ** 2),
                    *[errors.tilt ** 2 + errors.tilt_bias ** 2] * 2,
                    errors.attitude ** 2 + time * errors.yaw_walk ** 2])
    return pose, errors.twist_covariance
