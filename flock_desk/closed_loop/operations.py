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
Operator and pilot of one simulated follower, and an autopilot of few modes that obeys them.

The operator arms, takes off, calls offboard and engage; the pilot takes over and gives back by
the mode switch; the bridge may die and start again. The autopilot flies take-off, hold and the
pilot's climb by itself, and setpoints in its offboard mode, with the waits and timeouts measured
on PX4 1.16 and ArduCopter 4.7. MAVLink itself is the embedded autopilots' (``vehicles``).
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Final

import numpy as np

from flock_desk.closed_loop.world import GATE_STEPS
from flock_desk.scenarios.courses import STEP
from flock_desk.scenarios.scenario import ENGAGED, Operation, Scenario
from flock_follower.follower import Follower
from flock_follower.geometry import Array
from flock_follower.mavlink.dialects import DIALECTS, VehicleStatus
from flock_follower.mavlink.gate import Gate
from flock_follower.mavlink.setpoint_rules import NONE, Setpoint
from flock_follower.messages import to_nanoseconds

#: The pilot's mode, by the autopilot.
MANUAL: Final = {'px4': 'POSCTL', 'ardupilot': 'ALT_HOLD'}
#: s between HEARTBEATs: PX4 refuses to send more than one per second.
HEARTBEAT_PERIOD: Final = {'px4': 1.0, 'ardupilot': 0.2}
SETPOINT_TIMEOUT: Final = 0.5  # s: COM_OF_LOSS_T and GUID_TIMEOUT as recommended
CLIMB_SPEED: Final = 1.0  # m/s, of the take-off and of the pilot
UP: Final = np.array([0.0, 0.0, 1.0])
STIFFNESS, DAMPING = 1.5, 2.2  # 1/s^2 and 1/s, of the autopilot's own position control


class OperatedVehicle:
    """
    One run's operator, pilot and autopilot.

    :param autopilot: a key of ``dialects.DIALECTS``.
    :param follower: receives HEARTBEATs and requests.
    :param new_control: makes what a bridge that starts has.
    :param start: where the vehicle begins (3,), m.
    """

    def __init__(self, scenario: Scenario, autopilot: str, follower: Follower,
                 new_control: Callable[[], Gate], start: Array) -> None:
        self._dialect = DIALECTS[autopilot]
        self._autopilot = autopilot
        self._follower, self._new_control = follower, new_control
        on_ground = scenario.takes_off
        usual = Operation('offboard', 0.0), Operation('engage', ENGAGED - GATE_STEPS * STEP)
        self._waiting = sorted(scenario.operations or usual, key=lambda o: o.at)
        self.mode = self._dialect.hold if on_ground else self._dialect.offboard
        self.armed = not on_ground
        self._status: VehicleStatus | None = None
        self._goal = start
        self._yaw: float | None = None
        self._taking_off = False
        self._mode_asked = math.inf
        self._restart = math.inf
        self._beat = -math.inf
        self._setpoint: Setpoint | None = None
        self._setpoint_time = -math.inf
        self.asked = False
        """Whether offboard was called, by the operations and HEARTBEATs so far."""
        self.unasked = 0
        """Number of setpoints sent while offboard was not requested."""
        self.obeying_since: float | None = None
        """Since when the vehicle flies setpoints, s; None while it does not."""

    def send(self, setpoint: Setpoint, now: float) -> None:
        """Take what the follower sends."""
        if setpoint.kind != NONE:
            self._setpoint, self._setpoint_time = setpoint, now
            self.unasked += not self.asked

    def step(self, now: float, position: Array, velocity: Array,
             yaw: float) -> tuple[Array, float | None]:
        """Let everything happen that is due, and return the acceleration and yaw to fly."""
        while self._waiting and self._waiting[0].at <= now + 1e-9:
            self._do(self._waiting.pop(0), now, position, yaw)
        if now >= self._restart:
            self._restart = math.inf
            self._follower.bridge_started(to_nanoseconds(now), self._new_control())
        if now >= self._mode_asked:
            self._mode_asked = math.inf
            self._enter(self._dialect.offboard, position)
        on_ground = self._taking_off or bool(position[2] < 0.05)
        if self._taking_off and position[2] > self._goal[2] - 0.2:
            self._taking_off = False
            self._enter(self._dialect.takeoff_modes[-1], np.array([*position[:2], self._goal[2]]))
        self._report_status(now, on_ground)
        return self._fly(now, position, velocity)

    def _do(self, operation: Operation, now: float, position: Array, yaw: float) -> None:
        follower, time = self._follower, to_nanoseconds(now)
        self._yaw = yaw
        match operation.what:
            case 'arm':
                self.armed = True
            case 'takeoff':
                self._taking_off = True
                self._enter(self._dialect.takeoff_modes[0],
                            position + operation.height * UP)
            case 'offboard':
                self.asked = True
                follower.permit(time, now - 1e-3)
                # The bridge has to stream first, and to receive the mode by HEARTBEAT.
                self._mode_asked = now + self._dialect.stream_before_offboard
            case 'engage':
                follower.engage(time, True)
            case 'pilot':
                self._enter(MANUAL[self._autopilot], position + operation.height * UP)
            case 'restart':
                self.asked = False
                follower.bridge_died(time)
                self._restart = now + operation.duration

    def _enter(self, mode: str, goal: Array) -> None:
        self.mode, self._goal = mode, goal

    def _report_status(self, now: float, on_ground: bool) -> None:
        if now - self._beat < HEARTBEAT_PERIOD[self._autopilot] - 1e-9:
            return
        self._beat = now
        obeyed = self._status is not None and self._status.offboard
        self._status = VehicleStatus(self.armed, self.mode, 'active',
                                     self.mode == self._dialect.offboard)
        if obeyed and not self._status.offboard:
            self.asked = False
        self._follower.vehicle(to_nanoseconds(now), self._status, not on_ground)

    def _fly(self, now: float, position: Array,
             velocity: Array) -> tuple[Array, float | None]:
        silent = now - self._setpoint_time > SETPOINT_TIMEOUT
        offboard = self.mode == self._dialect.offboard and not self._taking_off
        if offboard and not silent and self._setpoint is not None:
            if self.obeying_since is None:
                self.obeying_since = now
            self._goal = position.copy()
            return self._setpoint.acceleration, self._setpoint.yaw
        if offboard and self.obeying_since is not None and self._autopilot == 'px4':
            self.mode = self._dialect.hold  # COM_OBL_RC_ACT 5
        self.obeying_since = None
        if not self.armed:
            return np.zeros(3), None
        wanted = np.clip(STIFFNESS * (self._goal - position), -DAMPING * CLIMB_SPEED,
                         DAMPING * CLIMB_SPEED) - DAMPING * velocity
        return wanted, self._yaw
