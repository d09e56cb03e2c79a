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
Forwards odometry to the autopilot as ODOMETRY, for flight without GPS.

Each autopilot accepts one pair of frames: PX4 LOCAL_NED and BODY_FRD, ArduPilot LOCAL_FRD and
BODY_FRD, with the same numbers (ENU converted to NED). The velocity is in the body frame.
``time_usec`` is our monotonic clock, which the autopilot learns by TIMESYNC.
"""

from __future__ import annotations

from collections import Counter, deque
import math
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.gate.velocity_check import plausible_velocity
from flock_follower.geometry import (
    Array,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
)
from flock_follower.mavlink.dialects import Dialect
from flock_follower.mavlink.ned import enu_to_ned, flu_to_frd, quaternion_enu_flu_to_ned_frd
from flock_follower.messages import (
    FUTURE_TOLERANCE,
    ODOMETRY_STD,
    OdometryState,
    POSITION_JUMP,
    SANE,
)
from flock_follower.messages.jumps import jump

#: PX4 stops using vision that pauses for 200 ms; from half of that on a gap is an error, s.
FORWARDING_GAP: Final[float] = 0.1
#: Older odometry than this, s, is not forwarded.
OLDEST_FORWARDED: Final[float] = 0.3
#: An attitude further than this, rad, from the prediction has jumped (a loop closure, a restart).
ATTITUDE_JUMP: Final[float] = 0.2
#: Quality sent for a covariance that is unknown, %.
UNKNOWN_QUALITY: Final[int] = 50
#: Rotation from ENU to NED (3, 3).
_R_NED_ENU: Final[Array] = enu_to_ned(np.eye(3))
#: Rotation from FLU to FRD (3, 3).
_R_FRD_FLU: Final[Array] = flu_to_frd(np.eye(3))
#: Indices of the upper triangle of a covariance (6, 6).
_UPPER = np.triu_indices(6)


class OdometryForwarder:
    """
    Takes odometry, and returns messages at no more than a rate, Hz.

    :param rate: largest rate of the messages, Hz; a link of 57,600 baud carries 10 of 245 bytes.
    """

    def __init__(self, rate: float = 30.0) -> None:
        self.counters: Counter[str] = Counter()
        """Jumps, gaps and losses, by name."""
        self.reset_counter = 0
        self._spacing = 1.0 / rate
        # States, the times of their stamps, and reset counters.
        self._queue: deque[tuple[OdometryState, float, int]] = deque(maxlen=10)
        self._last: tuple[OdometryState, float] | None = None
        self._due = -math.inf
        self._sent = -math.inf

    def take(self, state: OdometryState, time: float, now: float) -> str:
        """Take odometry stamped at ``time``, s on our clock; return '' or why it is refused."""
        if now - time > OLDEST_FORWARDED:
            return 'too old to forward'
        if time - now > FUTURE_TOLERANCE:
            return 'from the future, not forwarded'
        if plausible_velocity(state.velocity) is None:
            return 'not plausible, not forwarded'
        last, self._last = self._last, (state, time)
        if last is not None and has_jumped(*last, state, time):
            self.reset_counter = (self.reset_counter + 1) % 256
            self.counters['jumps'] += 1
        if last is not None and time < last[1]:
            self._due = time
        # The tolerance: a source of exactly this rate would lose every second state.
        if time >= self._due - 0.25 * self._spacing:
            self._due = max(self._due + self._spacing, time)
            self._queue.append((state, time, self.reset_counter))
        return ''

    def withhold(self) -> None:
        """Drop the queued states, because the autopilot is not ready for odometry."""
        if self._queue:
            self.counters['before the origin'] += len(self._queue)
        self._queue.clear()

    def messages(self, dialect: Dialect, now: float) -> list[Any]:
        """Return the messages to send now, oldest first; states that are too old are dropped."""
        fresh = [entry for entry in self._queue if now - entry[1] <= OLDEST_FORWARDED]
        if lost := len(self._queue) - len(fresh):
            self.counters['too old to send'] += lost
        self._queue.clear()
        return [encode_odometry(state, time, dialect, count, now - time)
                for state, time, count in fresh]

    def sent(self, success: bool, now: float) -> None:
        """Record that a message was sent, or that the link had no room for it."""
        if not success:
            self.counters['not sent'] += 1
            return
        self._sent = now
        self.counters['sent'] += 1

    def silence(self, now: float) -> float:
        """Return the time since the last message was sent, s; infinite before the first one."""
        return now - self._sent


def has_jumped(before: OdometryState, then: float, after: OdometryState, now: float) -> bool:
    """
    Return whether a pose differs from its prediction from ``then``, s, or time decreased.

    Each jump that is counted resets the autopilot's estimate, so the small steps by which
    ``derivation`` restarts its filter must not count.
    """
    dt = now - then
    attitude_error = quaternion_to_rotation_vector(
        quaternion_multiply(quaternion_conjugate(before.quaternion), after.quaternion))
    attitude_error = attitude_error - 0.5 * (before.angular_velocity + after.angular_velocity) * dt
    return bool(dt < 0.0 or jump(before, after, dt, POSITION_JUMP)
                or np.linalg.norm(attitude_error) > ATTITUDE_JUMP)


def quality(state: OdometryState, age: float) -> int:
    """
    Return the quality, %, of a state of an age, s; autopilots compare it with a parameter.

    PX4 refuses ODOMETRY below EKF2_EV_QMIN, ArduPilot below VISO_QUAL_MIN; 0 means unknown. The
    quality decreases with the age, and if the standard deviation of the velocity exceeds that in
    ODOMETRY_STD. An unknown covariance halves the quality.
    """
    expected = ODOMETRY_STD[2]
    if _is_known(state.velocity_covariance):
        deviation = math.sqrt(float(np.diag(state.velocity_covariance).max()))
        best = 100.0 * min(1.0, expected / deviation)
    else:
        best = UNKNOWN_QUALITY
    return max(1, round(best * min(1.0, max(0.0, 1.0 - age / OLDEST_FORWARDED))))


def encode_odometry(state: OdometryState, time: float, dialect: Dialect, reset_counter: int,
                    age: float = 0.0) -> Any:
    """
    Return the ODOMETRY message of a state, at a time, s, in the frames of the autopilot.

    Covariances are the row-major upper triangles of (6, 6). A covariance that is missing (zeros),
    not finite, above ``SANE`` or without positive variances is replaced by a diagonal matrix from
    the standard deviations ``ODOMETRY_STD``.
    """
    R_enu_flu = quaternion_to_matrix(state.quaternion)
    position_std, attitude_std, velocity_std, rate_std = ODOMETRY_STD
    x, y, z, w = quaternion_enu_flu_to_ned_frd(state.quaternion).tolist()
    # The covariance of R x is R C R^T.
    pose_covariance = _transform(
        _covariance_or_default(state.pose_covariance, [position_std] * 3 + [attitude_std] * 3),
        _R_NED_ENU)
    twist_covariance: Array = np.zeros((6, 6))
    twist_covariance[:3, :3] = (
        R_enu_flu.T @ _covariance_or_default(state.velocity_covariance, [velocity_std] * 3)
        @ R_enu_flu)
    twist_covariance[3:, 3:] = _covariance_or_default(
        state.twist_covariance[3:, 3:], [rate_std] * 3)
    twist_covariance = _transform(twist_covariance, _R_FRD_FLU)
    return mavlink.MAVLink_odometry_message(
        max(0, round(time * 1e6)), dialect.odometry_frame, mavlink.MAV_FRAME_BODY_FRD,
        *enu_to_ned(state.position).tolist(), [w, x, y, z],
        *flu_to_frd(R_enu_flu.T @ state.velocity).tolist(),
        *flu_to_frd(state.angular_velocity).tolist(),
        pose_covariance[_UPPER].tolist(), twist_covariance[_UPPER].tolist(),
        reset_counter, mavlink.MAV_ESTIMATOR_TYPE_VIO, quality(state, age))


def _covariance_or_default(covariance: Array, deviations: list[float]) -> Array:
    """Return the covariance; if it is invalid, a diagonal one with the deviations."""
    return covariance if _is_known(covariance) else np.diag(np.square(deviations))


def _is_known(covariance: Array) -> bool:
    # The comparison refuses NaN, too.
    return bool(np.all(np.abs(covariance) < SANE) and np.all(np.diag(covariance) > 0.0))


def _transform(covariance: Array, rotation: Array) -> Array:
    both = np.kron(np.eye(2), rotation)
    return both @ covariance @ both.T
