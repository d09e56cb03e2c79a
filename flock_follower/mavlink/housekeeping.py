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
What the bridge wants of the autopilot besides flying: telemetry, its clock, its parameters.

Everything is asked for again after a reboot, and when a lost link is back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink import timesync
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.parameter_check import ParameterCheck, Recommendation
from flock_follower.mavlink.telemetry import HEARTBEAT_PERIOD
from flock_follower.mavlink.timesync import TimeSync

#: Telemetry is asked for again when it has been missing for this long, s.
STREAM_REQUEST_PERIOD: Final[float] = 2.0
#: Whether it flies is asked for this long, s; some autopilots never tell.
LANDED_TIMEOUT: Final[float] = 10.0
#: An origin is told again after this, s, until the autopilot shows that it has one.
ORIGIN_PERIOD: Final[float] = 5.0


class Housekeeping:
    """
    Sends what is due besides setpoints, and takes the answers.

    :param recommendations: the parameters to compare, by the name of the dialect.
    :param estimate_rate: wanted rate of the autopilot's position and attitude, Hz.
    :param origin: latitude, longitude, deg, and height, m, told to an estimator without an origin.
    :param without_gps: whether odometry is forwarded; PX4 then needs an origin for its Hold, and
        is told zeros where ``origin`` is None.
    """

    def __init__(self, link: Link, recommendations: Mapping[str, Sequence[Recommendation]] | None,
                 estimate_rate: float, origin: tuple[float, float, float] | None,
                 without_gps: bool = False) -> None:
        self.timesync = TimeSync()
        self.parameters: ParameterCheck | None = None
        self.alive_since = math.inf
        """When the autopilot was first heard, s."""
        self._link = link
        self._recommendations = recommendations or {}
        self._estimate_rate = estimate_rate
        self._origin = origin
        self._without_gps = without_gps
        self._origin_told = self._heartbeat_sent = -math.inf
        self._timesync_sent = self._streams_requested = -math.inf
        self._reboots = 0
        self._was_alive = False

    def take(self, message: Any, now: float) -> None:
        """Take a message of the autopilot, received at ``now``, s."""
        kind = message.get_type()
        if kind == 'PARAM_VALUE' and self.parameters is not None:
            self.parameters.take(message)
        elif kind == 'TIMESYNC':
            answer = self.timesync.take(message, round(now * 1e9))
            if answer is not None:
                self._link.send(answer)

    def step(self, now: float, alive: bool) -> None:
        """Send HEARTBEAT and questions that are due; ``alive`` is whether anyone hears them."""
        if now - self._heartbeat_sent >= HEARTBEAT_PERIOD - 1e-3 and self._link.send_heartbeat():
            self._heartbeat_sent = now
        reboots = self._link.telemetry.reboots
        if reboots != self._reboots or (alive and not self._was_alive):
            self._reboots = reboots
            self.timesync.forget()
            self._streams_requested, self.parameters = -math.inf, self._new_check()
            self.alive_since = min(self.alive_since, now)
        self._was_alive = alive
        if not alive:
            return
        self._ask_for_streams(now)
        if now - self._timesync_sent >= timesync.PERIOD and self._link.send(
                self.timesync.question(round(now * 1e9))):
            self._timesync_sent = now
        self._tell_origin(now)
        if self.parameters is not None:
            for name in self.parameters.step(now):
                self._link.request_parameter(name)

    def _new_check(self) -> ParameterCheck | None:
        dialect = self._link.telemetry.dialect
        if dialect is None:
            return None
        return ParameterCheck(self._recommendations.get(dialect.name, ()),
                              bytewise=dialect.bytewise_parameters,
                              needed=[name for name in (
                                  dialect.silence_parameter, dialect.minimum_takeoff,
                                  dialect.gps_switch) if name])

    def _zero_origin(self) -> tuple[float, float, float] | None:
        dialect, parameters = self._link.telemetry.dialect, self.parameters
        if not self._without_gps or dialect is None or parameters is None:
            return None
        off = dialect.gps_switch and parameters.values.get(dialect.gps_switch) == 0
        return (0.0, 0.0, 0.0) if off else None

    def _ask_for_streams(self, now: float) -> None:
        if now - self._streams_requested < STREAM_REQUEST_PERIOD:
            return
        telemetry = self._link.telemetry
        position, attitude = telemetry.local_position, telemetry.attitude
        untold = telemetry.flying(now) is None and (
            telemetry.landed is not None or now - self.alive_since < LANDED_TIMEOUT)
        if (math.isinf(self._streams_requested) or untold or position is None or attitude is None
                or now - min(position.time, attitude.time) > STREAM_REQUEST_PERIOD):
            self._link.request_streams(self._estimate_rate)
            self._streams_requested = now

    def _tell_origin(self, now: float) -> None:
        telemetry, origin = self._link.telemetry, self._origin or self._zero_origin()
        # Where it has one, from GPS or from before, the autopilot keeps that.
        if origin is None or telemetry.has_origin or now - self._origin_told < ORIGIN_PERIOD:
            return
        if telemetry.estimator is not None and not telemetry.estimator.has_velocity:
            return  # told before odometry is fused, PX4's heights would jump by the origin's
        latitude, longitude, height = origin
        if self._link.send(mavlink.MAVLink_set_gps_global_origin_message(
                self._link.target_system, round(latitude * 1e7), round(longitude * 1e7),
                round(height * 1e3))):
            self._origin_told = now
