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

"""The flight log of a vehicle: its true state, and every setpoint it was sent."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from flock_follower.geometry import Array, ned_to_enu, yaw_ned_to_enu

#: The true state is logged this often, Hz.
STATE_RATE: Final[float] = 50.0
_COLUMNS: Final = {
    'state': ('state_time', 'position', 'velocity', 'acceleration', 'yaw', 'armed', 'mode'),
    'SET_POSITION_TARGET_LOCAL_NED': (
        'setpoint_time', 'setpoint_type_mask', 'setpoint_frame', 'setpoint_acceleration',
        'setpoint_yaw'),
    'ODOMETRY': ('odometry_time', 'odometry_time_usec', 'odometry_frame')}


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
        self._rows: dict[str, list[tuple[Any, ...]]] = {kind: [] for kind in _COLUMNS}
        self._next_state = -np.inf

    def moved(self, now: float, position: Array, velocity: Array, acceleration: Array, yaw: float,
              armed: bool, mode: str) -> None:
        """Record a true state, unless the last record is too recent."""
        if now >= self._next_state:
            self._next_state = now + 0.99 / STATE_RATE
            self._rows['state'].append((now, position.copy(), velocity.copy(),
                                        acceleration.copy(), yaw, armed, mode))

    def received(self, message: Any, now: float) -> None:
        """Record a setpoint or an ODOMETRY received at ``now``; others do not count."""
        kind = message.get_type()
        if kind == 'SET_POSITION_TARGET_LOCAL_NED':
            self._rows[kind].append((now, message.type_mask, message.coordinate_frame,
                                     ned_to_enu([message.afx, message.afy, message.afz]),
                                     yaw_ned_to_enu(message.yaw)))
        elif kind == 'ODOMETRY':
            self._rows[kind].append((now, message.time_usec, message.frame_id))

    def arrays(self) -> dict[str, Any]:
        """Return the log as arrays by name."""
        columns = {name: np.array([row[i] for row in rows]) for kind, rows in self._rows.items()
                   for i, name in enumerate(_COLUMNS[kind])}
        columns['setpoint_acceleration'] = columns['setpoint_acceleration'].reshape(-1, 3)
        return columns

    def save(self, path: str) -> None:
        """Write the log to a .npz file."""
        with open(path, 'wb') as file:
            np.savez_compressed(file, **self.arrays())
