"""
Modes, arming and control of an embedded autopilot; PX4 and ArduCopter differ by their profiles.

What no table can say is in ``px4`` and ``arducopter``: setpoints, take-off, landing, failsafes.
ENU throughout; the time is given.
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
from flock_follower.geometry import Array, GRAVITY, ned_to_enu, wrap_angle, yaw_ned_to_enu

POSITION_GAIN: Final[Array] = np.array([0.95, 0.95, 1.0])
VELOCITY_GAIN: Final[Array] = np.array([1.8, 1.8, 4.0])
_HOLD_SPEED_MAX: Final[float] = 2.0  # m/s
_CAPTURE_SPEED: Final[float] = 0.2  # m/s; holding brakes to this, then keeps the place
#: Vision older than this, s, keeps ArduCopter from arming.
_VISION_HEALTHY: Final[float] = 0.3
_AIDED: Final[float] = 0.55  # s without vision until PX4 compares its estimate with none
ARRIVED: Final[float] = 0.1  # m below the take-off altitude
#: The acceleration, m/s^2, for which motors idle.
IDLE: Final[Array] = np.array([0.0, 0.0, -GRAVITY])
_NOWHERE: Final[Array] = np.full(3, math.nan)
ACCEPTED: Final[int] = mavlink.MAV_RESULT_ACCEPTED


class TrackedSetpoint(NamedTuple):
    """A setpoint, ENU; NaN if an axis is not given."""

    position: Array = _NOWHERE
    velocity: Array = _NOWHERE
    acceleration: Array = _NOWHERE
    yaw: float = math.nan
    yaw_rate: float = math.nan


def decode_setpoint(message: Any) -> TrackedSetpoint | None:
    """Return a SET_POSITION_TARGET_LOCAL_NED; None for other frames, and acceleration as force."""
    mask = message.type_mask
    if (message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED
            or mask & mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET):
        return None
    values = [message.x, message.y, message.z, message.vx, message.vy, message.vz,
              message.afx, message.afy, message.afz]
    ned = np.array([math.nan if mask >> i & 1 else v for i, v in enumerate(values)])
    yaw = not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE and math.isfinite(message.yaw)
    rate = not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    position, velocity, acceleration = ned_to_enu(ned.reshape(3, 3))
    return TrackedSetpoint(position, velocity, acceleration,
                           yaw_ned_to_enu(message.yaw) if yaw else math.nan,
                           -message.yaw_rate if rate else math.nan)


class FlightController(ABC):
    """
    One vehicle's flight controller.

    :param armed: whether it starts armed; airborne vehicles must.
    :param arming_denial: where given, arming is refused with this reason.
    :param ready_at: time, s, before which there is no estimate.
    """

    PROFILE: ClassVar[Profile]

    def __init__(self, vehicle: Quadrotor, now: float, *, armed: bool, parameters: Parameters,
                 arming_denial: str = '', ready_at: float = 0.0) -> None:
        self.vehicle, self.parameters, self.armed = vehicle, parameters, armed
        self.arming_denial = arming_denial
        airborne = not bool(vehicle.landed)
        self.mode = self.chosen = self.PROFILE.starts[airborne]
        """The mode that is flown, and the one last requested: a failsafe may fly another."""
        self.in_failsafe = False
        self.outbox: list[Any] = []
        """Messages that it sends by itself."""
        self.wind: Array = np.zeros(3)
        """Velocity of the air (3,), m/s, ENU."""
        self.estimator = Estimator(vehicle, self.PROFILE, all(
            parameters[name] == value for name, value in self.PROFILE.vision.items()),
            now, ready_at)
        self.has_origin = not self.estimator.uses_vision
        """Whether it has a global origin: by GPS, or by SET_GPS_GLOBAL_ORIGIN."""
        self._time = now
        self._yaw = vehicle.yaw
        self._place: Array | None = vehicle.position.copy()
        self.home: Array = vehicle.position * [1.0, 1.0, 0.0]
        """Where it was armed (3,), m, in the frame of the estimate."""
        self._flown = airborne
        self._landed_since = now
        self._climb_limit = math.inf  # m/s, for position and velocity setpoints
        self._setpoint, self._setpoint_time = TrackedSetpoint(), -math.inf

    @property
    def system_status(self) -> int:
        """Return the MAV_STATE of HEARTBEAT."""
        if self.in_failsafe:
            return int(mavlink.MAV_STATE_CRITICAL)
        # PX4 is active from arming on, ArduCopter in the air.
        if self.armed if self.PROFILE.px4 else self._flown:
            return int(mavlink.MAV_STATE_ACTIVE)
        unfit = self.PROFILE.px4 and self.unfit(self._time)
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
    @abstractmethod
    def on_ground(self) -> bool:
        """Return whether it counts itself as landed."""

    @property
    @abstractmethod
    def taking_off(self) -> bool:
        """Return whether it climbs to the altitude of its take-off."""

    @abstractmethod
    def on_setpoint(self, message: Any, now: float) -> None:
        """Take a SET_POSITION_TARGET_LOCAL_NED."""

    @abstractmethod
    def take_off(self, altitude: float, now: float) -> int:
        """Obey MAV_CMD_NAV_TAKEOFF with its param7; return the MAV_RESULT."""

    @abstractmethod
    def _supervise(self, now: float) -> None:
        """Change the mode where a failsafe does."""

    @abstractmethod
    def _fly_setpoints(self, now: float, dt: float) -> Array:
        """Return the acceleration (3,), m/s^2, of the mode that obeys setpoints."""

    @property
    @abstractmethod
    def _disarms_after(self) -> float:
        """Return after how long on the ground it disarms, s."""

    def run_checks(self, now: float) -> int:
        """Obey MAV_CMD_RUN_PREARM_CHECKS; return the MAV_RESULT."""
        return ACCEPTED

    def position_known(self, now: float) -> bool:
        """Return whether there is an estimate, and vision, where it needs it, not long gone."""
        timeout = self.PROFILE.position_timeout + 1e-6 * self.parameters.get('EKF2_NOAID_TOUT', 0)
        return self.estimator.started(now) and self.estimator.vision_age(now) <= timeout

    def conditions(self, now: float) -> dict[str, bool]:
        """Return which conditions of modes, arming and reports are met."""
        known, age = self.position_known(now), self.estimator.vision_age(now)
        started = self.estimator.started(now)
        reported, aided = (started and age <= t for t in (self.PROFILE.reports_for, _AIDED))
        return {'permission': self.armed or not self.arming_denial,
                'vision': age <= _VISION_HEALTHY,
                'armable': self.armed or self.PROFILE.modes[self.mode].arms,
                'position': known, 'global': known and self.has_origin,
                'always': True, 'reported': reported, 'unreported': not reported,
                'aided': aided, 'absolute': aided and self.has_origin,
                'at rest': self.on_ground}

    def missing(self, mode: str, now: float, arming: tuple[str, ...] = ()) -> list[str]:
        """Return the conditions that a mode needs, and more, as far as they are not met."""
        met = self.conditions(now)
        return [name for name in (*arming, *self.PROFILE.modes[mode].needs) if not met[name]]

    def unfit(self, now: float) -> list[str]:
        """Return the conditions that prevent arming."""
        return self.missing(self.mode, now, self.PROFILE.arming)

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
        # The first of PX4 says accepted, whatever becomes of it.
        return [ACCEPTED, result] if px4 else [result]

    def change_mode(self, name: str, now: float) -> int:
        """Change the mode, disarmed to any, armed to one that can be flown; return MAV_RESULT."""
        if self.armed and self.missing(name, now):
            return self.PROFILE.refused
        self._choose(name, now)
        return ACCEPTED

    def arm(self, value: bool, force: bool, now: float) -> int:
        """Arm where the checks pass; disarm on the ground, or forced; return the MAV_RESULT."""
        if value == self.armed:
            return ACCEPTED
        # PX4 checks a companion computer's forced arming all the same.
        if (self.unfit(now) and (self.PROFILE.px4 or not force) if value
                else not self.on_ground and not force):
            return self.PROFILE.refused
        self._landed_since = now
        if value:
            self.armed = True
        else:
            self._disarm(now)
        return ACCEPTED

    def pilot_switches(self, name: str, climb: float = 0.0) -> None:
        """
        Change the mode by remote control, which no check holds up.

        :param climb: how far the pilot then climbs, m, from where the vehicle is.
        """
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
        self._supervise(now)
        acceleration = self.estimator.to_true_frame(self._control(now, dt))
        self.vehicle.step(acceleration, wrap_angle(self._yaw - self.estimator.yaw_error), dt,
                          powered=self.armed, wind=self.wind)
        self._flown = self.armed and (self._flown or not self.vehicle.landed)
        if not (self.armed and self.vehicle.landed and self._rests):
            self._landed_since = now
        elif 0.0 < self._disarms_after <= now - self._landed_since:
            self._flown = self.in_failsafe = False
            self._disarm(now)

    @property
    def _rests(self) -> bool:
        """Return whether the time until it disarms passes, on the ground."""
        return True

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

    def _control(self, now: float, dt: float) -> Array:
        """Return the wanted acceleration (3,), m/s^2, in the frame of the estimate."""
        flies, (parameter, unit) = self._flies, self.PROFILE.landing_speed
        if flies == SETPOINTS:
            return self._fly_setpoints(now, dt)
        if flies == HOLD:
            return self._hold()
        descent = -self.parameters[parameter] * unit if flies == LAND else 0.0
        if flies == LAND and self.position_known(now):
            return self._track(TrackedSetpoint(velocity=np.array([0.0, 0.0, descent])))
        # Level; without a position it lands so, too.
        return self._track(TrackedSetpoint(velocity=np.array([math.nan, math.nan, descent]),
                                           acceleration=np.array([0.0, 0.0, math.nan])))

    @property
    def _flies(self) -> str:
        return self.PROFILE.modes[self.mode].flies

    def _hold(self) -> Array:
        """Return the acceleration that stops, and keeps the place."""
        estimate = self.estimator
        if self._place is None and np.linalg.norm(estimate.velocity) < _CAPTURE_SPEED:
            self._place = estimate.position.copy()
        return self._track(TrackedSetpoint(velocity=np.zeros(3)) if self._place is None
                           else TrackedSetpoint(position=self._place))

    def _track(self, setpoint: TrackedSetpoint) -> Array:
        """Return the acceleration of PX4's cascade: position, velocity and acceleration add."""
        estimate = self.estimator
        towards = POSITION_GAIN * (setpoint.position - estimate.position)
        velocity = _sum(np.clip(towards, -_HOLD_SPEED_MAX, _HOLD_SPEED_MAX), setpoint.velocity)
        velocity[2] = np.minimum(velocity[2], self._climb_limit)  # NaN stays
        return _sum(VELOCITY_GAIN * (velocity - estimate.velocity), setpoint.acceleration)

    def _follow_yaw(self, dt: float) -> None:
        if math.isfinite(self._setpoint.yaw):
            self._yaw = self._setpoint.yaw
        elif math.isfinite(self._setpoint.yaw_rate):
            self._yaw = wrap_angle(self._yaw + self._setpoint.yaw_rate * dt)


def _sum(a: Array, b: Array) -> Array:
    """Return a + b, where NaN counts as absent and both absent as NaN."""
    return np.where(np.isnan(a), b, np.where(np.isnan(b), a, a + b))
