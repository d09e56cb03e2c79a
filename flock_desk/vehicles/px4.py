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
PX4, as a companion computer uses it: setpoints, take-off, landing, failsafes.

Measured on PX4 1.16, see docs/autopilots.md. PX4 flies the chosen mode as long as it can:
OFFBOARD needs a setpoint within COM_OF_LOSS_T (1 s); Hold needs a global position, that is GPS or
an origin. Otherwise a failsafe flies another mode, until the chosen mode can be flown again:
setpoints alone bring OFFBOARD back. After a landing PX4 returns to the mode before it. No speed
limit applies to acceleration setpoints; a vertical acceleration of 0 leaves the height open. If
external vision stops, PX4 stays in OFFBOARD, and drifts.

After arming the motors spin up, then idle until a setpoint commands a climb: any upward
acceleration, however small. A ramp then limits the climb rate of PX4's modes, but not acceleration
setpoints. The land detector uses the thrust. It reports a take-off at once, but a landing only
while a downward velocity is commanded. Acceleration setpoints command no velocity: if they push
the vehicle onto the ground, PX4 reports that it is still in the air.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from flock_desk.vehicles.estimator import GROUND_AMSL
from flock_desk.vehicles.flight_controller import (
    ACCEPTED,
    decode_setpoint,
    FlightController,
    IDLE_ACCELERATION,
)
from flock_desk.vehicles.profiles import LAND, PX4
from flock_follower.geometry import Array, GRAVITY

OFFBOARD, HOLD_MODE, TAKEOFF, LAND_MODE = 'OFFBOARD', 'AUTO.LOITER', 'AUTO.TAKEOFF', 'AUTO.LAND'
_SETPOINT_MAX_AGE: Final[float] = 1.0  # s; an older one starts no take-off
#: Modes after the loss of the stream, by COM_OBL_RC_ACT: the first possible one.
_LOST_STREAM: Final = {4: (LAND_MODE,), 5: (HOLD_MODE, LAND_MODE)}
_CLIMB_MAX: Final[float] = 3.0  # m/s, MPC_Z_VEL_MAX_UP
_RAMP_START: Final[float] = -GRAVITY / 4.0
_FLYING_THRUST: Final[float] = 0.3 * GRAVITY  # m/s^2; more is no landed vehicle's thrust
_LANDING_TIME: Final[float] = 1.0  # s, LNDMC_TRIG_TIME


class Px4(FlightController):
    """PX4: see the module, and ``FlightController`` for the parameters."""

    PROFILE = PX4

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        if self.estimator.uses_vision and not self.vehicle.landed:
            self.mode = TAKEOFF  # without an origin there is no Hold
        self.chosen = self._after_disarming = self.mode
        self._sticks = False
        self._resting_for = self._armed_for = 0.0
        # Of the take-off ramp: below 0 the motors idle, at 1 it is over.
        self._ramp = -1.0 if self.on_ground else 1.0

    def conditions(self, now: float) -> dict[str, bool]:
        """Return the conditions of all autopilots, a recent setpoint, and a transmitter."""
        return {**super().conditions(now), 'sticks': self._sticks,
                'stream': now - self._setpoint_time <= self.parameters['COM_OF_LOSS_T']}

    def on_setpoint(self, message: Any, now: float) -> None:
        """Take a setpoint in any mode; one that is not finite is dropped."""
        setpoint = decode_setpoint(message)
        if setpoint is not None and np.all(np.isfinite(setpoint.acceleration)):
            self._setpoint, self._setpoint_time = setpoint, now

    def change_mode(self, name: str, now: float) -> int:
        """Change the mode; a change to that of the take-off is a take-off."""
        return self.take_off(math.nan, now) if name == TAKEOFF else super().change_mode(name, now)

    def take_off(self, altitude: float, now: float) -> int:
        """
        Climb to an altitude, m above sea level, then hold; once armed, if it is not.

        NaN, or a lower altitude, becomes MIS_TAKEOFF_ALT above the ground.
        """
        if self.armed and self.missing(TAKEOFF, now):
            return PX4.refused
        self._choose(TAKEOFF, now)
        east, north, up = self.estimator.position
        lowest = max(self.parameters['MIS_TAKEOFF_ALT'], up)
        self._place = np.array([east, north, np.fmax(altitude - GROUND_AMSL, lowest)])
        return ACCEPTED

    def pilot_switches(self, name: str) -> None:
        """Change the mode by remote control; from then on there is a transmitter."""
        super().pilot_switches(name)
        self._sticks = True
        self._remember(name)

    def _remember(self, name: str) -> None:
        self.chosen = name
        if name != LAND_MODE:
            self._after_disarming = name

    def _choose(self, name: str, now: float) -> None:
        self._remember(name)
        if name != self.mode or self.in_failsafe:
            self._enter(name)
        self.in_failsafe = False
        self._supervise(now)

    def _disarm(self, now: float) -> None:
        super()._disarm(now)
        self.chosen = self._after_disarming
        self._supervise(now)

    def _supervise(self, now: float) -> None:
        """Fly the chosen mode if that is possible, else another."""
        met = self.conditions(now)
        names: tuple[str, ...] = (self.chosen,)
        if self.armed and self.chosen == OFFBOARD and not met['stream']:
            names = _LOST_STREAM.get(int(self.parameters['COM_OBL_RC_ACT']), ('POSCTL', 'ALTCTL'))
        elif self.armed:
            names = (self.chosen, 'ALTCTL' if self.chosen == 'POSCTL' else LAND_MODE)
        # Sticks do not count here: a pilot's mode without them descends.
        mode = next((name for name in names if not {'position', 'global'}.intersection(
            self.missing(name, now))), names[-1])
        self.in_failsafe = mode != self.chosen
        if mode != self.mode:
            self._enter(mode)
        if mode == TAKEOFF and self.armed and self._place is not None and (
                not self.taking_off and met['global']):
            place = self._place
            self._choose(HOLD_MODE, now)
            self._place = place

    @property
    def _flies(self) -> str:
        descends = self.in_failsafe and 'sticks' in PX4.modes[self.mode].needs
        return LAND if descends and not self._sticks else super()._flies

    def _control(self, now: float, dt: float) -> Array:
        self._step_takeoff(now, dt)
        self._climb_limit = _RAMP_START + max(self._ramp, 0.0) * (_CLIMB_MAX - _RAMP_START)
        return super()._control(now, dt) if self._ramp >= 0.0 else IDLE_ACCELERATION

    def _step_takeoff(self, now: float, dt: float) -> None:
        self._armed_for = self._armed_for + dt if self.armed else 0.0
        if not self.armed or (self._ramp >= 1.0 and self.on_ground):
            self._ramp = -1.0
        elif 0.0 <= self._ramp < 1.0:
            self._ramp = min(1.0, self._ramp + dt / max(self.parameters['MPC_TKO_RAMP_T'], dt))
        elif self._ramp < 0.0 and self._armed_for >= self.parameters['COM_SPOOLUP_TIME'] and (
                self._demands_climb(now)):
            self._ramp = 0.0

    def _demands_climb(self, now: float) -> bool:
        if self.mode == OFFBOARD:
            recent = now - self._setpoint_time < _SETPOINT_MAX_AGE
            return recent and bool(self._setpoint.acceleration[2] > 0.0)
        return self.taking_off

    def _detect_ground(self, wanted: Array, dt: float) -> None:
        thrust = float(wanted[2]) + GRAVITY
        descends = self._ramp >= 0.0 and self._flies == LAND
        rests = self.vehicle.landed and descends and not self.on_ground
        self._resting_for = self._resting_for + dt if rests else 0.0
        self.on_ground = (not self.armed or (self.on_ground and thrust <= _FLYING_THRUST)
                          or self._resting_for >= _LANDING_TIME)

    @property
    def _disarms_after(self) -> float:
        return self.parameters['COM_DISARM_LAND' if self._flown else 'COM_DISARM_PRFLT']
