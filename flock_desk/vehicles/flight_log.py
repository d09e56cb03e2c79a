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

"""The flight log of the embedded autopilot: its true state, and every setpoint it was sent."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from flock_desk.vehicles.flight_controller import FlightController
from flock_follower.geometry import Array, ned_to_enu, yaw_ned_to_enu

#: The true state is logged this often, Hz.
STATE_RATE: Final[float] = 50.0
_STATE: Final = ('state_time', 'position', 'velocity', 'acceleration', 'yaw', 'armed', 'mode')
_SETPOINT: Final = ('setpoint_time', 'setpoint_type_mask', 'setpoint_frame',
                    'setpoint_acceleration', 'setpoint_yaw')
_ODOMETRY: Final = ('odometry_time', 'odometry_time_usec', 'odometry_frame')


class FlightLog:
    """
    Collects what happened; ``save`` writes it as .npz.

    Times are s on the system's monotonic clock, vectors ENU. Arrays: ``state_time`` (n,),
    ``position``, ``velocity``, ``acceleration`` (n, 3), ``yaw`` (n,), ``armed`` (n,), ``mode``
    (n,) names; ``setpoint_time`` (m,), ``setpoint_type_mask`` (m,), ``setpoint_frame`` (m,),
    ``setpoint_acceleration`` (m, 3), ``setpoint_yaw`` (m,);
    ``odometry_time`` (k,), ``odometry_time_usec`` (k,), ``odometry_frame`` (k,).
    """

    def __init__(self) -> None:
        self._states: list[tuple[Any, ...]] = []
        self._setpoints: list[tuple[Any, ...]] = []
        self._odometry: list[tuple[Any, ...]] = []
        self._next_state = -np.inf

    def state(self, controller: FlightController, now: float) -> None:
        """Record the true state, unless the last record is too recent."""
        vehicle = controller.vehicle
        self.moved(now, vehicle.position, vehicle.velocity, vehicle.acceleration, vehicle.yaw,
                   controller.armed, controller.mode)

    def moved(self, now: float, position: Array, velocity: Array, acceleration: Array, yaw: float,
              armed: bool, mode: str) -> None:
        """Record a true state, unless the last record is too recent."""
        if now < self._next_state:
            return
        self._next_state = now + 0.99 / STATE_RATE
        self._states.append((now, position.copy(), velocity.copy(), acceleration.copy(), yaw,
                             armed, mode))

    def received(self, message: Any, now: float) -> None:
        """Record a setpoint or an ODOMETRY received at ``now``; others do not count."""
        kind = message.get_type()
        if kind == 'SET_POSITION_TARGET_LOCAL_NED':
            self._setpoints.append((now, message.type_mask, message.coordinate_frame,
                                    ned_to_enu([message.afx, message.afy, message.afz]),
                                    yaw_ned_to_enu(message.yaw)))
        elif kind == 'ODOMETRY':
            self._odometry.append((now, message.time_usec, message.frame_id))

    def arrays(self) -> dict[str, Any]:
        """Return the log as arrays by name."""
        columns: dict[str, Any] = {}
        for names, rows in ((_STATE, self._states), (_SETPOINT, self._setpoints),
                            (_ODOMETRY, self._odometry)):
            for i, name in enumerate(names):
                columns[name] = np.array([row[i] for row in rows])
        if not self._setpoints:
            columns['setpoint_acceleration'] = np.empty((0, 3))
        return columns

    def save(self, path: str) -> None:
        """Write the log to a .npz file."""
        with open(path, 'wb') as file:
            np.savez_compressed(file, **self.arrays())
