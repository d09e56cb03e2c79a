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

"""A command of the planner; ``command_writer`` and ``command_reader`` have its message."""

from __future__ import annotations

import math
from typing import NamedTuple

from numpy.typing import ArrayLike

from flock_follower.geometry import Array
from flock_follower.messages import NANOSECONDS, stamp_age

#: The names of further joints of a command, see ``command_writer``; all are on the wire.
SEPARATION_JOINT, ALTITUDE_JOINT, RETREAT_JOINT = 'separation', 'altitude', 'retreat'
#: Time without odometry, s, for which the gate keeps the velocity of the retreat.
ODOMETRY_GAP = 3.0
#: Largest acceleration without odometry, m/s^2: by 1 m/s^2 a quadrotor tilts by 6 degrees.
RELATIVE_ACCELERATION_MAX = 1.0
#: Oldest image that such a command may rest on, s.
OLDEST_MARKER = 0.5


class Command(NamedTuple):
    """
    A command of the planner, from its tick to the setpoint gate.

    ``stamp``, ns, is the stamp of the estimate on which the command is based, 0 without an
    estimate. The command applies ``ahead`` ns later.
    """

    acceleration: ArrayLike
    """(3,), m/s^2, in the frame ``frame``."""
    yaw: float
    """rad."""
    yaw_rate: float = 0.0
    """rad/s, anticlockwise."""
    separation_axis: Array | None = None
    """
    Unit vector (3,) away from a neighbor that would come too near: limits reduce the acceleration
    along this vector last. None without such a neighbor.
    """
    frame: str = ''
    stamp: int = 0
    ahead: int = 0
    altitude: float = math.nan
    """The commanded altitude, m, in the frame ``frame``; NaN without one."""
    relative: bool = False
    """
    Whether the command is based on the marker alone, without odometry; its frame is then
    ``RELATIVE``.
    """
    retreat: Array | None = None
    """Velocity (3,), m/s, to brake to if odometry is lost: away from an approaching neighbor. None
    without such a neighbor."""

    def ages(self, now: int) -> tuple[float, float]:
        """Return the ages of the command and of its image, s, at a time, ns."""
        source = stamp_age(self.stamp, now)
        return source - (self.ahead / NANOSECONDS if self.stamp > 0 else 0.0), source
