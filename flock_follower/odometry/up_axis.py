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
Which axis of base_link points up, as the attitudes say: on a vehicle that flies it is z.

Where it is another one, the odometry's child frame lies otherwise on base_link than it is told to.
What points ahead cannot be seen so: a quadrotor flies to all sides.
"""

from __future__ import annotations

import math
from typing import Final

from flock_follower.geometry import Array

#: In which time the mean follows, s.
MEAN_TIME: Final[float] = 2.0
#: Attitudes are looked at so far apart at least, s.
PERIOD: Final[float] = 0.05
#: An axis points up while the mean of its upward part is above this, which is 45 degrees.
UPWARD: Final[float] = 0.7


class UpAxis:
    """Watches attitudes."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget what was seen."""
        self._stamp: float | None = None
        self._up = [0.0, 0.0, 0.0]  # in base_link, mean

    def take(self, stamp: float, rotation: Array) -> None:
        """Take an attitude (3, 3), base_link to odom, at a stamp, s."""
        before = stamp if self._stamp is None else self._stamp
        if self._stamp is not None and stamp - before < PERIOD:
            return
        share = 1.0 if self._stamp is None else 1.0 - math.exp((before - stamp) / MEAN_TIME)
        self._up = [old + share * (new - old) for old, new in zip(self._up, rotation[2].tolist())]
        self._stamp = stamp

    @property
    def axis(self) -> str:
        """Return the axis that points up, 'x', '-x', 'y', ..., or '' where none does."""
        k = max(range(3), key=lambda axis: abs(self._up[axis]))
        upward = self._up[k]
        return '' if abs(upward) < UPWARD else ('-' if upward < 0.0 else '') + 'xyz'[k]

    @property
    def fault(self) -> str:
        """Return what is wrong where another axis than z points up, else ''."""
        if self.axis in ('', 'z'):
            return ''
        return (f'base_link has {self.axis} up instead of z: set odom_child_rpy to how the child '
                'frame of odom lies on it')
