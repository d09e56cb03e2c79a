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
PX4's take-off states and its land detector.

Facts from the source of PX4 1.16 (mc_pos_control, land_detector). After arming the motors spin up,
then idle until a setpoint asks upwards; that may be any upward acceleration, however small. From
then on setpoints are flown; a ramp limits the climb rate of position and velocity setpoints, and
leaves acceleration setpoints alone. The land detector looks at the thrust: it reports the take-off
at once, and a landing only while a downward velocity is commanded. Acceleration setpoints command
none, so that a vehicle that they push onto the ground stays in the air for PX4.
"""

from __future__ import annotations

import math
from typing import Final

from flock_desk.vehicles.vehicle import GRAVITY

DISARMED: Final[str] = 'disarmed'
SPOOLUP: Final[str] = 'spoolup'
READY: Final[str] = 'ready_for_takeoff'
RAMPUP: Final[str] = 'rampup'
FLIGHT: Final[str] = 'flight'
#: The downward velocity, m/s, that counts as a commanded descent: 1.1 LNDMC_Z_VEL_MAX.
DESCENT: Final[float] = 0.275
_CLIMB_MAX: Final[float] = 3.0  # m/s, MPC_Z_VEL_MAX_UP
#: The ramp of the climb rate, m/s, begins where MPC_Z_VEL_P_ACC (4) asks for no thrust.
_RAMP_START: Final[float] = -GRAVITY / 4.0
_LIFTING: Final[float] = 0.3 * GRAVITY  # m/s^2; more is no landed vehicle's thrust
_LANDING_TIME: Final[float] = 1.0  # s, LNDMC_TRIG_TIME


class Takeoff:
    """
    The take-off state.

    :param flying: whether it begins in flight; else disarmed.
    """

    def __init__(self, *, flying: bool) -> None:
        self.state = FLIGHT if flying else DISARMED
        self._armed_for = 0.0
        self._progress = 0.0

    @property
    def left(self) -> bool:
        """Return whether setpoints are flown; else the motors idle."""
        return self.state in (RAMPUP, FLIGHT)

    @property
    def climb_limit(self) -> float:
        """Return the largest climb rate, m/s, for position and velocity setpoints."""
        if self.state == FLIGHT:
            return _CLIMB_MAX
        share = self._progress if self.state == RAMPUP else 0.0
        return _RAMP_START + share * (_CLIMB_MAX - _RAMP_START)

    def step(self, armed: bool, landed: bool, wants: bool, dt: float, *, spool_up: float,
             ramp: float) -> None:
        """
        Move on by ``dt``, s.

        :param landed: whether the land detector says so.
        :param wants: whether a setpoint asks upwards.
        :param spool_up: COM_SPOOLUP_TIME, s.
        :param ramp: MPC_TKO_RAMP_T, s.
        """
        if not armed:
            self.state, self._armed_for = DISARMED, 0.0
            return
        self._armed_for += dt
        if self.state == DISARMED:
            self.state = SPOOLUP
        if self.state == SPOOLUP and self._armed_for >= spool_up:
            self.state = READY
        if self.state == READY and wants:
            self.state, self._progress = RAMPUP, 0.0
        if self.state == RAMPUP:
            self._progress += dt / ramp if ramp > dt else math.inf
            if self._progress >= 1.0:
                self.state = FLIGHT
        elif self.state == FLIGHT and landed:
            self.state = READY


class LandDetector:
    """
    Whether PX4 counts the vehicle as landed.

    :param landed: whether it does at the start.
    """

    def __init__(self, *, landed: bool) -> None:
        self.landed = landed
        self._resting_for = 0.0

    def step(self, *, armed: bool, thrust: float, descends: bool, rests: bool, dt: float) -> None:
        """
        Move on by ``dt``, s.

        :param thrust: the commanded specific thrust, m/s^2.
        :param descends: whether a downward velocity is commanded.
        :param rests: whether the vehicle stands still on something.
        """
        if not armed:
            self.landed = True
        elif self.landed:
            self.landed = thrust <= _LIFTING
        else:
            self._resting_for = self._resting_for + dt if rests and descends else 0.0
            self.landed = self._resting_for >= _LANDING_TIME
        if self.landed:
            self._resting_for = 0.0
