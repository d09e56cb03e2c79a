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
What the flight controllers of PX4 and ArduCopter have in common; each has a module of its own.

A personality decides which setpoints it takes, which modes it has, when it arms and what it says.
ENU throughout; the time is given.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
import math
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.autopilot_parameters import AutopilotParameters
from flock_desk.vehicles.estimator import Estimator, VisionSample
from flock_desk.vehicles.vehicle import GRAVITY, Quadrotor
from flock_follower.geometry import (
    Array,
    frd_to_flu,
    ned_to_enu,
    normalize_quaternion,
    quaternion_ned_frd_to_enu_flu,
    quaternion_to_matrix,
    wrap_angle,
    yaw_from_quaternion,
)

# PX4's MPC_XY_P, MPC_Z_P and MPC_XY_VEL_P_ACC, MPC_Z_VEL_P_ACC; ArduCopter's are close to them.
POSITION_GAIN: Final[Array] = np.array([0.95, 0.95, 1.0])
VELOCITY_GAIN: Final[Array] = np.array([1.8, 1.8, 4.0])
_HOLD_SPEED_MAX: Final[float] = 2.0  # m/s
_CAPTURE_SPEED: Final[float] = 0.2  # m/s; holding brakes to this, then keeps the place
_ARRIVED: Final[float] = 0.3  # m
_FUTURE: Final[float] = 0.1  # s
#: The acceleration, m/s^2, for which motors idle.
IDLE: Final[Array] = np.array([0.0, 0.0, -GRAVITY])
_NOWHERE: Final[Array] = np.full(3, math.nan)
#: The magic number of param2 that forces arming and disarming.
FORCE: Final[int] = 21196
ACCEPTED: Final[int] = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED: Final[int] = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: Final[int] = mavlink.MAV_RESULT_DENIED
UNSUPPORTED: Final[int] = mavlink.MAV_RESULT_UNSUPPORTED
FAILED: Final[int] = mavlink.MAV_RESULT_FAILED


class TrackedSetpoint(NamedTuple):
    """A setpoint, ENU; NaN where an axis is not given."""

    position: Array = _NOWHERE
    velocity: Array = _NOWHERE
    acceleration: Array = _NOWHERE
    yaw: float = math.nan
    yaw_rate: float = math.nan


class StatusText(NamedTuple):
    """Something the vehicle says."""

    severity: int
    text: str


class Event(NamedTuple):
    """What PX4 says beside: a name, a level (8: not for people), and the bytes of arguments."""

    name: str
    level: int
    arguments: bytes = b''


class FlightController(ABC):
    """
    Modes, arming and control of one vehicle.

    :param armed: whether it starts armed; airborne vehicles must.
    :param parameters: the autopilot's; what they say of GPS and vision counts from the start.
    :param arming_denial: where given, arming is refused with this reason.
    :param ready_after: s from ``now`` until the estimator is ready.
    """

    #: MAV_AUTOPILOT.
    AUTOPILOT: ClassVar[int]
    #: custom_mode by the name of the mode.
    MODES: ClassVar[Mapping[str, int]]
    #: The modes in which the pilot flies from place to place.
    PLACE_MODES: ClassVar[tuple[str, ...]]
    #: How often it asks for our time by TIMESYNC, Hz.
    TIMESYNC_RATE: ClassVar[float]
    #: Vision older than this, s, by the clock it has learnt, is not used.
    OLDEST_VISION: ClassVar[float] = math.inf
    #: What ends a STATUSTEXT.
    TEXT_END: ClassVar[str] = ''
    #: Whether it sends STATUSTEXT only where the HEARTBEAT of a ground station is heard.
    TALKS_TO_GCS_ONLY: ClassVar[bool] = False
    #: The MAV_RESULT of MAV_CMD_SET_MESSAGE_INTERVAL for a message that it does not send.
    UNKNOWN_MESSAGE: ClassVar[int] = DENIED
    #: Acceleration (3,), m/s^2, by which its estimate drifts without vision.
    DRIFT: ClassVar[Array]

    def __init__(self, vehicle: Quadrotor, now: float, *, armed: bool,
                 parameters: AutopilotParameters, mode: str, arming_denial: str = '',
                 ready_after: float = 0.0) -> None:
        self.vehicle = vehicle
        self.parameters = parameters
        self.armed = armed
        self.mode = mode
        self.in_failsafe = False
        self.said: list[StatusText] = []
        self.events: list[Event] = []
        self.gcs_heard = False
        """Whether the HEARTBEAT of a ground station comes."""
        self.wind: Array = np.zeros(3)
        """Velocity of the air (3,), m/s, ENU."""
        self.estimator = Estimator(vehicle, uses_vision=self._uses_vision(),
                                   ready_at=now + ready_after, drift=self.DRIFT)
        self._origin_set = False
        self._arming_denial = arming_denial
        self._time = now
        self._yaw = vehicle.yaw
        self._place: Array | None = vehicle.position.copy()
        self.home: Array = vehicle.position * [1.0, 1.0, 0.0]
        """Where it was armed (3,), m, in the frame of the estimate."""
        self._over_home = False
        self._flown = not vehicle.landed
        self._landed_since = now
        self._climb_limit = math.inf
        """The largest climb rate, m/s, for position and velocity setpoints."""

    # What MAVLink asks for.

    @property
    def custom_mode(self) -> int:
        """Return the custom_mode of HEARTBEAT."""
        return self.MODES[self.mode]

    @property
    def intended_mode(self) -> int:
        """Return the custom_mode that somebody chose; a failsafe may fly another."""
        return self.custom_mode

    @property
    def has_origin(self) -> bool:
        """Return whether it knows where on Earth it is: by GPS, or as it was told."""
        return self._origin_set or not self.estimator.uses_vision

    @property
    @abstractmethod
    def base_mode(self) -> int:
        """Return the base_mode of HEARTBEAT."""

    @property
    @abstractmethod
    def system_status(self) -> int:
        """Return the MAV_STATE of HEARTBEAT."""

    @property
    @abstractmethod
    def landed_state(self) -> int:
        """Return the MAV_LANDED_STATE."""

    @abstractmethod
    def on_setpoint(self, message: Any, now: float) -> None:
        """Take a SET_POSITION_TARGET_LOCAL_NED."""

    @abstractmethod
    def command_mode(self, params: tuple[float, ...], now: float) -> list[int]:
        """Obey MAV_CMD_DO_SET_MODE; return the MAV_RESULT of each COMMAND_ACK."""

    @abstractmethod
    def change_mode(self, name: str, now: float) -> int:
        """Change the mode for somebody on the link; return the MAV_RESULT."""

    @abstractmethod
    def arm(self, value: bool, force: bool, now: float) -> int:
        """Arm or disarm; return the MAV_RESULT."""

    @abstractmethod
    def take_off(self, altitude: float, now: float) -> int:
        """Obey MAV_CMD_NAV_TAKEOFF with its param7; return the MAV_RESULT."""

    @abstractmethod
    def takes_odometry(self, message: Any) -> bool:
        """Return whether an ODOMETRY has the frames and covariances this autopilot wants."""

    @abstractmethod
    def position_known(self, now: float) -> bool:
        """Return whether the estimate of the position is valid."""

    @abstractmethod
    def tells_position(self, now: float) -> bool:
        """Return whether it sends LOCAL_POSITION_NED."""

    @abstractmethod
    def estimator_flags(self, now: float) -> int:
        """Return the flags of ESTIMATOR_STATUS, or of ArduPilot's EKF_STATUS_REPORT."""

    @abstractmethod
    def fit(self, now: float) -> bool:
        """Return whether it would arm."""

    @abstractmethod
    def run_checks(self, now: float) -> int:
        """Obey MAV_CMD_RUN_PREARM_CHECKS: say what is not well; return the MAV_RESULT."""

    def set_origin(self) -> None:
        """Take SET_GPS_GLOBAL_ORIGIN; where on Earth it is said to be does not matter here."""
        self._origin_set = True

    @abstractmethod
    def _uses_vision(self) -> bool:
        """Return whether the parameters make the estimate rest on vision."""

    @abstractmethod
    def _control(self, now: float, dt: float) -> Array:
        """Return the wanted acceleration (3,), m/s^2, in the frame of the estimate."""

    def on_odometry(self, message: Any, now: float, age: float = 0.0) -> bool:
        """Take an ODOMETRY of an age, s; return whether it is used."""
        if not self.takes_odometry(message) or not -_FUTURE <= age <= self.OLDEST_VISION:
            return False
        w, x, y, z = message.q
        numbers = [message.x, message.y, message.z, message.vx, message.vy, message.vz]
        try:
            attitude = quaternion_ned_frd_to_enu_flu(normalize_quaternion([x, y, z, w]))
        except ValueError:
            return False
        if not all(math.isfinite(number) for number in numbers):
            return False
        velocity = quaternion_to_matrix(attitude) @ frd_to_flu(numbers[3:])
        return self.estimator.on_vision(VisionSample(
            ned_to_enu(numbers[:3]), velocity, yaw_from_quaternion(attitude),
            message.reset_counter), now)

    @classmethod
    def check_pilot(cls, name: str, climb: float = 0.0) -> None:
        """Raise ValueError for an unknown mode, or a climb, m, in one that keeps no place."""
        valid = cls.PLACE_MODES if climb else tuple(cls.MODES)
        if name not in valid:
            why = f', where climb = {climb:g}' if climb else ''
            raise ValueError(f'mode = {name!r}: must be one of {", ".join(valid)}{why}')

    def pilot_switches(self, name: str, climb: float = 0.0) -> None:
        """
        Change the mode by remote control, which no check holds up.

        :param climb: how far the pilot then climbs, m, from where the vehicle is.
        :raises ValueError: see :meth:`check_pilot`.
        """
        self.check_pilot(name, climb)
        self._enter(name)
        self.in_failsafe = False
        if climb:
            self._place = self.estimator.position + np.array([0.0, 0.0, climb])

    def step(self, now: float) -> None:
        """Fly on to ``now``, s, not before the time of the last step."""
        dt = now - self._time
        if dt <= 0.0:
            return
        self._time = now
        self.estimator.step(now, dt)
        if not self.armed and self.position_known(now):
            self.home = self.estimator.position
        acceleration = self.estimator.to_true_frame(self._control(now, dt))
        self.vehicle.step(acceleration, wrap_angle(self._yaw - self.estimator.yaw_error), dt,
                          powered=self.armed, wind=self.wind)
        self._flown = self.armed and (self._flown or not self.vehicle.landed)
        self._watch_ground(now)

    # What the personalities share.

    @abstractmethod
    def _watch_ground(self, now: float) -> None:
        """Notice landings, and disarm after them."""

    def _enter(self, name: str) -> None:
        self.mode = name
        self._place = None
        self._over_home = False
        self._yaw = self.estimator.yaw

    def _hold(self) -> Array:
        """Return the acceleration that stops, and keeps the place."""
        estimate = self.estimator
        if self._place is None and np.linalg.norm(estimate.velocity) < _CAPTURE_SPEED:
            self._place = estimate.position.copy()
        if self._place is None:
            return self._track(TrackedSetpoint(velocity=np.zeros(3)))
        return self._track(TrackedSetpoint(position=self._place))

    def _level(self, climb: float = 0.0) -> Array:
        """Return the acceleration of a level attitude with a vertical speed, m/s."""
        return self._track(TrackedSetpoint(velocity=np.array([math.nan, math.nan, climb]),
                                           acceleration=np.array([0.0, 0.0, math.nan])))

    def _descend(self, speed: float) -> Array:
        """Return the acceleration of a descent at a speed, m/s, over the same place."""
        return self._track(TrackedSetpoint(velocity=np.array([0.0, 0.0, -speed])))

    def _return(self, altitude: float, landing_speed: float) -> Array:
        """Return the acceleration of climbing to an altitude, m, flying home, then landing."""
        position = self.estimator.position
        if self._over_home:
            return self._descend(landing_speed)
        if self._place is None:
            self._place = np.array([*position[:2], max(altitude, position[2])])
        if position[2] < self._place[2] - 2.0 * _ARRIVED:
            return self._track(TrackedSetpoint(position=self._place))
        above_home = np.array([*self.home[:2], self._place[2]])
        if np.linalg.norm(above_home - position) < 2.0 * _ARRIVED:
            self._over_home = True
        return self._track(TrackedSetpoint(position=above_home))

    def _track(self, setpoint: TrackedSetpoint) -> Array:
        """Return the acceleration of PX4's cascade: position, velocity and acceleration add."""
        estimate = self.estimator
        towards = POSITION_GAIN * (setpoint.position - estimate.position)
        velocity = _sum(np.clip(towards, -_HOLD_SPEED_MAX, _HOLD_SPEED_MAX), setpoint.velocity)
        velocity[2] = np.minimum(velocity[2], self._climb_limit)  # NaN stays
        return _sum(VELOCITY_GAIN * (velocity - estimate.velocity), setpoint.acceleration)

    def _follow_yaw(self, setpoint: TrackedSetpoint, dt: float) -> None:
        if math.isfinite(setpoint.yaw):
            self._yaw = setpoint.yaw
        elif math.isfinite(setpoint.yaw_rate):
            self._yaw = wrap_angle(self._yaw + setpoint.yaw_rate * dt)

    def say(self, severity: int, text: str) -> None:
        """Say something, with its MAV_SEVERITY."""
        self.said.append(StatusText(severity, text))


def _sum(a: Array, b: Array) -> Array:
    """Return a + b, where NaN counts as absent and both absent as NaN."""
    return np.where(np.isnan(a), b, np.where(np.isnan(b), a, a + b))
