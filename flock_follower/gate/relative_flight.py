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
Flight without odometry: when it is permitted, and the motion by attitude and acceleration.

The flight without odometry begins if odometry is lost or contradicted while the vehicle flies
commands that use it; so after a takeover it begins only after commands with odometry. It ends
when odometry has been usable for USABLE_TIME, after ``relative_timeout``, or with the permission.
The time flown without odometry is counted; the same time flown with odometry resets the count.

``Reckoning`` integrates the acceleration that follows from the attitude. The integrated velocity
drifts, so it decays slowly to zero; the relative motion of the marker does not depend on it.
Vectors are ENU; time is an argument.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from flock_follower.geometry import Array, GRAVITY, quaternion_to_matrix
from flock_follower.messages import OdometryState, RELATIVE

#: Odometry that has been usable for this long, s, is flown on again.
USABLE_TIME: Final[float] = 1.0
#: At its beginning the marker's estimate restarts: for this long, s, setpoints may be level.
GRACE: Final[float] = 1.0
#: Time constant of the leak of the velocity, s: a tilt error of 1 degree adds 0.9 m/s.
LEAK: Final[float] = 5.0
#: Of the observer that follows the height, 1/s.
HEIGHT_BANDWIDTH: Final[float] = 0.7
#: After a longer gap between two attitudes, s, nothing is integrated.
LONGEST_STEP: Final[float] = 0.2
#: A covariance (6, 6) that is not known: zeros.
_UNKNOWN: Final[Array] = np.zeros((6, 6))


class Relative(NamedTuple):
    """The permission for commands that are based on the marker only."""

    lasted: float = math.nan
    """Time flown without odometry, s; NaN if it is not permitted now."""
    begins: bool = False
    """Whether the flight without odometry has just begun: no command can have arrived."""


class Reckoning:
    """Position (3,), m, and velocity (3,), m/s, integrated since the beginning."""

    def __init__(self, height: float) -> None:
        self.position: Array = np.array([0.0, 0.0, height])
        self.velocity: Array = np.zeros(3)
        self._climb = 0.0
        self._time: float | None = None

    def step(self, rotation: Array, acceleration: Array, height: float, time: float) -> None:
        """
        Integrate up to a time, s.

        :param rotation: attitude (3, 3), FLU to ENU.
        :param acceleration: (3,), m/s^2; vertical: the flown acceleration; horizontal: the part
            that does not follow from the attitude, such as wind.
        :param height: by barometer or rangefinder, m.
        """
        elapsed = 0.0 if self._time is None else time - self._time
        self._time = time
        if not 0.0 < elapsed <= LONGEST_STEP:
            return
        up = float(acceleration[2])
        tilted = (GRAVITY + up) / max(float(rotation[2, 2]), 0.5) * rotation[:2, 2]
        error = height - float(self.position[2])
        self._climb += elapsed * (up + HEIGHT_BANDWIDTH ** 2 * error)
        level = self.velocity[:2] + elapsed * (
            tilted + acceleration[:2] - self.velocity[:2] / LEAK)
        velocity = np.array([*level, self._climb + 2.0 * HEIGHT_BANDWIDTH * error])
        # The position is the integral of the velocity, for the comparison with the marker.
        self.position = self.position + 0.5 * elapsed * (self.velocity + velocity)
        self.velocity = velocity


class RelativeFlight:
    """
    Permits commands without odometry; times are monotonic, s.

    :param timeout: longest time for which they are permitted, s; 0: never.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self.reckoning: Reckoning | None = None
        """The motion during flight without odometry."""
        self._begun = math.inf
        self._spent = 0.0  # s, flown without odometry and not yet made up for
        self._usable_since = math.inf
        self._flown = False  # whether commands were flown on odometry in this ACTIVE phase
        self._time = -math.inf

    def lasts(self, now: float) -> float:
        """Return the total time flown without odometry, s; NaN: not permitted."""
        lasted = self._spent + min(now, self._usable_since) - self._begun
        permitted = self.reckoning is not None and 0.0 <= lasted <= self._timeout
        return lasted if permitted else math.nan

    def permission(self, now: float) -> Relative:
        """Return the permission at ``now``, s."""
        lasted = self.lasts(now)
        return Relative(lasted, not math.isnan(lasted) and now - self._begun <= GRACE)

    def update(self, active: bool, commanded: bool, usable: bool, height: float | None,
               now: float) -> None:
        """
        Begin or end the flight without odometry.

        :param active: whether the vehicle flies our setpoints by permission.
        :param commanded: whether the last setpoint was a command.
        :param usable: whether odometry may be used.
        :param height: by barometer or rangefinder, m; without a height the flight without odometry
            does not begin.
        """
        elapsed, self._time = max(now - self._time, 0.0), now
        self._flown = active and (self._flown or (usable and commanded))
        self._usable_since = min(self._usable_since, now) if usable else math.inf
        if self.reckoning is not None:
            if not active or now - self._usable_since >= USABLE_TIME:
                self._spent += min(now, self._usable_since) - self._begun
                self.reckoning, self._begun = None, math.inf
        elif usable:
            self._spent = max(self._spent - elapsed, 0.0) if elapsed < math.inf else 0.0
        elif self._flown and height is not None and self._spent < self._timeout:
            self.reckoning, self._begun = Reckoning(height), now

    def motion(self, quaternion: Array, rates: Array, acceleration: Array, height: float | None,
               time: float, now: float) -> OdometryState | None:
        """
        Return the motion at an attitude, in the frame ``RELATIVE``; None if not permitted.

        Its stamp is 0.

        :param quaternion: (x, y, z, w), FLU to ENU, at a time, s; ``rates`` (3,), rad/s, FLU.
        :param acceleration: see ``Reckoning.step``.
        :param height: by barometer or rangefinder, m.
        """
        if self.reckoning is None or height is None or math.isnan(self.lasts(now)):
            return None
        rotation = quaternion_to_matrix(quaternion)
        self.reckoning.step(rotation, acceleration, height, time)
        return OdometryState(
            0, RELATIVE, 'base_link', self.reckoning.position, quaternion,
            self.reckoning.velocity, rates, _UNKNOWN, _UNKNOWN, rotation)
