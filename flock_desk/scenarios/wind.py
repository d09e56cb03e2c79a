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

"""The wind of simulated flights."""

from __future__ import annotations

import math

import numpy as np

from flock_desk.scenarios.scenario import Wind
from flock_follower.geometry import Array


def wind_course(wind: Wind, count: int, period: float, rng: np.random.Generator) -> Array:
    """Return the air's velocity (count, 3), m/s, ENU, every period, s, in one run."""
    direction = rng.uniform(-math.pi, math.pi)
    speed = rng.uniform(*wind.speed)
    steady = speed * np.array([math.cos(direction), math.sin(direction), 0.0])
    keep = math.exp(-period / wind.gust_time)
    fresh = wind.gust * rng.standard_normal((count, 3)) * [1.0, 1.0, 0.5]
    gusts = fresh
    for k in range(1, count):
        gusts[k] = keep * gusts[k - 1] + math.sqrt(1.0 - keep * keep) * fresh[k]
    return steady + gusts
