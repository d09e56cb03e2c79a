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
The global origin of an autopilot that flies without GPS, set before any odometry is sent.

PX4 needs an origin for its Hold. Since commit 1cde309317 (PX4 1.18), an origin that arrives after
vision moves the estimate by the distance from the previous origin. So the origin is set first: the
bridge requests GPS_GLOBAL_ORIGIN, sends SET_GPS_GLOBAL_ORIGIN if none exists, and forwards
odometry once the autopilot has returned the origin. An existing origin is kept. In the air the
bridge sends no origin, and odometry does not wait.

ArduPilot accepts an origin once its estimate has a velocity.
"""

from __future__ import annotations

import math
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.link import Link

#: Latitude, longitude, deg, and height, m, of the origin sent to PX4 if none is configured: the
#: start of PX4's simulators. Zeros are no substitute: ground stations read 0 N 0 E as no position,
#: and PX4 would expect the magnetic field off Africa, whose inclination and declination are wrong
#: almost everywhere else.
ANY_ORIGIN: Final[tuple[float, float, float]] = (47.397742, 8.545594, 0.0)
#: The height sent to PX4, mm: beyond the range that it accepts, so that it keeps its own, by the
#: barometer. Any other height moves the estimate, 490 m for a height of 0 at 490 m above the sea.
NO_HEIGHT: Final[int] = 2 ** 31 - 1
#: Time between two messages about the origin, s: requests, and every second time an origin.
STEP: Final[float] = 0.5
#: An origin that the autopilot takes after odometry is sent again after this, s.
RESEND_PERIOD: Final[float] = 5.0
#: After this number of origins without an answer the reason is an obstacle.
TRIES: Final[int] = 3


class GlobalOrigin:
    """
    Sends the origin, and decides whether odometry has to wait for the origin.

    :param given: latitude, longitude, deg, and height, m; None: ``ANY_ORIGIN`` for PX4, none for
        ArduPilot.
    :param without_gps: whether odometry is forwarded.
    """

    def __init__(self, link: Link, given: tuple[float, float, float] | None,
                 without_gps: bool) -> None:
        self.obstacle = ''
        """Why ``offboard`` is refused, or ''."""
        self.awaited = without_gps
        """Whether odometry waits for the origin."""
        self._link = link
        self._given = given
        self._without_gps = without_gps
        self.begin_again()

    def begin_again(self) -> None:
        """Reset everything, also the origin, after a reboot or replacement of the autopilot."""
        self.obstacle, self.awaited = '', self._without_gps
        # Of the last message about it, and of the first step, s.
        self._time, self._began = -math.inf, math.inf
        self._requests = self._tries = 0
        self._link.telemetry.newest.pop('GPS_GLOBAL_ORIGIN', None)

    def step(self, gps: float | None, now: float) -> None:
        """
        Send what is due.

        :param gps: value of the parameter ``gps_switch`` of the dialect; None: unknown.
        """
        telemetry = self._link.telemetry
        dialect = telemetry.dialect
        if dialect is None:
            return
        self._began = min(self._began, now)
        if 'GPS_GLOBAL_ORIGIN' in telemetry.newest:
            self.obstacle, self.awaited = '', False
        elif dialect.gps_switch and self._without_gps:
            self._before_odometry(dialect.gps_switch, gps, now)
        else:
            self.awaited = False
            self._after_odometry(now)

    def _before_odometry(self, switch: str, gps: float | None, now: float) -> None:
        telemetry = self._link.telemetry
        status, estimator = telemetry.status, telemetry.estimator
        flying = telemetry.is_flying(now)
        if flying or (flying is None and status is not None and status.armed) or gps:
            self.obstacle, self.awaited = '', False
            return
        if not self.awaited:
            return
        begun = estimator is not None and estimator.has_velocity and estimator.time > self._began
        if begun and gps == 0 and self._requests > 1:
            self.awaited = False
            self.obstacle = ('the autopilot has no global origin, and its estimate began without '
                             'one: reboot it')
            return
        if now - self._time < STEP:
            return
        self._time = now
        if gps == 0 and self._requests > 1 and self._requests % 2 == 0:
            self._send(self._given or ANY_ORIGIN)
            self._tries += 1
        self._link.send_command(mavlink.MAV_CMD_REQUEST_MESSAGE,
                                (mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,))
        self._requests += 1
        if self._requests > 2 * (TRIES + 1):
            self.obstacle = 'no global origin: ' + (
                f'SET_GPS_GLOBAL_ORIGIN sent {self._tries} times, no GPS_GLOBAL_ORIGIN returned'
                if self._tries else f'the value of {switch} is unknown')

    def _after_odometry(self, now: float) -> None:
        telemetry = self._link.telemetry
        if self._given is None or now - self._time < RESEND_PERIOD or (
                telemetry.estimator is not None and not telemetry.estimator.has_velocity):
            return
        if self._send(self._given):
            self._time = now

    def _send(self, origin: tuple[float, float, float]) -> bool:
        latitude, longitude, height = origin
        dialect = self._link.telemetry.dialect
        known = dialect is not None and dialect.origin_has_height
        return self._link.send(mavlink.MAVLink_set_gps_global_origin_message(
            self._link.target_system, round(latitude * 1e7), round(longitude * 1e7),
            round(height * 1e3) if known else NO_HEIGHT))
