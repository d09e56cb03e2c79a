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
The vehicles of a real-time flight that report their motion: the follower, an external leader.

Times are integer nanoseconds since the flight's start, and s of the scenario (``scenario_run``).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flock_desk.closed_loop.scenario_run import ScenarioRun
from flock_desk.external.external_autopilot import ExternalAutopilot
from flock_desk.external.external_motion import ExternalMotion, Motion, POSE_GAP
from flock_desk.sensors.vio import Odometry
from flock_desk.vehicles.embedded import EmbeddedAutopilot, STEP_TIME
from flock_desk.vehicles.flight_log import FlightLog
from flock_desk.vehicles.px4 import OFFBOARD
from flock_follower.geometry import (
    Array,
    matrix_to_quaternion,
    quaternion_to_matrix,
    yaw_from_quaternion,
)
from flock_follower.geometry.rotation_vectors import matrix_to_rotation_vector

#: The values of config/px4.params that differ from PX4's defaults.
RECOMMENDED: Final = {'COM_OF_LOSS_T': 0.5, 'COM_OBL_RC_ACT': 5, 'COM_RC_OVERRIDE': 3,
                      'COM_LOW_BAT_ACT': 2, 'GF_MAX_HOR_DIST': 100, 'GF_MAX_VER_DIST': 20}


class _Reported:
    """
    A vehicle whose motion is reported step by step.

    :param start_ns: time zero of the flight on the clock of ``motion``.
    :param origin: (3,), m: origin of the frame of ``motion`` in the frame of the flight.
    """

    def __init__(self, motion: ExternalMotion, start_ns: int, origin: Array) -> None:
        self._motion, self._start_ns, self.origin = motion, start_ns, origin

    def at(self, time_ns: int) -> Odometry:
        """Return the true motion at a time of the last 0.3 s, interpolated; no covariances."""
        motion = self._motion.at(self._start_ns + time_ns)
        return Odometry(
            time_ns * 1e-9, self.origin + motion.position, motion.quaternion,
            quaternion_to_matrix(motion.quaternion).T @ motion.velocity, motion.angular)

    def knows(self, time_ns: int) -> bool:
        """Return whether motion was reported shortly before and after a time."""
        return self._motion.knows(self._start_ns + time_ns)


class EmbeddedVehicle(_Reported):
    """
    The vehicle of an embedded PX4, which is stepped before each step here.

    :param now: monotonic time of the start, s, that messages of the autopilot count from.
    :param altitude: m, at which it hovers then.
    :param system_id: its own, of MAVLink.
    """

    def __init__(self, now: float, altitude: float, system_id: int = 1) -> None:
        super().__init__(ExternalMotion(), 0, np.zeros(3))
        self.autopilot = EmbeddedAutopilot(
            'px4', now=now, altitude=altitude, system_id=system_id, parameters=RECOMMENDED)
        self.log = self.autopilot.log
        self._rotation = self.autopilot.vehicle.rotation

    @property
    def offboard(self) -> bool:
        """Return whether its mode is OFFBOARD: it obeys the bridge's setpoints."""
        return self.autopilot.controller.mode == OFFBOARD

    def step(self, time_ns: int) -> Odometry:
        """Return the true motion, without covariances, one step after the last one returned."""
        vehicle, before = self.autopilot.vehicle, self._rotation
        self._rotation = vehicle.rotation
        self._motion.add(Motion(
            time_ns, vehicle.position, vehicle.velocity, matrix_to_quaternion(self._rotation),
            matrix_to_rotation_vector(before.T @ self._rotation) / STEP_TIME))
        return self.at(time_ns)


class ExternalVehicle(_Reported):
    """
    The vehicle of an external autopilot, in the ENU frame of this autopilot.

    :param height: m above the ground, of its first reported place.
    """

    def __init__(self, autopilot: ExternalAutopilot, start_ns: int, height: float) -> None:
        super().__init__(autopilot.motion, start_ns, np.array([0.0, 0.0, height]))
        self._autopilot = autopilot
        self.offboard = False
        """Whether it obeys the bridge's setpoints, by the bridge's state; set by the owner."""
        self.log = FlightLog()
        self._rotation = quaternion_to_matrix(self.at(0).quaternion)

    def step(self, time_ns: int) -> Odometry:
        """Return the reported motion, interpolated."""
        state = self.at(time_ns)
        before, self._rotation = self._rotation, quaternion_to_matrix(state.quaternion)
        self.log.add_state((self._start_ns + time_ns) * 1e-9, state.position,
                           self._rotation @ state.linear, np.full(3, np.nan),
                           yaw_from_quaternion(state.quaternion), self._autopilot.armed,
                           self._autopilot.mode)
        # Not the reported rates: poses arrive unevenly, and the camera sees that.
        return state._replace(
            angular=matrix_to_rotation_vector(before.T @ self._rotation) / STEP_TIME)


FlownVehicle = EmbeddedVehicle | ExternalVehicle


class ExternalLeader(_Reported):
    """A leader that an external autopilot flies; its motion has the follower's ``origin``."""

    def step(self, follower: Odometry, time: float, offboard: bool) -> None:
        """Do nothing: the leader flies by itself."""

    def motion(self, time_ns: int, time: float) -> Odometry | None:
        """Return the reported motion, the newest for a future time; None if poses have stopped."""
        newest, at = self._motion.newest, self._start_ns + time_ns
        if newest is None or at - newest > POSE_GAP:
            return None
        return self.at(time_ns)._replace(time=time)


FlownLeader = ScenarioRun | ExternalLeader
