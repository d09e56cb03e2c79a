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
Odometry of any source as the ego state: pose and velocity of base_link.

Sources differ (see docs/sensors.md): their child frame is an IMU or a camera instead of base_link;
their velocity is in the child frame, in the header's frame, or missing; their angular velocity or
their covariances are zero. Every node reads ``odom`` by ``OdometrySource``.

``read_odometry`` reads a message from its bytes in 5 us; rclpy takes 85 us, rosbags 15 us, and a
fast source sends 200 messages a second to every node. The bytes are CDR (OMG DDS-RTPS 9.4.2,
"classic"). The first 4 bytes contain the byte order. After them, every number is aligned to its
size. A string is its length, including the final zero, and its bytes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math
import struct
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    normalize_quaternion,
    quaternion_conjugate,
    quaternion_from_rpy,
    quaternion_multiply,
    skew,
    Transform,
    unit_quaternion_to_matrix,
)
from flock_follower.messages import (
    FASTEST_OWN,
    MAX_JUMP,
    NANOSECONDS,
    ODOMETRY_STD,
    OdometryState,
    read_stamp,
    SANE,
)
from flock_follower.odometry.derivation import (
    AUTO,
    CHILD,
    CHOICES,
    DerivedRates,
    DerivedVelocity,
    NONE,
    ODOM,
    ODOMETRY_GAP,
    TwistFrame,
)
from flock_follower.odometry.static_frames import BASE, StaticFrames
from flock_follower.ranges import Checked, parameter, Range

#: If the reading of the velocity changes, the step is faded out with this time constant, s.
FADE_TIME = 0.5
#: A step that has faded to this, m/s, is over: it is less than rounding.
FADED_STEP = 1e-15
#: Messages over which latency and rate are reported.
MAX_REPORTED = 50
#: Number of attitudes kept, to derive angular rates if the messages have none.
MAX_ATTITUDES = 100
#: A velocity of this variance, (m/s)^2, is invalid: rtabmap sends zeros with 9999 without one.
INVALID_VARIANCE = 1e3
#: Correlations in a covariance, with the rounding of its numbers.
MAX_CORRELATION: Final = 1.001
_ORDERS: Final = {b'\x00\x00': '>', b'\x00\x01': '<'}
_ALIGNMENT_START: Final[int] = 4  # bytes before the first that counts for alignment


@dataclass(frozen=True)
class SourceParams(Checked):
    """
    Parameters of the odometry source.

    ``child_position`` (3), m, and ``child_rpy`` (3), rad, are the pose of the odometry's child
    frame on base_link (FLU); ``twist_frame`` is the frame of the velocity, or 'auto'. ``std`` (4)
    are the standard deviations of position, m, attitude, rad, velocity, m/s, and angular velocity,
    rad/s, for a message without covariance.
    """

    child_position: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), Range(-10.0, 10.0, 'm'),
        'place of the child frame of odom on base_link, FLU: that of the IMU if the source '
        'reports the pose of the IMU', live=False)
    child_rpy: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), Range(-2.0 * math.pi, 2.0 * math.pi, 'rad'),
        'roll, pitch, yaw of the child frame of odom on base_link', live=False)
    twist_frame: str = parameter(
        AUTO, CHOICES,
        'frame of the velocity in odom. child: child_frame_id (REP-105); odom: frame_id; none: '
        'derive the velocity from the positions; auto: detect the frame', live=False)
    std: tuple[float, ...] = parameter(
        ODOMETRY_STD, Range(0.0, 100.0, above=True),
        'standard deviations of position, m, attitude, rad, velocity, m/s, and angular velocity, '
        'rad/s, if odom has no covariances', live=False)


_NO_LEVER: Array = np.zeros(3)


class OdometrySource:
    """
    The ego odometry, message by message.

    ``twist`` describes the frame of the velocity. ``events`` has a pair (reason, detail) for each
    dropped message and each jump since :meth:`new_events`. ``placement`` is the newest placement
    of the child frame by ``static``, as text.

    :param static: frames that place the child frame of each message on base_link, unless
        ``params`` place it. Frames may be added later.
    """

    def __init__(self, params: SourceParams | None = None,
                 static: StaticFrames | None = None) -> None:
        self.params = params or SourceParams()
        self._static = StaticFrames() if static is None or any(
            (*self.params.child_position, *self.params.child_rpy)) else static
        self._placed = self.placement = ''
        self._std = np.array(self.params.std) ** 2
        self.twist = TwistFrame(self.params.twist_frame)
        self.events: list[tuple[str, str]] = []
        self._covariances_before: dict[str, tuple[bytes, Array]] = {}  # as given, as used
        self.missing: dict[str, str] = {}
        """The values that the messages lack, and their replacements."""
        self._latencies: deque[float] = deque(maxlen=MAX_REPORTED)
        self._gaps: deque[float] = deque(maxlen=MAX_REPORTED)
        self._frames: tuple[str, str] | None = None
        self.place_child(Transform.from_quaternion(
            self.params.child_position, quaternion_from_rpy(*self.params.child_rpy)))

    def place_child(self, T_base_child: Transform) -> None:
        """Set the pose of the odometry's child frame on base_link, and restart."""
        self._child_position = T_base_child.translation
        self._q_child_base = quaternion_conjugate(T_base_child.quaternion)
        self._R_child_base = T_base_child.rotation.T
        self._is_base = bool(np.array_equal(T_base_child.rotation, np.eye(3)))
        self._levers = bool(T_base_child.translation.any())
        self._restart()

    def _place(self, child: str) -> None:
        """Find another child frame in the static frames; an unknown frame is base_link."""
        if child != self._placed and (
                (pose := self._static.pose_on_base(child)) is not None or self._placed):
            self.place_child(pose or Transform())
            self._placed = '' if pose is None else child
            self.placement = f'the child frame of odom, {child!r}, is taken as {BASE}' if (
                pose is None) else (
                f'{child} is at {pose.translation.round(3).tolist()} m on {BASE} by tf_static')

    def _restart(self) -> None:
        self._stamp: int | None = None
        self._epoch = 0
        self._reading = self.twist.frame
        self._fading: Array | None = None  # what is left of a step of the velocity
        self._doubt: Array = np.zeros(3)  # by how much the two readings differ, in odom
        self.motion = DerivedVelocity()
        self.turning = DerivedRates()
        self._attitudes: deque[tuple[float, Array]] = deque(maxlen=MAX_ATTITUDES)
        self.twist.restart()
        self._latencies.clear()
        self._gaps.clear()

    @property
    def latency(self) -> float:
        """Return the longest recent time from stamp to arrival, s; 0 before the first message."""
        return max(self._latencies, default=0.0)

    @property
    def period(self) -> float:
        """Return the longest recent time between two stamps, s; 0 before the second message."""
        return max(self._gaps, default=0.0)

    def new_events(self) -> list[tuple[str, str]]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events

    def take(self, message: Any, now: int, clock_shift: int = 0) -> OdometryState | None:
        """
        Return the ego state, of base_link, from an Odometry message that arrived at ``now``, ns.

        None if the message is a repetition or out of order. A stamp of 0 means ``now``.

        :param clock_shift: by how much the stamp is ahead of the clock of ``now``, ns: see
            ``nodes.support.clock_watch``.

        :raises ValueError: if position, attitude or stamp is invalid.
        """
        self._place(message.child_frame_id)
        position, attitude = _pose(message)
        stamp = (read_stamp(message.header.stamp) or now + clock_shift) - clock_shift
        if not self._is_new(stamp, (message.header.frame_id, message.child_frame_id)):
            return None
        time = (stamp - self._epoch) / NANOSECONDS
        self._latencies.append((now - stamp) / NANOSECONDS)

        # Identity turns and zero levers are skipped: that saves a third of the time.
        R_odom_child = rotation = unit_quaternion_to_matrix(attitude)
        if not self._is_base:
            attitude = quaternion_multiply(attitude, self._q_child_base)
            rotation = R_odom_child.dot(self._R_child_base)
        quaternion, lever = canonical_quaternion(attitude), _NO_LEVER
        if self._levers:
            lever = -rotation.dot(self._child_position)
            position = position + lever
        self._attitudes.append((time, quaternion))
        if jump := self.motion.take(time, position):
            self.events.append(('odom jumped', f'by {jump:.2f} m'))
            self.twist.restart()
        linear, rates = _twist(message)
        turning = any(rates.tolist())
        angular = rates if turning else self._derived_rates()
        if turning and not self._is_base:
            angular = self._R_child_base.T.dot(rates)
        self._lacks('angular velocity', not turning, 'derived from the attitudes')
        velocity = self._read(time, position, R_odom_child, linear, skew(
            rotation.dot(angular)).dot(lever) if self._levers else None)
        derived = linear is None or self._reading == NONE
        pose_covariance, twist_covariance = self._covariances(message, rotation, lever, derived)
        return OdometryState(
            stamp, message.header.frame_id, message.child_frame_id, position, quaternion,
            velocity, angular, pose_covariance, twist_covariance, rotation, derived)

    def _is_new(self, stamp: int, frames: tuple[str, str]) -> bool:
        """Return whether to use a message; restart after a jump of time or frame."""
        if self._frames not in (None, frames):
            self.events.append(('odom changed its frames', f'{self._frames} to {frames}'))
            self._restart()
        self._frames = frames
        if self._stamp is not None and stamp <= self._stamp:
            back = (self._stamp - stamp) / NANOSECONDS
            if back <= MAX_JUMP:
                self.events.append(('odom stamp repeated', '') if back == 0.0 else (
                    'odom out of order', f'by {back:.3f} s'))
                return False
            self._restart()  # users of the state see it by the stamp
        if self._stamp is None:
            self._epoch = stamp
        else:
            gap = (stamp - self._stamp) / NANOSECONDS
            self._gaps.append(gap)
            if gap > ODOMETRY_GAP:
                self.events.append(('odom gap', f'{gap:.2f} s'))
                self.twist.restart()
        self._stamp = stamp
        return True

    def _derived_rates(self) -> Array:
        """Return the angular velocity (3,), rad/s, from all attitudes so far."""
        for time, quaternion in self._attitudes:
            self.turning.take(time, quaternion)
        self._attitudes.clear()
        return self.turning.rate

    def _read(self, time: float, position: Array, R_odom_child: Array, linear: Array | None,
              lever_velocity: Array | None) -> Array:
        """Return the velocity (3,) of base_link in odom, m/s."""
        before = self._reading
        if linear is None and 'velocity' not in self.missing:
            self.events.append(('odom velocity invalid', 'derived from the positions meanwhile'))
        self._lacks('velocity', linear is None, 'derived from the positions')
        if linear is None:
            velocity = self.motion.velocity_at(time)
        else:
            child, odom = R_odom_child.dot(linear), linear
            if lever_velocity is not None:
                child, odom = child + lever_velocity, odom + lever_velocity
            self.twist.take(time, position, child, odom)
            self._reading = self.twist.reading(child, odom)
            self._doubt = child - odom
            velocity = self._as_read(self._reading, time, child, odom)
            if self._gaps and before != self._reading:
                # The step that another reading would be is faded out; not a velocity that the
                # positions contradict.
                left = np.zeros(3) if self._fading is None else self._fading
                self._fading = None if self._reading == NONE and self.twist.is_contradicted else (
                    left + self._as_read(before, time, child, odom)) - velocity
        if self._fading is not None:
            self._fading = self._fading * math.exp(-self._gaps[-1] / FADE_TIME)
            velocity = velocity + self._fading
            if max(map(abs, self._fading.tolist())) < FADED_STEP:
                self._fading = None
        return velocity

    def _as_read(self, reading: str, time: float, child: Array, odom: Array) -> Array:
        """Return the velocity (3,), m/s, in a reading."""
        if reading == NONE:
            return self.motion.velocity_at(time)
        return child if reading == CHILD else odom

    def _covariances(self, message: Any, rotation: Array, lever: Array,
                     derived: bool) -> tuple[Array, Array]:
        """
        Return the covariances (6, 6) of pose and twist as messages have them, of base_link.

        :param derived: whether the velocity is derived from the positions.
        """
        pose = self._complete_covariance('pose', message.pose.covariance, self._std[:2])
        if self._levers:
            lever_matrix = np.eye(6)
            lever_matrix[:3, 3:] = -skew(lever)
            pose = lever_matrix.dot(pose).dot(lever_matrix.T)
        twist = self._complete_covariance('twist', message.twist.covariance, self._std[2:])
        if self._reading == ODOM or not self._is_base:
            to_base = self._R_child_base.T
            turn = np.zeros((6, 6))
            turn[:3, :3] = rotation.T if self._reading == ODOM else to_base
            turn[3:, 3:] = to_base
            twist = turn.dot(twist).dot(turn.T)
        if derived:
            twist = twist.copy()
            twist[:3] = twist[:, :3] = 0.0
            twist[range(3), range(3)] = self.motion.variance_of_velocity
        wrong = 0.0 if derived else self.twist.wrong_probability
        for share, off in ((wrong, self._doubt), (1.0, self._fading)):
            # The velocity may be the other reading, and a step being faded out is an error.
            if share and off is not None and np.count_nonzero(off):
                in_base = rotation.T.dot(off)
                twist = twist.copy()
                twist[:3, :3] += share * (in_base[:, None] * in_base)
        return pose, twist

    def _complete_covariance(self, field: str, covariance: Any, variances: Array) -> Array:
        """Return a covariance (6, 6), with ``variances`` (2,) if a part is missing."""
        numbers = np.asarray(covariance, dtype=float)
        given = numbers.tobytes()
        before, known = self._covariances_before.get(field, (b'', numbers))
        if before == given:
            return known  # it seldom changes
        matrix = numbers.reshape(6, 6).copy()
        # Enough for both parts, and as fast as a message needs it; NaN fails.
        sane = numbers.dot(numbers) < SANE**2 and min(matrix.diagonal().tolist()) > 0.0 and (
            _is_correlated(matrix))
        for part, variance, name in ((slice(3), variances[0], 'linear'),
                                     (slice(3, 6), variances[1], 'angular')):
            lacking = not (sane or (np.all(np.abs(matrix[part]) < SANE)  # refuses NaN, too
                                    and np.all(matrix.diagonal()[part] > 0.0)
                                    and _is_correlated(matrix[part, part])))
            if lacking:
                matrix[part] = matrix[:, part] = 0.0
                matrix[part, part] = variance * np.eye(3)
            self._lacks(f'{name} covariance of the {field}', lacking, 'odom_std')
        if not sane:
            matrix[:3, 3:] = matrix[3:, :3] = 0.0
        self._covariances_before[field] = given, matrix
        return matrix

    def _lacks(self, quantity: str, lacking: bool, instead: str) -> None:
        if lacking:
            self.missing[quantity] = instead
        else:
            self.missing.pop(quantity, None)


def _is_correlated(matrix: Array) -> bool:
    """Return whether no correlation in a matrix (n, n) exceeds 1: else it is no covariance."""
    variances = matrix.diagonal()
    return matrix.size == np.count_nonzero(
        matrix * matrix <= MAX_CORRELATION**2 * variances[:, None] * variances)


def read_odometry(data: bytes) -> Any:
    """
    Return an Odometry message from its bytes; the covariances (36,) are views of the bytes.

    :raises ValueError: if the bytes are no Odometry message.
    """
    order = _ORDERS.get(bytes(data[:2]))
    if order is None:
        raise ValueError('not an Odometry message: it has no valid CDR header')
    try:
        seconds, nanoseconds, length = struct.unpack_from(f'{order}iII', data, _ALIGNMENT_START)
        frame = str(data[_ALIGNMENT_START + 12:_ALIGNMENT_START + 11 + length], 'utf-8')
        at = _align(_ALIGNMENT_START + 12 + length, 4)
        length, = struct.unpack_from(f'{order}I', data, at)
        child = str(data[at + 4:at + 3 + length], 'utf-8')
        at = _align(at + 4 + length, 8)
        # Position and attitude, velocity and angular velocity; a covariance follows either.
        n = struct.unpack_from(f'{order}7d288x6d288x', data, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f'not an Odometry message: {error}') from None
    of_pose, of_twist = (np.frombuffer(data, f'{order}f8', 36, at + start) for start in (56, 392))
    new = SimpleNamespace
    return new(
        header=new(stamp=new(sec=seconds, nanosec=nanoseconds), frame_id=frame),
        child_frame_id=child,
        pose=new(pose=new(position=new(x=n[0], y=n[1], z=n[2]),
                          orientation=new(x=n[3], y=n[4], z=n[5], w=n[6])), covariance=of_pose),
        twist=new(twist=new(linear=new(x=n[7], y=n[8], z=n[9]),
                            angular=new(x=n[10], y=n[11], z=n[12])), covariance=of_twist))


def _align(at: int, size: int) -> int:
    return at + (_ALIGNMENT_START - at) % size


def _pose(message: Any) -> tuple[Array, Array]:
    """
    Return position (3,) and attitude (x, y, z, w) of an Odometry message.

    :raises ValueError: if they are invalid.
    """
    pose = message.pose.pose
    q = pose.orientation
    attitude = [q.x, q.y, q.z, q.w]
    if not any(attitude):
        raise ValueError('quaternion = 0: the source has lost its pose')
    position, sane = _vector(pose.position)
    if not sane:
        raise ValueError(f'position = {position.tolist()}: must be finite, and within {SANE:g}')
    return position, normalize_quaternion(attitude)


def _vector(message: Any) -> tuple[Array, bool]:
    """Return a Vector3 or Point as an array (3,), and whether it is plausible."""
    x, y, z = message.x, message.y, message.z
    sane = abs(x) <= SANE and abs(y) <= SANE and abs(z) <= SANE  # written so that NaN fails
    return np.array([x, y, z]), sane


def _twist(message: Any) -> tuple[Array | None, Array]:
    """Return the velocity (3,), None if invalid or too fast, and the rates, zeros if invalid."""
    twist = message.twist.twist
    (linear, moving), (rates, turning) = _vector(twist.linear), _vector(twist.angular)
    known = not message.twist.covariance[0] >= INVALID_VARIANCE  # NaN is not known to be large
    return linear if known and moving and math.hypot(*linear.tolist()) <= FASTEST_OWN else None, (
        rates if turning else np.zeros(3))
