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

"""The way out of a setpoint: encoded for the autopilot, numbered in time, and watched for gaps."""

from __future__ import annotations

import math

from flock_follower.mavlink import px4
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.setpoint_rules import Setpoint
from flock_follower.mavlink.setpoints import encode_setpoint


class SetpointStream:
    """
    Sends setpoints over a link.

    :param start: what their times count from, s.
    """

    def __init__(self, link: Link, start: float) -> None:
        self._link = link
        self._start = start
        self._since = start
        self._last = -math.inf

    def send(self, setpoint: Setpoint, now: float) -> bool:
        """Send a setpoint at ``now``, s; return whether it left."""
        message = encode_setpoint(setpoint.acceleration, setpoint.yaw)
        if not self._link.send_setpoint(message, round((now - self._start) * 1e3)):
            return False
        if self._broken(now):
            self._since = now
        self._last = now
        return True

    def running_for(self, now: float) -> float:
        """Return how long setpoints have been going out without a gap, s."""
        return 0.0 if self._broken(now) else now - self._since

    def _broken(self, now: float) -> bool:
        return now - self._last > 1.0 / px4.MINIMUM_STREAM_RATE
