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

"""An autopilot made of pymavlink alone: nothing of the project's own judges what it hears."""

from __future__ import annotations

import threading
import time
from typing import Any

from pymavlink import mavutil

V_NORTH = 0.3  # m/s, what it says it flies


class Wire:
    """
    An autopilot that flies north at V_NORTH and records the setpoints it gets.

    It reports that it is in the air, and by barometer and home 2 m above the place of arming.
    """

    def __init__(self, port: int, system: int = 1) -> None:
        self.setpoints: list[tuple[float, Any]] = []
        self.modes: list[tuple[float, Any]] = []
        """Requests of a mode, each with its time, s."""
        self._link = mavutil.mavlink_connection(
            f'udpout:127.0.0.1:{port}', source_system=system, source_component=1, dialect='common')
        self._running = True
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        mavlink, next_step, steps = mavutil.mavlink, time.monotonic(), 0
        while self._running:
            if time.monotonic() >= next_step:
                next_step += 0.02
                if steps % 50 == 0:
                    self._link.mav.heartbeat_send(
                        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4,
                        mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
                        | mavlink.MAV_MODE_FLAG_SAFETY_ARMED, 6 << 16, mavlink.MAV_STATE_ACTIVE)
                    self._link.mav.extended_sys_state_send(
                        mavlink.MAV_VTOL_STATE_UNDEFINED, mavlink.MAV_LANDED_STATE_IN_AIR)
                    self._link.mav.home_position_send(
                        0, 0, 0, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0)
                if steps % 5 == 0:
                    self._link.mav.global_position_int_send(
                        steps * 20, 0, 0, 2000, 2000, round(100.0 * V_NORTH), 0, 0, 65535)
                    self._link.mav.scaled_pressure_send(steps * 20, 1013.01, 0.0, 2000)
                self._link.mav.local_position_ned_send(
                    steps * 20, 0.0, 0.0, -2.0, V_NORTH, 0.0, 0.0)
                steps += 1
            message = self._link.recv_match(blocking=True, timeout=0.005)
            if message is None:
                continue
            if message.get_type() == 'SET_POSITION_TARGET_LOCAL_NED':
                self.setpoints.append((time.monotonic(), message))
            elif message.get_type() == 'COMMAND_LONG' and (
                    message.command == mavlink.MAV_CMD_DO_SET_MODE):
                self.modes.append((time.monotonic(), message))
            elif message.get_type() == 'TIMESYNC' and not message.tc1:
                # Its clock stands, so the age of its messages stays unknown.
                self._link.mav.timesync_send(1, message.ts1)

    def close(self) -> None:
        self._running = False
        self._thread.join()
        self._link.close()
