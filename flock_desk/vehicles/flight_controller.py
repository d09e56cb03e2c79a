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
One flight controller, as a companion computer uses it: modes, arming, and the flight in each mode.

The measured reactions are in docs/autopilots.md. ``px4`` and ``arducopter`` add their rules for
setpoints, take-off, landing and failsafes. ENU; the time is given.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
import math
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.estimator import Estimator
from flock_desk.vehicles.profiles import HOLD, LAND, Parameters, Profile, SETPOINTS
from flock_desk.vehicles.quadrotor import Quadrotor
from flock_follower.geometry import (
    Array,
    GRAVITY,
    quaternion_from_yaw,
    quaternion_to_matrix,
    wrap_angle,
)
from flock_follower.mavlink.ned import ned_to_enu, yaw_ned_to_enu

POSITION_GAIN: Final[Array] = np.array([0.95, 0.95, 1.0])
VELOCITY_GAIN: Final[Array] = np.array([1.8, 1.8, 4.0])
_HOLD_SPEED_MAX: Final[float] = 2.0  # m/s
_CAPTURE_SPEED: Final[float] = 0.2  # m/s; holding brakes to this, then keeps the place
#: Vision older than this, s, keeps ArduCopter from arming.
_VISION_HEALTHY: Final[float] = 0.3
_AIDED: Final[float] = 0.55  # s without vision until PX4 compares its estimate with none
ARRIVED: Final[float] = 0.1  # m below the take-off altitude
#: The acceleration, m/s^2, for which motors idle.
IDLE_ACCELERATION: Final[Array] = np.array([0.0, 0.0, -GRAVITY])
ACCEPTED: Final[int] = mavlink.MAV_RESULT_ACCEPTED
#: Bits of a type mask for position, velocity, acceleration and force.
_QUANTITY_BITS = 0x3FF
#: Those of them that ignore all but the acceleration.
_IGNORED_BITS = 0x03F
#: ArduCopter's text for a condition that is not met.
_REASONS: Final = {'permission': '{denial}', 'vision': 'VisOdom: not healthy',
                   'armable': '{mode} mode not armable', 'position': 'Need Position Estimate'}


class FlownSetpoint(NamedTuple):
    """An acceleration (3,), m/s^2, ENU, and a yaw, rad, NaN if none is given."""

    acceleration: Array
    yaw: float


def decode_setpoint(message: Any) -> FlownSetpoint | None:
    """
    Return the acceleration in a SET_POSITION_TARGET_LOCAL_NED; None for any other setpoint.

    Setpoints of position, velocity and yaw rate, which the bridge never sends, are not simulated.
    """
    mask = message.type_mask
    if (message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED
            or mask & _QUANTITY_BITS != _IGNORED_BITS):
        return None
    yaw = not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE and math.isfinite(message.yaw)
    return FlownSetpoint(ned_to_enu([message.afx, message.afy, message.afz]),
                         yaw_ned_to_enu(message.yaw) if yaw else math.nan)


class FlightController(ABC):
    """
    One vehicle's flight controller.

    :param armed: whether it starts armed; airborne vehicles must.
    :param arming_denial: if given, arming is refused with this reason.
    :param ready_at: time, s, before which there is no estimate.
    """

    PROFILE: ClassVar[Profile]

    def __init__(self, vehicle: Quadrotor, now: float, *, armed: bool, parameters: Parameters,
                 arming_denial: str = '', ready_at: float = 0.0) -> None:
        self.vehicle, self.parameters, self.armed = vehicle, parameters, armed
        self._arming_denial = arming_denial
        airborne = not bool(vehicle.landed)
        self.mode = self.chosen = self.PROFILE.starts[airborne]
        """The mode that is flown, and the one last requested: a failsafe may fly another."""
        self.in_failsafe, self.on_ground = False, not airborne
        """Whether a failsafe flies it; whether it counts itself as landed."""
        self.texts: list[str] = []
        """Texts for STATUSTEXT; the owner empties it."""
        self.wind: Array = np.zeros(3)
        """Velocity of the air (3,), m/s, ENU."""
        height, vision = self.PROFILE.vision_height
        self.estimator = Estimator(vehicle, self.PROFILE, all(
            parameters[name] == value for name, value in self.PROFILE.vision.items()),
            parameters[height] == vision, now, ready_at)
        self.has_origin = not self.estimator.uses_vision
        """Whether it has a global origin: by GPS, or by SET_GPS_GLOBAL_ORIGIN."""
        self.home: Array = vehicle.position * [1.0, 1.0, 0.0]
        """Where it was armed (3,), m, in the frame of the estimate."""
        self._time = self._landed_since = now
        self._yaw: float = vehicle.yaw
        self._place: Array | None = vehicle.position.copy()
        self._flown = airborne
        self._climb_limit = math.inf  # m/s
        self._setpoint, self._setpoint_time = FlownSetpoint(np.zeros(3), math.nan), -math.inf

    @property
    def system_status(self) -> int:
        """Return the MAV_STATE of HEARTBEAT."""
        if self.in_failsafe:
            return int(mavlink.MAV_STATE_CRITICAL)
        px4 = self.PROFILE.px4
        if self.armed if px4 else self._flown:  # ArduCopter is active in the air only
            return int(mavlink.MAV_STATE_ACTIVE)
        unfit = px4 and self.missing(self.mode, self._time, self.PROFILE.arming)
        return int(mavlink.MAV_STATE_UNINIT if unfit else mavlink.MAV_STATE_STANDBY)

    @property
    def landed_state(self) -> int:
        """Return the MAV_LANDED_STATE."""
        if self.on_ground:
            return int(mavlink.MAV_LANDED_STATE_ON_GROUND)
        if self.PROFILE.modes[self.mode].flies == LAND:
            return int(mavlink.MAV_LANDED_STATE_LANDING)
        return int(mavlink.MAV_LANDED_STATE_TAKEOFF if self.taking_off
                   else mavlink.MAV_LANDED_STATE_IN_AIR)

    @property
    def taking_off(self) -> bool:
        """Return whether it climbs to the altitude of its take-off."""
        return bool(self.mode == self.PROFILE.takeoff and self._place is not None
                    and self.estimator.position[2] < self._place[2] - ARRIVED)

    @abstractmethod
    def on_setpoint(self, message: Any, now: float) -> None:
        """Take a SET_POSITION_TARGET_LOCAL_NED."""

    @abstractmethod
    def take_off(self, altitude: float, now: float) -> int:
        """Obey MAV_CMD_NAV_TAKEOFF with its param7; return the MAV_RESULT."""

    @abstractmethod
    def _supervise(self, now: float) -> None:
        """Change the mode if a failsafe does."""

    def _fly_setpoints(self, now: float, dt: float) -> Array:
        """Return the acceleration (3,), m/s^2, of the mode that obeys setpoints."""
        return self._setpoint.acceleration

    @abstractmethod
    def _detect_ground(self, wanted: Array, dt: float) -> None:
        """Update ``on_ground`` after a step with a nominal acceleration (3,), m/s^2."""

    @property
    @abstractmethod
    def _disarms_after(self) -> float:
        """Return the time on the ground after which it disarms, s."""

    def position_known(self, now: float) -> bool:
        """Return whether there is an estimate, with recent vision if it needs vision."""
        timeout = self.PROFILE.position_timeout + 1e-6 * self.parameters.get('EKF2_NOAID_TOUT', 0)
        return now >= self.estimator.ready_at and self.estimator.vision_age(now) <= timeout

    def conditions(self, now: float) -> dict[str, bool]:
        """Return which conditions of modes, arming and reports are met."""
        known, age = self.position_known(now), self.estimator.vision_age(now)
        reported, aided = (now >= self.estimator.ready_at and age <= t
                           for t in (self.PROFILE.reports_for, _AIDED))
        return {'permission': self.armed or not self._arming_denial,
                'vision': age <= _VISION_HEALTHY,
                'armable': self.armed or self.PROFILE.modes[self.mode].arms,
                'position': known, 'global': known and self.has_origin,
                'always': True, 'reported': reported, 'unreported': not reported,
                'aided': aided, 'absolute': aided and self.has_origin,
                'at rest': self.on_ground}

    def missing(self, mode: str, now: float, arming: tuple[str, ...] = ()) -> list[str]:
        """Return the conditions, those in ``arming`` and those of a mode, that are not met."""
        met = self.conditions(now)
        return [name for name in (*arming, *self.PROFILE.modes[mode].needs) if not met[name]]

    def check_arming(self, now: float, title: str = 'PreArm') -> list[str]:
        """Return the conditions that prevent arming; ArduCopter reports the first."""
        missing = self.missing(self.mode, now, self.PROFILE.arming)
        if missing and not self.PROFILE.px4:
            reason = _REASONS[missing[0]].format(denial=self._arming_denial, mode=self.mode)
            self.texts.append(f'{title}: {reason}')
        return missing

    def command_mode(self, params: tuple[float, ...], now: float) -> list[int]:
        """Obey MAV_CMD_DO_SET_MODE; return the MAV_RESULT of each COMMAND_ACK."""
        px4 = self.PROFILE.px4
        base, main, sub = (int(p) if math.isfinite(p) else 0 for p in params)
        number = main << 16 | sub << 24 if px4 else main
        name = next((n for n, mode in self.PROFILE.modes.items() if mode.number == number), '')
        if not base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            result = int(mavlink.MAV_RESULT_UNSUPPORTED if px4 else mavlink.MAV_RESULT_DENIED)
        else:
            result = self.change_mode(name, now) if name else self.PROFILE.refused
        # The first of PX4 is always ACCEPTED.
        return [ACCEPTED, result] if px4 else [result]

    def change_mode(self, name: str, now: float) -> int:
        """Change the mode, disarmed to any, armed to one that can be flown; return MAV_RESULT."""
        if self.armed and self.missing(name, now):
            if not self.PROFILE.px4:
                self.texts.append(f'Mode change to {name} failed: requires position')
            return self.PROFILE.refused
        self._choose(name, now)
        return ACCEPTED

    def arm(self, value: bool, now: float) -> int:
        """Arm if the checks pass; disarm on the ground; return the MAV_RESULT."""
        if value == self.armed:
            return ACCEPTED
        if self.check_arming(now, 'Arm') if value else not self.on_ground:
            return self.PROFILE.refused
        self._landed_since = now
        if value:
            self.armed = True
        else:
            self._disarm(now)
        return ACCEPTED

    def pilot_switches(self, name: str) -> None:
        """Change the mode as the pilot's remote control does. No check prevents it."""
        self._enter(name)
        self.in_failsafe = False

    def step(self, now: float) -> None:
        """Fly on to ``now``, s, not before the time of the last step."""
        dt = now - self._time
        if dt <= 0.0:
            return
        self._time = now
        self.estimator.step(now, dt)
        if not self.armed and self.position_known(now):
            self.home = self.estimator.position
        self._supervise(now)
        wanted = self._control(now, dt)
        self._detect_ground(wanted, dt)
        # From the frame of the estimate to the true one.
        error = self.estimator.yaw_error
        self.vehicle.steer(quaternion_to_matrix(quaternion_from_yaw(-error)) @ wanted,
                           wrap_angle(self._yaw - error))
        self.vehicle.step(dt, powered=self.armed, wind=self.wind)
        self._flown = self.armed and (self._flown or not self.vehicle.landed)
        # PX4 counts from the report of its land detector on.
        if not (self.armed and self.vehicle.landed and (self.on_ground or not self.PROFILE.px4)):
            self._landed_since = now
        elif 0.0 < self._disarms_after <= now - self._landed_since:
            self._flown = self.in_failsafe = False
            self._disarm(now)

    def _choose(self, name: str, now: float) -> None:
        """Change the mode by a request on the link."""
        if name != self.mode:
            self._enter(name)

    def _disarm(self, now: float) -> None:
        self.armed = False

    def _enter(self, name: str) -> None:
        self.mode = name
        self._place = None
        self._yaw = self.estimator.yaw

    @property
    def _flies(self) -> str:
        return self.PROFILE.modes[self.mode].flies

    def _control(self, now: float, dt: float) -> Array:
        """Return the nominal acceleration (3,), m/s^2, in the frame of the estimate."""
        flies, (parameter, unit) = self._flies, self.PROFILE.landing_speed
        if flies == SETPOINTS:
            if math.isfinite(self._setpoint.yaw):
                self._yaw = self._setpoint.yaw
            return self._fly_setpoints(now, dt)
        if flies == HOLD:
            return self._hold()
        descent = -self.parameters[parameter] * unit if flies == LAND else 0.0
        wanted = self._track(np.array([0.0, 0.0, descent]))
        if flies != LAND or not self.position_known(now):
            wanted[:2] = 0.0  # level; without a position it lands so, too
        return wanted

    def _hold(self) -> Array:
        """Return the acceleration that stops, and keeps the place."""
        estimate = self.estimator
        if self._place is None and np.linalg.norm(estimate.velocity) < _CAPTURE_SPEED:
            self._place = estimate.position.copy()
        towards = np.zeros(3) if self._place is None else (
            POSITION_GAIN * (self._place - estimate.position))
        return self._track(np.clip(towards, -_HOLD_SPEED_MAX, _HOLD_SPEED_MAX))

    def _track(self, velocity: Array) -> Array:
        """Return the acceleration that leads to a velocity (3,), m/s."""
        velocity[2] = min(velocity[2], self._climb_limit)
        wanted: Array = VELOCITY_GAIN * (velocity - self.estimator.velocity)
        return wanted
