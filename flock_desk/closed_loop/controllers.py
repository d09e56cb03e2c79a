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
The controllers that ``flights`` compares, in place of the law, with or without the guard.

Each flies the same planner, limits, altitude and yaw. Without the guard they have no bounds:

- the two predecessors of the law, see ``flocking``;
- a PD servo, a simple alternative to this package: it keeps the middle of the band, u = P (r -
  r_m) n + D (v_L - v_F), with P = 2 1/s^2 and D = 3 1/s. Gains of 1 to 4 1/s^2 and 2 to 4 1/s were
  tried; with the gains of less jerk a leader that reverses is lost.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import numpy as np

from flock_follower.flocking import accelerations, FlockingParams, Model
from flock_follower.geometry import Array

PROPORTIONAL_GAIN = 2.0  # 1/s^2
DERIVATIVE_GAIN = 3.0  # 1/s


class PdServo(FlockingParams):
    """Keeps the middle of the band to each neighbor."""

    def command(self, offsets: Array, differences: Array) -> Array:
        distance = np.linalg.norm(offsets, axis=1, keepdims=True)
        error = distance - (math.sqrt(self.d0) + math.sqrt(self.d1)) / 2.0
        towards = offsets / np.maximum(distance, 1e-6)
        total: Array = np.sum(PROPORTIONAL_GAIN * error * towards + DERIVATIVE_GAIN * differences,
                              axis=0)
        return total


class CuckerSmale(FlockingParams):
    """Alignment alone."""

    MODEL: ClassVar[Model] = 'cucker_smale'

    def command(self, offsets: Array, differences: Array) -> Array:
        own = np.zeros((1, offsets.shape[1]))
        return accelerations(np.vstack([own, offsets]), np.vstack([own, differences]), self,
                             self.MODEL)[0]


class CuckerDong(CuckerSmale):
    """The law without cohesion."""

    MODEL = 'cucker_dong'


class Controller(NamedTuple):
    """A controller, its title in figures, and whether the guard bounds its commands."""

    title: str
    law: type[FlockingParams]
    guard: bool = False


#: Those that flocks fly, too.
IN_FLOCKS = 'law', 'guard'
#: By key of flights.json.
CONTROLLERS = {'law': Controller('law', FlockingParams),
               'guard': Controller('law and guard', FlockingParams, True),
               'pd': Controller('PD servo', PdServo),
               'cucker_smale': Controller('Cucker-Smale', CuckerSmale),
               'cucker_dong': Controller('Cucker-Dong', CuckerDong)}
