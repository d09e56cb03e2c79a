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

"""The log of a flight: arrays in a .npz file."""

from __future__ import annotations

from io import BytesIO
from typing import Any, Final

import numpy as np

from flock_follower.geometry import Array
from flock_follower.mavlink.ned import ned_to_enu, yaw_ned_to_enu
from flock_follower.system.whole_file import whole_file

#: The true state is logged this often, Hz.
STATE_RATE: Final[float] = 50.0
#: The arrays, by the kind of row that fills them.
_COLUMNS: Final = {
    'state': ('state_time', 'position', 'velocity', 'acceleration', 'yaw', 'armed', 'mode'),
    'SET_POSITION_TARGET_LOCAL_NED': (
        'setpoint_time', 'setpoint_type_mask', 'setpoint_frame', 'setpoint_acceleration',
        'setpoint_yaw'),
    'ODOMETRY': ('odometry_time', 'odometry_time_usec', 'odometry_frame'),
    'odom': ('odom_stamp', 'odom_position', 'odom_quaternion', 'odom_velocity'),
    'image': (
        'image_stamp', 'image_usable', 'follower_position', 'follower_quaternion',
        'follower_velocity', 'leader_position', 'leader_quaternion', 'leader_velocity'),
    'planner': ('planner_time', 'planner_state'),
    'distance': ('distance_time', 'distance'),
    'picture': ('picture_stamp', 'picture')}


class FlightLog:
    """
    Collects the events of a flight; ``save`` writes them.

    Times are s on the system's monotonic clock, vectors ENU. An autopilot fills ``state_time``
    (n,), ``position``, ``velocity``, ``acceleration`` (n, 3), ``yaw`` (n,), ``armed`` (n,),
    ``mode`` (n,) names: the true state; ``setpoint_time`` (m,), ``setpoint_type_mask`` (m,),
    ``setpoint_frame`` (m,), ``setpoint_acceleration`` (m, 3), ``setpoint_yaw`` (m,);
    ``odometry_time`` (k,), ``odometry_time_usec`` (k,), ``odometry_frame`` (k,).

    The simulator node adds ``odom_*`` as sent and ``image_stamp``, ``follower_*``, ``leader_*`` as
    true at each image, with stamps (n,) in ns of ROS time, positions and velocities (n, 3) in the
    odom frame, quaternions (n, 4); ``image_usable`` (n,), whether the leader can be seen and
    placed; ``picture`` (p, height, width), some of the images, and their ``picture_stamp`` (p,);
    ``distance`` (m,), m, at ``distance_time`` (m,) and ``planner_state`` (k,) from
    ``planner_time`` (k,) on.
    """

    def __init__(self) -> None:
        self._rows: dict[str, list[tuple[Any, ...]]] = {kind: [] for kind in _COLUMNS}
        self._next_state = -np.inf

    def add(self, kind: str, *row: Any) -> None:
        """Record a row of a kind, a key of the table of columns."""
        self._rows[kind].append(row)

    def add_state(self, now: float, position: Array, velocity: Array, acceleration: Array,
                  yaw: float, armed: bool, mode: str) -> None:
        """Record a true state, unless the last record is too recent."""
        if now >= self._next_state:
            self._next_state = now + 0.99 / STATE_RATE
            self.add('state', now, position.copy(), velocity.copy(), acceleration.copy(), yaw,
                     armed, mode)

    def add_message(self, message: Any, now: float) -> None:
        """Record a setpoint or an ODOMETRY received at ``now``; others do not count."""
        kind = message.get_type()
        if kind == 'SET_POSITION_TARGET_LOCAL_NED':
            self.add(kind, now, message.type_mask, message.coordinate_frame,
                     ned_to_enu([message.afx, message.afy, message.afz]),
                     yaw_ned_to_enu(message.yaw))
        elif kind == 'ODOMETRY':
            self.add(kind, now, message.time_usec, message.frame_id)

    def arrays(self) -> dict[str, Any]:
        """Return the columns by name."""
        columns: dict[str, Any] = {
            name: np.array([row[i] for row in rows]) for kind, rows in self._rows.items()
            for i, name in enumerate(_COLUMNS[kind])}
        columns['setpoint_acceleration'] = columns['setpoint_acceleration'].reshape(-1, 3)
        return columns

    def save(self, path: str, **more: Any) -> None:
        """
        Write the log, and more arrays, to a .npz file, whole or not at all.

        :raises OSError: naming the file, if it cannot be written.
        """
        packed = BytesIO()
        np.savez_compressed(packed, **self.arrays(), **more)
        with whole_file(path) as file:
            file.write(packed.getbuffer())
