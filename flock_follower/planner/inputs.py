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
Inputs of the planner: own odometry and neighbors, their validity, and their prediction.

Odometry is overdue by the rhythm of its messages. Between two messages it grows old by nature: at
10 Hz and 60 ms of latency it is 0.06 s old on arrival, and 0.16 s just before the next arrives. A
fast source is overdue at ``LATE`` of the timeout, a slow one if it becomes older than usual. A
source whose odometry is usually too old, on average or at its oldest, is too slow to fly on.

Nothing here reads a clock. The assumptions about a neighbor at the time when a command acts:

1. It goes on with the velocity of its newest estimate, and with its acceleration, where that is
   believable, for at most TRUSTED_TIME; both until the command acts, ``response_time`` from now.
   What is as small as the noise of an estimated acceleration, a, counts as
   a / (1 + (ACCELERATION_NOISE / a)^4): taken as it is, it makes the guard twitch.
2. If the estimate is older than SEEN, its acceleration may make the vehicle keep farther away,
   but not follow: never chase a guess.
3. Up to FRESH the guard's margin covers what else it may do, and up to ``heard_timeout`` where it
   was told of: words are that late wherever some are lost, of vehicles that fly on. From then on
   it may be anywhere that an acceleration of ``leader_acceleration_max`` takes it to, at up to
   ``leader_speed_max``: in a sphere that grows, around the place of 1.
4. Commands that were sent and not yet flown will be flown: they count as velocity.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import Any, NamedTuple, TypeVar

import numpy as np

from flock_follower.geometry import Array
from flock_follower.messages import FARTHEST, FASTEST, FUTURE_TOLERANCE
from flock_follower.planner.limits import limit_norm
from flock_follower.planner.params import PlannerParams

LATE = 0.5  # share of the timeout: younger odometry is never overdue
LATEST = 0.8  # share of the timeout: older odometry always is, to brake before commands end
OVERDUE = 1.2  # times the greatest age that the last ones reached
AVERAGE = 0.55  # share of the timeout: older on average than this it is too slow
STEADY = 0.9  # hysteresis: once too slow, the limits are this much tighter
REMEMBERED = 20  # messages: 2 s at 10 Hz, but a hiccup at 60 Hz is forgotten in 0.3 s


class Span(NamedTuple):
    """The ages, s, between which one odometry was the newest: on arrival, and when replaced."""

    first: float
    last: float


class Rhythm:
    """Between which ages the last few odometry messages were the newest."""

    def __init__(self) -> None:
        self._stamp: int | None = None
        self._arrived = 0
        self.spans: deque[Span] = deque(maxlen=REMEMBERED)
        """Of those that have been replaced already."""

    def take(self, stamp: int, now: int) -> None:
        """Note that odometry of a stamp arrived at a time, both in ns."""
        if stamp == self._stamp:
            return
        if self._stamp is not None:
            if stamp > self._stamp:
                first, last = ((time - self._stamp) * 1e-9 for time in (self._arrived, now))
                self.spans.append(Span(first, last))
            else:
                self.spans.clear()  # the clock jumped back, or another source took over
        self._stamp, self._arrived = stamp, now


def too_slow(spans: Sequence[Span], timeout: float, before: bool) -> float | None:
    """
    Return the age, s, that odometry usually reaches if it is too slow to fly on, else None.

    :param timeout: age at which odometry is not used at all, s.
    :param before: whether it was too slow up to now.
    """
    if not spans:
        return None
    usual = sorted(spans, key=sum)[len(spans) // 2]
    share = timeout * (STEADY if before else 1.0)
    slow = usual.last > LATEST * share or 0.5 * sum(usual) > AVERAGE * share
    return usual.last if slow else None


def overdue(age: float, spans: Sequence[Span], timeout: float) -> bool:
    """Return whether odometry of an age, s, should have been replaced by now."""
    longest = OVERDUE * max((span.last for span in spans), default=0.0)
    return age > min(max(LATE * timeout, longest), LATEST * timeout)


TOO_UNCERTAIN = 'too uncertain'
TOUCHING = 1e-6  # m: nearer than this there is no direction


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
class Neighbor:
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


Moving = TypeVar('Moving', OwnState, Neighbor)


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


def uncertain(n: Neighbor, max_position_std: float,
              max_velocity_std: float) -> Rejection | None:
    """Return which standard deviation, sqrt(trace), is too large or not known, or None."""
    for name, covariance, most in (
            ('position', n.position_covariance, max_position_std),
            ('velocity', n.velocity_covariance, max_velocity_std)):
        variance = float(covariance.trace())
        if not 0.0 <= variance <= most ** 2:  # NaN is uncertain, and -1 means unknown to some
            return Rejection(TOO_UNCERTAIN, f'variance of its {name} {variance:.3g}')
    return None


def far(n: Neighbor, own: OwnState | None) -> Rejection | None:
    """Return whether a neighbour is farther away than any can be seen, or None."""
    distance = 0.0 if own is None else math.dist(n.position, own.position)
    return Rejection('too far', f'{distance:.3g} m') if distance > FARTHEST else None


def at(moving: Moving, now: float) -> Moving:
    """Return the state carried to ``now`` with constant velocity."""
    position = moving.position + (now - moving.stamp) * moving.velocity
    # Written out: with many neighbours dataclasses.replace takes as long as all the rest.
    moved: Any = OwnState(
        now, position, moving.velocity, moving.yaw, moving.spans
    ) if isinstance(moving, OwnState) else Neighbor(
        moving.name, now, position, moving.velocity, moving.position_covariance,
        moving.velocity_covariance, moving.acceleration, moving.yaw, moving.heard)
    return moved


def distance_known(n: Neighbor, own: OwnState | None, max_position_std: float) -> bool:
    """
    Return whether the distance is known of one whose position is too uncertain.

    It is where its variance is at most a third of what is admitted of a position's three axes: of
    what is equally uncertain in all of them nothing is known.
    """
    if own is None:
        return False
    sight = n.position - own.position - (n.stamp - own.stamp) * own.velocity
    distance, most = math.hypot(*sight.tolist()), max_position_std ** 2
    if not (distance > TOUCHING and float(n.position_covariance.trace()) > most):
        return False
    return 0.0 <= variance_along(n, sight / distance) <= most / 3.0


def variance_along(n: Neighbor, along: Array) -> float:
    """Return the variance, m^2, of a neighbor's position along a unit vector (3,)."""
    return float(along @ n.position_covariance @ along)


TRUSTED_ACCELERATION = 2.0  # m/s^2: more is taken for a jump of the estimate
ACCELERATION_NOISE = 0.35  # m/s^2: a neighbour's acceleration below this is mostly noise
TRUSTED_TIME = 1.0  # s for which a neighbour is expected to go on accelerating as it did
SEEN = 0.25  # s: with an older estimate its acceleration is a guess that is not followed
FRESH = 0.12  # s up to which the guard's margin covers what else a neighbour may do


class Expected(NamedTuple):
    """A neighbour, as far as it can be known, when a command acts."""

    position: Array
    """(3,), m, now."""
    velocity: Array
    """(3,), m/s."""
    acceleration: Array
    """(3,), m/s^2."""
    spread: float
    """How far from there it may be, m ..."""
    spreading: float
    """... and how fast that grows, m/s."""


def expected(n: Neighbor, acceleration: Array, age: float,
             params: PlannerParams) -> Expected:
    """Return what to expect of a neighbour whose estimate is of an age, s."""
    its = limit_norm(acceleration, TRUSTED_ACCELERATION)
    share = (math.hypot(*its.tolist()) / ACCELERATION_NOISE) ** 4
    its = its * (share / (1.0 + share))
    known = min(max(age, 0.0), TRUSTED_TIME)
    position = n.position + age * n.velocity + known * (age - 0.5 * known) * its
    velocity = n.velocity + min(age + params.response_time, TRUSTED_TIME) * its
    fresh = params.heard_timeout if n.heard else FRESH
    blind, most = max(age - fresh, 0.0), params.leader_acceleration_max
    fastest = params.leader_speed_max + math.hypot(*n.velocity.tolist())
    speeding = min(blind, fastest / most) if most > 0.0 else 0.0
    return Expected(position, velocity, its if age < TRUSTED_TIME else np.zeros(3),
                    most * speeding * (blind - 0.5 * speeding), most * speeding)


def unflown(before: Array, command: Array, elapsed: float, params: PlannerParams) -> Array:
    """Return the velocity that is commanded and not flown one period from now, (3,), m/s."""
    if params.response_time == 0.0:
        return np.zeros(3)
    left = math.exp(-elapsed / params.response_time)
    return left * before + (1.0 - left) * params.response_time * command


def since_measured(age: float, params: PlannerParams) -> float:
    """
    Return how many times what ``unflown`` tells has not been flown when a velocity was measured.

    As it is flown with the time constant ``response_time``, it is being flown at that rate.

    :param age: of the velocity, s.
    """
    return 1.0 + max(age, 0.0) / params.response_time if params.response_time > 0.0 else 1.0
