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
What the planner takes in: own odometry and neighbours, and why one of them is not used.

Nothing here reads a clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import Any, NamedTuple, TypeVar

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.odometry_rhythm import Span

FUTURE_TOLERANCE = 0.1  # s a stamp may be ahead of `now`: clocks differ, and /clock comes in steps
FARTHEST = 100.0  # m: a neighbour measured farther away than this is not one
FASTEST = 50.0  # m/s: nothing that flocks is faster
TOO_UNCERTAIN = 'too uncertain'


@dataclass(frozen=True, eq=False)
class OwnState:
    """Own odometry: stamp, s; position (3,), m, and velocity (3,), m/s, in ENU; yaw, rad."""

    stamp: float
    position: Array
    velocity: Array
    yaw: float
    spans: tuple[Span, ...] = ()
    """Between which ages those before it were the newest, where that is known."""


@dataclass(frozen=True, eq=False)
class NeighborEstimate:
    """
    A neighbour in the frame of the own odometry: stamp, s; position (3,), m; velocity (3,), m/s.

    The covariances, (3, 3), are of position and velocity; zeros mean unknown. ``acceleration``
    (3,), m/s^2, is None where the estimate has none.
    """

    name: str
    stamp: float
    position: Array
    velocity: Array
    position_covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    velocity_covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    acceleration: Array | None = None
    yaw: float | None = None
    """rad; None if it is not known."""
    heard: bool = False
    """Whether another vehicle told of it, instead of the own eyes."""


Moving = TypeVar('Moving', OwnState, NeighborEstimate)


class Rejection(NamedTuple):
    """An input that was not used: a short reason to count under, and the detail to log."""

    reason: str
    detail: str


def implausible(moving: Moving) -> Rejection | None:
    """Return what is wrong with a state as such, or None."""
    if np.shape(moving.position) != (3,) or np.shape(moving.velocity) != (3,):
        return Rejection('malformed', 'position and velocity must have 3 components')
    numbers = [moving.stamp, *moving.position.tolist(), *moving.velocity.tolist()]
    if isinstance(moving, OwnState):
        numbers.append(moving.yaw)
    elif moving.acceleration is not None:
        if np.shape(moving.acceleration) != (3,):
            return Rejection('malformed', 'acceleration must have 3 components')
        numbers += moving.acceleration.tolist()
    if not all(map(math.isfinite, numbers)):
        return Rejection('not finite', 'holds NaN or infinity')
    speed = math.hypot(*moving.velocity.tolist())
    return Rejection('too fast', f'{speed:.3g} m/s') if speed > FASTEST else None


def untimely(stamp: float, now: float, oldest: float) -> Rejection | None:
    """Return whether a stamp is ahead of ``now`` or older than ``oldest``, s, or None."""
    age = now - stamp
    if age < -FUTURE_TOLERANCE:
        return Rejection('ahead of the clock', f'by {-age:.2f} s')
    return None if age <= oldest else Rejection('too old', f'{age:.2f} s')


def uncertain(n: NeighborEstimate, max_position_std: float,
              max_velocity_std: float) -> Rejection | None:
    """Return which standard deviation, sqrt(trace), is too large or not known, or None."""
    for name, covariance, most in (
            ('position', n.position_covariance, max_position_std),
            ('velocity', n.velocity_covariance, max_velocity_std)):
        variance = float(covariance.trace())
        if not 0.0 <= variance <= most ** 2:  # NaN is uncertain, and -1 means unknown to some
            return Rejection(TOO_UNCERTAIN, f'variance of its {name} {variance:.3g}')
    return None


def far(n: NeighborEstimate, own: OwnState | None) -> Rejection | None:
    """Return whether a neighbour is farther away than any can be seen, or None."""
    distance = 0.0 if own is None else math.dist(n.position, own.position)
    return Rejection('too far', f'{distance:.3g} m') if distance > FARTHEST else None


def at(moving: Moving, now: float) -> Moving:
    """Return the state carried to ``now`` with constant velocity."""
    position = moving.position + (now - moving.stamp) * moving.velocity
    # Written out: with many neighbours dataclasses.replace takes as long as all the rest.
    moved: Any = OwnState(
        now, position, moving.velocity, moving.yaw, moving.spans
    ) if isinstance(moving, OwnState) else NeighborEstimate(
        moving.name, now, position, moving.velocity, moving.position_covariance,
        moving.velocity_covariance, moving.acceleration, moving.yaw, moving.heard)
    return moved
