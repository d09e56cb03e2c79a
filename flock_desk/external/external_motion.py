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
The motion of a vehicle that an external autopilot flies, from its MAVLink messages.

Ground truth is SIM_STATE (ArduPilot's simulator) or HIL_STATE_QUATERNION (PX4's); if neither
comes, the autopilot's own estimate is LOCAL_POSITION_NED with ATTITUDE_QUATERNION. Times are
integer nanoseconds of one monotonic clock, given by the caller; no clock is read here.
"""

from __future__ import annotations

from collections import deque
import math
from typing import Any, Final, NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.geometry.rotation_vectors import slerp
from flock_follower.mavlink.ned import ned_to_enu
from flock_follower.mavlink.telemetry import decode_attitude

SIM_STATE: Final[str] = 'SIM_STATE'
HIL_STATE: Final[str] = 'HIL_STATE_QUATERNION'
ESTIMATE: Final[str] = 'LOCAL_POSITION_NED'
ATTITUDE: Final[str] = 'ATTITUDE_QUATERNION'
CLOCK: Final[str] = 'SYSTEM_TIME'
TRUTHS: Final[tuple[str, ...]] = (SIM_STATE, HIL_STATE)
MAX_POSES: Final[int] = 256
"""Number of poses kept: more than one second."""
POSE_GAP: Final[int] = 150_000_000
"""Poses farther apart than this, ns, have no known motion between them."""
SMOOTHING: Final[float] = 1.0
"""Time constant, s, of the correction of the integrated velocity by reported places."""
JUMP: Final[float] = 0.5
"""Largest difference of integrated and reported place, m; a larger one is a jump."""
_DEGREE = 111_320.0  # m along a meridian


class Motion(NamedTuple):
    """Position, attitude and velocities of a vehicle at a time, ENU and FLU."""

    time: int
    """ns."""
    position: Array
    """(3,), m."""
    velocity: Array
    """(3,), m/s."""
    quaternion: Array
    """FLU to ENU, (x, y, z, w)."""
    angular: Array
    """(3,), rad/s, FLU."""


class ExternalMotion:
    """
    The motion of one vehicle at any time of the last second, from messages as they come.

    The frame is ENU; its origin is the first reported place, if not set before.
    """

    def __init__(self) -> None:
        self.source = ''
        """Name of the message that places it; '' until a truth comes, or ESTIMATE is set."""
        self.times: list[tuple[float, float]] = []
        """Our time and the autopilot's time since boot, s: simulators may be slow."""
        self._poses: deque[Motion] = deque(maxlen=MAX_POSES)
        self._turned: tuple[Array, Array] | None = None  # the newest attitude of an estimate
        self.origin: Array | None = None
        """Latitude, longitude (deg), height (m); ENU of an estimate. None before any pose."""

    @property
    def estimated(self) -> bool:
        """Return whether it is the autopilot's own estimate."""
        return self.source == ESTIMATE

    def take(self, message: Any, now: int) -> None:
        """Take a message of the autopilot received at ``now``, ns; most messages are ignored."""
        kind = message.get_type()
        if kind in TRUTHS and self.source in ('', kind):
            self._truth(message, now)
        elif kind == CLOCK:
            self.times.append((now * 1e-9, message.time_boot_ms * 1e-3))
        elif kind == ESTIMATE and self.estimated:
            self._estimate(message, now)
        elif kind == ATTITUDE and self.estimated:
            self._turned = decode_attitude(
                [message.q1, message.q2, message.q3, message.q4],
                (message.rollspeed, message.pitchspeed, message.yawspeed))

    def add(self, motion: Motion) -> None:
        """Take a motion; one that is not finite, or not newer than the last, is dropped."""
        finite = all(np.all(np.isfinite(each)) for each in motion[1:])
        if finite and (not self._poses or motion.time > self._poses[-1].time):
            self._poses.append(motion)

    @property
    def newest(self) -> int | None:
        """Return the time, ns, until which the motion is known; None before any motion."""
        return self._poses[-1].time if self._poses else None

    def knows(self, time: int) -> bool:
        """Return whether the motion at a time, ns, is known: between poses, and near to both."""
        before, after = self._adjacent_poses(time)
        return after is not None and (after.time == time or (
            before is not None and after.time - before.time <= POSE_GAP))

    def at(self, time: int) -> Motion:
        """
        Return the motion at a time, ns, interpolated, also if ``knows`` is False.

        Before the first pose the first pose is returned, after the last pose the last: nothing is
        extrapolated.

        :raises ValueError: if no pose has come yet.
        """
        if not self._poses:
            raise ValueError('no pose has come yet')
        before, after = self._adjacent_poses(time)
        b = after or self._poses[-1]
        a = before if before and after else b
        share = 1.0 if a.time == b.time else (time - a.time) / (b.time - a.time)
        position, velocity, angular = ((1.0 - share) * x + share * y for x, y in (
            (a.position, b.position), (a.velocity, b.velocity), (a.angular, b.angular)))
        return Motion(time, position, velocity, slerp(a.quaternion, b.quaternion, share), angular)

    def _adjacent_poses(self, time: int) -> tuple[Motion | None, Motion | None]:
        """Return the last pose before a time, and the first that is not."""
        after = None
        for pose in reversed(self._poses):  # the newest are asked for
            if pose.time < time:
                return pose, after
            after = pose
        return None, after

    def _truth(self, message: Any, now: int) -> None:
        if message.get_type() == SIM_STATE:
            latitude, longitude, height = message.lat_int, message.lon_int, message.alt
            velocity = np.array([message.vn, message.ve, message.vd])
            quaternion = [message.q1, message.q2, message.q3, message.q4]
            rates = message.xgyro, message.ygyro, message.zgyro
        else:
            latitude, longitude, height = message.lat, message.lon, message.alt * 1e-3
            velocity = 1e-2 * np.array([message.vx, message.vy, message.vz])
            quaternion = list(message.attitude_quaternion)
            rates = message.rollspeed, message.pitchspeed, message.yawspeed
        if not latitude and not longitude:
            return  # not simulated yet, or an ArduPilot before 4.3, whose floats are too coarse
        turned = decode_attitude(quaternion, rates)
        if turned is not None:
            self.source = message.get_type()
            self._place(now, self._local(latitude * 1e-7, longitude * 1e-7, height),
                        ned_to_enu(velocity), turned)

    def _local(self, latitude: float, longitude: float, height: float) -> Array:
        """Return the place, ENU m, of degrees and m above the sea."""
        if self.origin is None:
            self.origin = np.array([latitude, longitude, height])
        north, east, up = np.array([latitude, longitude, height]) - self.origin
        return np.array([east * _DEGREE * math.cos(math.radians(self.origin[0])),
                         north * _DEGREE, up])

    def _estimate(self, message: Any, now: int) -> None:
        turned, self._turned = self._turned, None
        if turned is None:
            return  # an attitude that stalls places nothing
        position = ned_to_enu([message.x, message.y, message.z])
        if self.origin is None:
            self.origin = position
        self._place(now, position - self.origin,
                    ned_to_enu([message.vx, message.vy, message.vz]), turned)

    def _place(self, now: int, reported: Array, velocity: Array,
               turned: tuple[Array, Array]) -> None:
        """Add a position of resolution 1e-7 deg, smoothed with the velocity, at its arrival."""
        position = reported
        if self._poses:
            last = self._poses[-1]
            elapsed = (now - last.time) * 1e-9
            expected = last.position + 0.5 * elapsed * (last.velocity + velocity)
            if np.linalg.norm(reported - expected) < JUMP:
                share = 1.0 - math.exp(-elapsed / SMOOTHING)
                position = expected + share * (reported - expected)
        self.add(Motion(now, position, velocity, *turned))
