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
Inputs of the planner (ego odometry and neighbors): their validity and prediction.

No function reads a clock. The assumptions about a neighbor at the time when a command acts,
``response_time`` from now:

1. The neighbor keeps the velocity of its newest estimate. It also keeps the acceleration, if
   plausible, for at most TRUSTED_TIME. A small acceleration a, similar to the noise of an
   estimate, counts as a / (1 + (ACCELERATION_NOISE / a)^4): otherwise the noise would cause jerk.
2. If the estimate is older than MAX_ACCELERATION_AGE, its acceleration may only increase the
   distance that the vehicle keeps: the vehicle never follows a guess.
3. While the estimate is younger than FRESH (``heard_timeout`` if received from another vehicle),
   the guard's margin covers deviations from assumption 1. Later the neighbor may be anywhere in a
   sphere around the place of assumption 1, which grows with ``leader_acceleration_max`` and
   ``leader_speed_max``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math
from typing import NamedTuple, TypeVar

import numpy as np

from flock_follower.geometry import Array, SHORTEST
from flock_follower.messages import FARTHEST, FASTEST, FUTURE_TOLERANCE
from flock_follower.planner.limits import limit_norm
from flock_follower.planner.params import Member, PlannerParams, SEEN_DEFAULT


class OwnState(NamedTuple):
    """Own odometry: stamp, s; position (3,), m, and velocity (3,), m/s, in ENU; yaw, rad."""

    stamp: float
    position: Array
    velocity: Array
    yaw: float
    ages: tuple[float, ...] = ()
    """Ages, s, of earlier messages when the next message replaced them; () if unknown."""
    relative: bool = False
    """Whether this is the motion without odometry, in the frame ``messages.RELATIVE``."""


UNKNOWN: Array = np.zeros((3, 3))


class Neighbor(NamedTuple):
    """
    A neighbor in the frame of the ego odometry: stamp, s; position (3,), m; velocity (3,), m/s.

    The covariances, (3, 3), are of position and velocity; zeros mean unknown. ``acceleration``
    (3,), m/s^2, and ``yaw``, rad, are None if the estimate has none.
    """

    name: str
    stamp: float
    position: Array
    velocity: Array
    position_covariance: Array = UNKNOWN
    velocity_covariance: Array = UNKNOWN
    acceleration: Array | None = None
    yaw: float | None = None
    received: bool = False
    """Whether another vehicle reported the neighbor; if not, an ego camera sees it."""
    member: Member = SEEN_DEFAULT
    """Role and size of the neighbor, from the neighbors' file."""


Moving = TypeVar('Moving', OwnState, Neighbor)


class Rejection(NamedTuple):
    """The rejection of an input: a short reason, which is counted, and the detail for the log."""

    reason: str
    detail: str


def implausible(moving: OwnState | Neighbor) -> Rejection | None:
    """Return the rejection of a state that is not finite or too fast, or None."""
    more = [moving.yaw] if isinstance(moving, OwnState) else (
        [] if moving.acceleration is None else moving.acceleration.tolist())
    numbers = [moving.stamp, *moving.position.tolist(), *moving.velocity.tolist(), *more]
    if not all(map(math.isfinite, numbers)):
        return Rejection('not finite', 'holds NaN or infinity')
    speed = math.hypot(*moving.velocity.tolist())
    return Rejection('too fast', f'{speed:.3g} m/s') if speed > FASTEST else None


def untimely(stamp: float, now: float, oldest: float) -> Rejection | None:
    """Return the rejection of a stamp ahead of ``now`` or older than ``oldest``, s, or None."""
    age = now - stamp
    if age < -FUTURE_TOLERANCE:
        return Rejection('ahead of the clock', f'by {-age:.2f} s')
    return None if age <= oldest else Rejection('too old', f'{age:.2f} s')


def uncertain(n: Neighbor, params: PlannerParams) -> Rejection | None:
    """Return the rejection of a standard deviation that is too large or unknown, or None."""
    for name, covariance, most in (
            ('position', n.position_covariance, params.max_position_std),
            ('velocity', n.velocity_covariance, params.max_velocity_std)):
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = covariance.tolist()
        variance = xx + yy + zz
        if not 0.0 <= variance <= most ** 2:  # NaN is uncertain; some sources send -1 for unknown
            return Rejection('too uncertain', f'variance of its {name} {variance:.3g}')
        if not (abs(xy + yx) <= variance and abs(xz + zx) <= variance
                and abs(yz + zy) <= variance):
            return Rejection('too uncertain', f'invalid covariance of its {name}')
    return None


def too_far(n: Neighbor, own: OwnState | None) -> Rejection | None:
    """Return the rejection of a neighbor that is too far away to be seen, or None."""
    distance = 0.0 if own is None else math.dist(n.position.tolist(), own.position.tolist())
    return Rejection('too far', f'{distance:.3g} m') if distance > FARTHEST else None


def propagate(moving: Moving, now: float) -> Moving:
    """Return the state predicted for ``now`` with constant velocity."""
    return moving._replace(
        stamp=now, position=moving.position + (now - moving.stamp) * moving.velocity)


def find_newest(neighbors: Iterable[Neighbor], own: OwnState) -> Neighbor | None:
    """Return the newest estimate; of equally new estimates the nearest, then the first by name."""
    return min(neighbors, default=None, key=lambda n: (
        -n.stamp, math.dist(n.position, own.position), n.name))


def distance_known(n: Neighbor, own: OwnState | None, max_position_std: float) -> bool:
    """
    Return whether the distance of a neighbor with a too uncertain position is known.

    The distance is known if its variance is at most a third of the variance admitted for a whole
    position. A position that is equally uncertain along all axes gives no distance.
    """
    if own is None:
        return False
    sight = n.position - own.position - (n.stamp - own.stamp) * own.velocity
    distance, most = math.hypot(*sight.tolist()), max_position_std ** 2
    if not (distance > SHORTEST and float(n.position_covariance.trace()) > most):
        return False
    along = sight / distance
    return 0.0 <= float(along @ n.position_covariance @ along) <= most / 3.0


TRUSTED_ACCELERATION = 2.0  # m/s^2: a larger one counts as a jump of the estimate
ACCELERATION_NOISE = 0.2  # m/s^2: an acceleration of a neighbor below this is mostly noise
TRUSTED_TIME = 1.0  # s for which a neighbor is expected to keep its acceleration
MAX_ACCELERATION_AGE = 0.25  # s: the acceleration of an older estimate is a guess, not followed
FRESH = 0.12  # s up to which the guard's margin covers deviations of a neighbor's motion


class Prediction(NamedTuple):
    """
    The prediction of a neighbor for the time when a command acts.

    The vectors are lists, because arrays of three numbers take several times as long.
    """

    position: list[float]
    """Position (3,), m, now."""
    velocity: list[float]
    """Velocity (3,), m/s."""
    acceleration: list[float]
    """(3,), m/s^2."""
    spread: float
    """Largest distance of the neighbor from ``position``, m."""
    spreading: float
    """Growth rate of ``spread``, m/s."""
    later: list[float]
    """Velocity (3,), m/s, after TRUSTED_TIME if the acceleration continues."""


def predict(n: Neighbor, acceleration: Sequence[float], age: float,
            params: PlannerParams) -> Prediction:
    """Return the prediction of a neighbor from an estimate of an age, s."""
    velocity = n.velocity.tolist()
    size = math.hypot(*acceleration)
    if not size <= TRUSTED_ACCELERATION:
        acceleration = limit_norm(acceleration, TRUSTED_ACCELERATION).tolist()
        size = math.hypot(*acceleration)
    share = (size / ACCELERATION_NOISE) ** 4
    significant = share / (1.0 + share)
    (x, y, z), (vx, vy, vz) = n.position.tolist(), velocity
    ax, ay, az = (u * significant for u in acceleration)
    known = min(max(age, 0.0), TRUSTED_TIME)
    gained, soon = known * (age - 0.5 * known), min(age + params.response_time, TRUSTED_TIME)
    blind, most = age - (params.heard_timeout if n.received else FRESH), (
        params.leader_acceleration_max)
    speeding = min(blind, (params.leader_speed_max + math.hypot(*velocity)) / most) if (
        blind > 0.0 and most > 0.0) else 0.0
    return Prediction(
        [x + age * vx + gained * ax, y + age * vy + gained * ay, z + age * vz + gained * az],
        [vx + soon * ax, vy + soon * ay, vz + soon * az],
        [ax, ay, az] if age < TRUSTED_TIME else [0.0, 0.0, 0.0],
        most * speeding * (blind - 0.5 * speeding), most * speeding,
        [vx + TRUSTED_TIME * ax, vy + TRUSTED_TIME * ay, vz + TRUSTED_TIME * az])
