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
One step of the planner: from the newest estimates to one safe acceleration.

=======  ================================================  ===================================
state    when                                              horizontal command
=======  ================================================  ===================================
IDLE     not engaged                                       none at all
SEARCH   engaged, no fresh estimate since                  brake to a hover
TRACK    an estimate of at most ``predict_timeout``        the flocking law
COAST    the last one used at most ``coast_timeout`` old   zero acceleration
HOLD     all are older than that                           brake to a hover
=======  ================================================  ===================================

Without fresh odometry no state gives a command. Estimates and odometry are carried to the time of
the command with constant velocity. Nothing here reads a clock: equal inputs give equal outputs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
import enum
import math
from typing import ClassVar, NamedTuple, TypeVar

import numpy as np

from flock_follower.flocking import acceleration, FlockingParams, Range
from flock_follower.geometry import Array
from flock_follower.guard import brake, limit_command, limit_norm, LimitedCommand

FUTURE_TOLERANCE = 0.1  # s a stamp may be ahead of `now`: clocks differ, and /clock comes in steps
ODOMETRY_JUMP = 1.0  # m: beyond it the frame has moved, and with it altitude and neighbours
FARTHEST = 100.0  # m: a neighbour measured farther away than this is not one
FASTEST = 50.0  # m/s: nothing that flocks is faster
OVERHEAD = 0.1  # m: closer than this horizontally, the direction to a neighbour is noise

YAW_MODES = ('leader', 'hold')


class State(str, enum.Enum):
    """The planner's states, from the freshness of its inputs."""

    IDLE = 'IDLE'
    SEARCH = 'SEARCH'
    TRACK = 'TRACK'
    COAST = 'COAST'
    HOLD = 'HOLD'


@dataclass(frozen=True)
class PlannerParams:
    """
    The parameters of a flight; the law's band of 1 to 8 m^2 and the limits are the paper's.

    :raises ValueError: naming the parameter, its value and the valid range.
    """

    law: FlockingParams = field(default_factory=lambda: FlockingParams(beta=0.25, d1=8.0))
    a_max: float = 2.5
    """Largest acceleration, a vector norm, m/s^2."""
    v_max: float = 0.5
    """Largest speed, a vector norm, m/s."""
    period: float = 0.1
    """Time from one step to the next, s."""
    predict_timeout: float = 0.5
    """Age up to which an estimate is extrapolated and followed, s."""
    coast_timeout: float = 2.0
    """Age of the last estimate followed up to which the follower coasts, s."""
    odom_timeout: float = 0.3
    """Age up to which the own odometry is used, s."""
    max_position_std: float = 0.5
    """Largest standard deviation of a usable position, sqrt(trace), m."""
    max_velocity_std: float = 1.0
    """Largest standard deviation of a usable velocity, sqrt(trace), m/s."""
    brake_time_constant: float = 0.3
    """Time in which braking reduces the speed to 37 %, s."""
    altitude_hold: bool = True
    """Whether to hold the altitude of the engagement; otherwise the law acts vertically too."""
    altitude_frequency: float = 1.5
    """Natural frequency of the critically damped altitude hold, rad/s."""
    max_vertical_acceleration: float = 1.0
    """Largest vertical acceleration of the altitude hold, m/s^2."""
    yaw_mode: str = 'leader'
    """Whether to face the nearest neighbour ('leader') or keep the yaw ('hold')."""

    RANGES: ClassVar[dict[str, Range]] = {
        'a_max': Range(0.1, 20.0, 'm/s^2'),
        'v_max': Range(0.05, 20.0, 'm/s'),
        'period': Range(0.02, 1.0, 's'),
        'predict_timeout': Range(0.05, 2.0, 's'),
        'coast_timeout': Range(0.05, 10.0, 's'),
        'odom_timeout': Range(0.02, 2.0, 's'),
        'max_position_std': Range(0.01, 10.0, 'm'),
        'max_velocity_std': Range(0.01, 10.0, 'm/s'),
        'brake_time_constant': Range(0.1, 5.0, 's'),
        'altitude_frequency': Range(0.1, 5.0, 'rad/s'),
        'max_vertical_acceleration': Range(0.1, 10.0, 'm/s^2'),
    }

    def __post_init__(self) -> None:
        for f in fields(self):
            if f.name in self.RANGES:
                self.RANGES[f.name].check(f.name, getattr(self, f.name))
        if self.coast_timeout < self.predict_timeout:
            raise ValueError(
                f'coast_timeout = {self.coast_timeout!r}: must be in [predict_timeout, '
                f'{self.RANGES["coast_timeout"].high:g}] s, where predict_timeout = '
                f'{self.predict_timeout!r}')
        if self.yaw_mode not in YAW_MODES:
            raise ValueError(
                f'yaw_mode = {self.yaw_mode!r}: must be one of {", ".join(YAW_MODES)}')


@dataclass(frozen=True, eq=False)
class OwnState:
    """Own odometry: stamp, s; position (3,), m, and velocity (3,), m/s, in ENU; yaw, rad."""

    stamp: float
    position: Array
    velocity: Array
    yaw: float


@dataclass(frozen=True, eq=False)
class NeighborEstimate:
    """
    A neighbour in the frame of the own odometry: stamp, s; position (3,), m; velocity (3,), m/s.

    The covariances, (3, 3), are of position and velocity; zeros mean unknown.
    """

    name: str
    stamp: float
    position: Array
    velocity: Array
    position_covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    velocity_covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))


Moving = TypeVar('Moving', OwnState, NeighborEstimate)


@dataclass(frozen=True, eq=False)
class Memory:
    """What one step hands to the next; ``Memory()`` is the start."""

    now: float | None = None
    own: OwnState | None = None
    neighbors: Mapping[str, NeighborEstimate] = field(default_factory=dict)
    followed: float | None = None
    """Stamp of the newest estimate followed since engaging, s."""
    altitude: float | None = None
    """Altitude held since engaging, m."""
    yaw: float | None = None
    """Yaw last commanded since engaging, rad."""


class Rejection(NamedTuple):
    """An input that was not used: a short reason to count under, and the detail to log."""

    reason: str
    detail: str


@dataclass(frozen=True, eq=False)
class Decision:
    """The outcome of one step."""

    state: State
    reason: str = ''
    """Why this state, where it is not TRACK."""
    acceleration: Array | None = None
    """Commanded acceleration (3,), m/s^2, ENU; None: no command may be sent."""
    yaw: float | None = None
    """Commanded yaw, rad, ENU; None exactly where the acceleration is None."""
    stamp: float | None = None
    """Stamp of the newest estimate the command rests on, s; None if it rests on none."""
    limits: str = ''
    """The limits that bound: '', 'a_max', 'v_max' or 'a_max, v_max'."""
    rejected: tuple[Rejection, ...] = ()


def step(memory: Memory, now: float, engaged: bool, own: OwnState | None,
         neighbors: Iterable[NeighborEstimate],
         params: PlannerParams) -> tuple[Memory, Decision]:
    """
    Decide the command for the time ``now``, and return it after the memory for the next step.

    :param now: time of this step, s; a step back by more than 0.1 s forgets everything.
    :param engaged: whether commands are wanted; engaging captures altitude and yaw.
    :param own: the newest odometry that arrived since the last step, or None.
    :param neighbors: the estimates that arrived since the last step; of each name the newest
        counts. Handing in the same one again does no harm.
    """
    memory, rejected = _ingest(memory, now, own, neighbors, params)
    fault = odometry_fault(memory.own, now, params)
    newest = max((n.stamp for n in memory.neighbors.values()), default=None)
    state, reason = next_state(
        engaged, fault, None if newest is None else now - newest,
        None if memory.followed is None else now - memory.followed, params)
    if state is State.IDLE:
        idle = replace(memory, followed=None, altitude=None, yaw=None)
        return idle, Decision(state, reason, rejected=rejected)
    if memory.own is None or fault:
        return memory, Decision(state, reason, rejected=rejected)

    me = _at(memory.own, now)
    memory = replace(memory, altitude=_held_altitude(memory.altitude, me, params),
                     yaw=me.yaw if memory.yaw is None else memory.yaw)
    if state is State.TRACK:
        flock = [_at(n, now) for n in memory.neighbors.values()]
        offsets = np.array([n.position - me.position for n in flock])
        wanted = acceleration(
            offsets, np.array([n.velocity - me.velocity for n in flock]), params.law)
        memory = replace(memory, followed=newest, yaw=_wanted_yaw(memory.yaw, offsets, params))
    elif state is State.COAST:
        wanted = np.zeros(3)
    else:
        wanted = brake(me.velocity, params.a_max, params.brake_time_constant)
    command = _limited(wanted, me, memory.altitude, params)
    return memory, Decision(state, reason, command.acceleration, memory.yaw,
                            newest if state is State.TRACK else None, command.reason, rejected)


def next_state(engaged: bool, fault: str, youngest: float | None, followed: float | None,
               params: PlannerParams) -> tuple[State, str]:
    """
    Return the state, and the reason for it where it is not TRACK.

    :param fault: what is wrong with the own odometry, or ''.
    :param youngest: age of the youngest estimate at hand, s, or None.
    :param followed: age of the newest estimate followed since engaging, s, or None.
    """
    if not engaged:
        return State.IDLE, 'not engaged'
    if fault:
        return State.SEARCH if followed is None else State.HOLD, fault
    if youngest is not None and youngest <= params.predict_timeout:
        return State.TRACK, ''
    if followed is None:
        return State.SEARCH, 'no neighbor seen since engaging'
    reason = f'no neighbor seen for {followed:.1f} s'
    return State.COAST if followed <= params.coast_timeout else State.HOLD, reason


def odometry_fault(own: OwnState | None, now: float, params: PlannerParams) -> str:
    """Return why odometry taken in earlier cannot be flown on at the time ``now``, or ''."""
    if own is None:
        return 'no odometry'
    fault = _untimely(own.stamp, now, params.odom_timeout)
    return f'odometry {fault.reason} ({fault.detail})' if fault else ''


def _ingest(memory: Memory, now: float, own: OwnState | None,
            neighbors: Iterable[NeighborEstimate],
            params: PlannerParams) -> tuple[Memory, tuple[Rejection, ...]]:
    """Return the memory with the new inputs that pass and without what grew old, and the rest."""
    rejected = []
    if memory.now is not None and now < memory.now - FUTURE_TOLERANCE:
        rejected.append(Rejection('time jumped back', f'by {memory.now - now:.1f} s'))
        memory = Memory()
    if own is not None:
        problem = _implausible(own) or _untimely(own.stamp, now, params.odom_timeout)
        if problem:
            rejected.append(Rejection(f'odometry {problem.reason}', problem.detail))
        elif memory.own is None or own.stamp >= memory.own.stamp:
            jump = 0.0 if memory.own is None else math.dist(
                own.position, _at(memory.own, own.stamp).position)
            if jump > ODOMETRY_JUMP:
                rejected.append(Rejection('odometry jumped', f'by {jump:.2f} m'))
                memory = replace(memory, neighbors={}, altitude=None)
            memory = replace(memory, own=own)
    kept = {name: n for name, n in memory.neighbors.items()
            if not _untimely(n.stamp, now, params.predict_timeout) and not _far(n, memory.own)}
    for n in neighbors:
        problem = (_implausible(n) or _untimely(n.stamp, now, params.predict_timeout)
                   or _uncertain(n, params) or _far(n, memory.own))
        if problem:
            rejected.append(Rejection(f'estimate {problem.reason}', f'{n.name}: {problem.detail}'))
        elif n.name not in kept or n.stamp >= kept[n.name].stamp:
            kept[n.name] = n
    return replace(memory, now=now, neighbors=kept), tuple(rejected)


def _implausible(moving: Moving) -> Rejection | None:
    numbers = [moving.stamp, *np.ravel(moving.position), *np.ravel(moving.velocity)]
    if isinstance(moving, OwnState):
        numbers.append(moving.yaw)
    if not np.all(np.isfinite(numbers)):
        return Rejection('not finite', 'holds NaN or infinity')
    if np.shape(moving.position) != (3,) or np.shape(moving.velocity) != (3,):
        return Rejection('malformed', 'position and velocity must have 3 components')
    speed = math.hypot(*moving.velocity)
    return Rejection('too fast', f'{speed:.3g} m/s') if speed > FASTEST else None


def _untimely(stamp: float, now: float, oldest: float) -> Rejection | None:
    age = now - stamp
    if age < -FUTURE_TOLERANCE:
        return Rejection('ahead of the clock', f'by {-age:.2f} s')
    return None if age <= oldest else Rejection('too old', f'{age:.2f} s')


def _uncertain(n: NeighborEstimate, params: PlannerParams) -> Rejection | None:
    for name, covariance, most in (
            ('position', n.position_covariance, params.max_position_std),
            ('velocity', n.velocity_covariance, params.max_velocity_std)):
        variance = float(np.trace(covariance))
        if not 0.0 <= variance <= most ** 2:  # NaN is uncertain, and -1 means unknown to some
            return Rejection('too uncertain', f'variance of its {name} {variance:.3g}')
    return None


def _far(n: NeighborEstimate, own: OwnState | None) -> Rejection | None:
    distance = 0.0 if own is None else math.dist(n.position, own.position)
    return Rejection('too far', f'{distance:.3g} m') if distance > FARTHEST else None


def _at(moving: Moving, now: float) -> Moving:
    """Return the state carried to ``now`` with constant velocity."""
    ahead = now - moving.stamp
    return replace(moving, stamp=now, position=moving.position + ahead * moving.velocity)


def _held_altitude(held: float | None, me: OwnState, params: PlannerParams) -> float | None:
    if not params.altitude_hold:
        return None
    return float(me.position[2]) if held is None else held


def _wanted_yaw(last: float | None, offsets: Array, params: PlannerParams) -> float | None:
    x, y, _ = offsets[np.argmin(np.linalg.norm(offsets, axis=1))]
    if params.yaw_mode != 'leader' or math.hypot(x, y) < OVERHEAD:
        return last
    return math.atan2(y, x)


def _limited(wanted: Array, me: OwnState, altitude: float | None,
             params: PlannerParams) -> LimitedCommand:
    """Return the wanted acceleration within all limits, its vertical part holding altitude."""
    if altitude is None:
        return limit_command(wanted, me.velocity, params.a_max, params.v_max, params.period)
    w = params.altitude_frequency
    most = min(params.max_vertical_acceleration, params.a_max)
    vertical = float(np.clip(w * w * (altitude - me.position[2]) - 2.0 * w * me.velocity[2],
                             -most, most))
    # Altitude first: the law's pull may be far beyond a_max and would leave nothing of it.
    horizontal = limit_norm(wanted[:2], math.sqrt(params.a_max ** 2 - vertical ** 2))
    command = limit_command([*horizontal, vertical], me.velocity, params.a_max, params.v_max,
                            params.period)
    if 'a_max' in command.reason or np.array_equal(horizontal, wanted[:2]):
        return command
    return LimitedCommand(command.acceleration, True,
                          ', '.join(filter(None, ['a_max', command.reason])))
