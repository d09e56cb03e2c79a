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
IDLE     not engaged, or nobody flies the commands         none at all
SEARCH   engaged, no fresh estimate since                  brake to a hover, turn to look round
TRACK    an estimate of at most ``predict_timeout``        the flocking law, guarded
COAST    the last one used at most ``coast_timeout`` old   zero, or away from a neighbour that is
                                                           predicted to come too near
HOLD     all are older than that, odometry is overdue, or  brake to a hover
         no image was processed for a while
=======  ================================================  ===================================

Braking is zero acceleration for a vehicle at rest; for one that moves, zero acceleration would
let it drift off. Without fresh odometry no state gives a command. Leaving IDLE a flight begins
anew, with the altitude and yaw of that moment: nothing of an earlier one survives. Estimates and
odometry are carried to the time of the command with constant velocity. When following begins,
begins again, or goes on with other parameters, the law's command is faded in; the guard acts on
what comes of that, and at once. Nothing here reads a clock: equal inputs give equal outputs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
import enum
import math
from typing import NamedTuple

import numpy as np

from flock_follower.flocking import acceleration
from flock_follower.geometry import Array
from flock_follower.planner.altitude_yaw import (
    facing,
    held_altitude,
    limited,
    scanning,
    turning,
    unflown,
)
from flock_follower.planner.guard import COHESION, guard, radial_bounds, RadialBounds, SEPARATION
from flock_follower.planner.inputs import (
    at,
    far,
    FUTURE_TOLERANCE,
    implausible,
    NeighborEstimate,
    OwnState,
    Rejection,
    uncertain,
    untimely,
)
from flock_follower.planner.leader_warnings import observed, reports, SmoothedMotion
from flock_follower.planner.limits import brake, limit_norm, LimitedCommand
from flock_follower.planner.odometry_rhythm import overdue, too_slow
from flock_follower.planner.params import PlannerParams

ODOMETRY_JUMP = 0.25  # m: beyond it the frame has moved, and with it altitude and neighbours
NEIGHBOR_JUMP = 1.0  # m: an estimate this far from the prediction is of somebody else
TRUSTED_ACCELERATION = 2.0  # m/s^2: more is taken for a jump of the estimate
FRESH = 0.25  # s: with an older estimate the margin to the neighbour begins to grow
UNKNOWN_SPEED = 0.3  # m/s by which that margin grows
TRUSTED_TIME = 1.0  # s for which a neighbour is expected to go on accelerating as it did


class State(str, enum.Enum):
    """The planner's states, from the freshness of its inputs."""

    IDLE = 'IDLE'
    SEARCH = 'SEARCH'
    TRACK = 'TRACK'
    COAST = 'COAST'
    HOLD = 'HOLD'


class Fading(NamedTuple):
    """A command (3,), m/s^2, that the law's takes over from, and since when, s."""

    command: Array
    since: float


@dataclass(frozen=True, eq=False)
class Memory:
    """What one step hands to the next; ``Memory()`` is the start."""

    now: float | None = None
    own: OwnState | None = None
    neighbors: Mapping[str, NeighborEstimate] = field(default_factory=dict)
    flock: Mapping[str, NeighborEstimate] = field(default_factory=dict)
    """The neighbours at hand and those lost since: to keep clear of."""
    motions: Mapping[str, SmoothedMotion] = field(default_factory=dict)
    """How the flock has been moving."""
    followed: float | None = None
    """Stamp of the newest estimate followed since leaving IDLE, s."""
    altitude: float | None = None
    """Altitude held since leaving IDLE, m."""
    yaw: float | None = None
    """Yaw last commanded since leaving IDLE, rad."""
    command: Array | None = None
    """Acceleration last commanded, m/s^2; None where the last step commanded nothing."""
    pending: Array = field(default_factory=lambda: np.zeros(3))
    """Velocity that has been commanded and not yet been flown (3,), m/s."""
    params: PlannerParams | None = None
    """Parameters with which the law was followed in the last step; None where it was not."""
    fading: Fading | None = None
    """Where the law's command is being faded in from."""
    slow: bool = False
    """Whether odometry comes too slowly to fly on."""
    jumped: float | None = None
    """Stamp of the odometry that jumped last, s: estimates from before are in another frame."""


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
    yaw_rate: float = 0.0
    """Rate that turns the vehicle to the commanded yaw, and along with it, rad/s, ENU."""
    away: Array | None = None
    """Unit vector (3,) away from the neighbour that the command keeps clear of; None: of none."""
    stamp: float | None = None
    """Stamp of the newest estimate the command rests on, s; None if it rests on none."""
    limits: str = ''
    """The limits that bound: of 'a_max', 'v_max', 'separation', 'cohesion' those that did."""
    rejected: tuple[Rejection, ...] = ()
    warnings: tuple[str, ...] = ()
    """What the neighbours do that is beyond the follower's means."""

    @property
    def guarded(self) -> bool:
        """Return whether the guard altered the command."""
        return SEPARATION in self.limits or COHESION in self.limits


def step(memory: Memory, now: float, engaged: bool, own: OwnState | None,
         neighbors: Iterable[NeighborEstimate], params: PlannerParams,
         looked: float | None = None, waiting: str = '') -> tuple[Memory, Decision]:
    """
    Decide the command for the time ``now``, and return it after the memory for the next step.

    :param now: time of this step, s; a step back by more than 0.1 s forgets everything.
    :param engaged: whether commands are wanted.
    :param own: the newest odometry that arrived since the last step, or None.
    :param neighbors: the estimates that arrived since the last step; of each name the newest
        counts. Handing in the same one again does no harm.
    :param looked: when perception last told of an image processed, s, with a neighbour in it or
        without; None where it never did, which is no fault.
    :param waiting: why it may not command yet, though engaged, such as a bridge that is not
        ACTIVE; '' where nothing is missing. When that ends, altitude and yaw are captured.
    """
    last = memory.now
    memory, rejected = _ingest(memory, now, own, neighbors, params)
    elapsed = params.period if last is None else min(max(now - last, 0.0), 2.0 * params.period)
    fault = odometry_fault(memory.own, now, params)
    slow = None if memory.own is None else too_slow(
        memory.own.spans, params.odom_timeout, memory.slow)
    memory = replace(memory, slow=slow is not None)
    newest = max((n.stamp for n in memory.neighbors.values()), default=None)
    state, reason = next_state(
        engaged, fault or _late(memory.own, slow, now, params) or _blind(looked, now, params),
        None if newest is None else now - newest,
        None if memory.followed is None else now - memory.followed, params, waiting)
    if state is State.IDLE:
        return begun_afresh(memory), Decision(state, reason, rejected=rejected)
    if memory.own is None or fault:
        return _without_command(memory), Decision(state, reason, rejected=rejected)

    me = at(memory.own, now)
    altitude = held_altitude(memory.altitude, me, params)
    yaw = last_yaw = me.yaw if memory.yaw is None else memory.yaw
    warnings: tuple[str, ...] = ()
    fading = None
    if state is State.TRACK:
        known = {name: n for name, n in memory.flock.items()
                 if now - n.stamp <= params.coast_timeout}
        for n in memory.neighbors.values():
            before = known.get(n.name)
            if before is not None and _off(n, before) > NEIGHBOR_JUMP:
                # The old track may be a second drone: avoid it until coast_timeout.
                name = f'{n.name} before'
                known[name] = replace(before, name=name)
        known.update(memory.neighbors)
        memory = replace(memory, flock=known, motions=observed(memory.motions, known.values()))
        flock = [at(n, now) for n in memory.neighbors.values()]
        warnings = reports(flock, memory.motions, me, params.law, params.v_max)
        wanted, fading = _faded(_law(me, flock, params), memory, now, params)
        command = limited(wanted, me, altitude, params)
        if params.guard:
            command = _guarded(command, memory, me, altitude is not None, params)
        yaw = facing(yaw, me, flock, params, elapsed)
    else:
        wanted = np.zeros(3) if state is State.COAST else brake(
            me.velocity, params.a_max, params.brake_time_constant)
        command = limited(wanted, me, altitude, params)
        if params.guard and state is State.COAST:
            command = _guarded(command, memory, me, altitude is not None, params)
        if state is State.SEARCH:
            yaw = scanning(yaw, params, elapsed)
    tracking = state is State.TRACK
    stamp = newest if tracking else (
        memory.followed if state is State.COAST and SEPARATION in command.reason else None)
    memory = replace(
        memory, followed=newest if tracking else memory.followed, altitude=altitude, yaw=yaw,
        command=command.acceleration, params=params if tracking else None, fading=fading,
        pending=unflown(memory.pending, command.acceleration, elapsed, params))
    yaw_rate = turning(last_yaw, yaw, me, params, elapsed)
    return memory, Decision(state, reason, command.acceleration, yaw, yaw_rate, command.away,
                            stamp, command.reason, rejected, warnings)


def begun_afresh(memory: Memory) -> Memory:
    """Return what is known of the present, and nothing of a flight that is over."""
    return Memory(now=memory.now, own=memory.own, neighbors=memory.neighbors,
                  slow=memory.slow, jumped=memory.jumped)


def next_state(engaged: bool, fault: str, youngest: float | None, followed: float | None,
               params: PlannerParams, waiting: str = '') -> tuple[State, str]:
    """
    Return the state, and the reason for it where it is not TRACK.

    :param fault: what is wrong with the own odometry, or with perception, or ''.
    :param youngest: age of the youngest estimate at hand, s, or None.
    :param followed: age of the newest estimate followed since leaving IDLE, s, or None.
    :param waiting: why it may not command yet, though engaged, or ''.
    """
    if not engaged:
        return State.IDLE, 'not engaged'
    if waiting:
        return State.IDLE, f'engaged, waiting for {waiting}'
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
    fault = untimely(own.stamp, now, params.odom_timeout)
    return f'odometry {fault.reason} ({fault.detail})' if fault else ''


def _ingest(memory: Memory, now: float, own: OwnState | None,
            neighbors: Iterable[NeighborEstimate],
            params: PlannerParams) -> tuple[Memory, tuple[Rejection, ...]]:
    """Return the memory with the new inputs that pass and without what grew old, and the rest."""
    rejected = []
    if memory.now is not None and now < memory.now - FUTURE_TOLERANCE:
        rejected.append(Rejection('time jumped back', f'by {memory.now - now:.1f} s'))
        memory = Memory()
    jumped = memory.jumped
    if own is not None:
        problem = implausible(own) or untimely(own.stamp, now, params.odom_timeout)
        if problem:
            rejected.append(Rejection(f'odometry {problem.reason}', problem.detail))
        elif memory.own is None or own.stamp >= memory.own.stamp:
            jump = 0.0 if memory.own is None else math.dist(
                own.position, at(memory.own, own.stamp).position)
            if jump > ODOMETRY_JUMP:
                rejected.append(Rejection('odometry jumped', f'by {jump:.2f} m'))
                jumped = own.stamp
                memory = replace(memory, neighbors={}, flock={}, altitude=None)
            memory = replace(memory, own=own)
    kept = {name: n for name, n in memory.neighbors.items()
            if not untimely(n.stamp, now, params.predict_timeout) and not far(n, memory.own)}
    for n in neighbors:
        problem = (implausible(n) or untimely(n.stamp, now, params.predict_timeout)
                   or uncertain(n, params.max_position_std, params.max_velocity_std)
                   or far(n, memory.own))
        if problem:
            rejected.append(Rejection(f'estimate {problem.reason}', f'{n.name}: {problem.detail}'))
        elif jumped is not None and n.stamp < jumped:
            rejected.append(Rejection('estimate older than the jump of odometry', n.name))
        elif n.name not in kept or n.stamp >= kept[n.name].stamp:
            if n.name in kept and (off := _off(n, kept[n.name])) > NEIGHBOR_JUMP:
                rejected.append(Rejection('estimate jumped', f'{n.name}: by {off:.2f} m'))
            else:
                kept[n.name] = n
    return replace(memory, now=now, neighbors=kept, jumped=jumped), tuple(rejected)


def _off(n: NeighborEstimate, before: NeighborEstimate) -> float:
    """Return how far a neighbour is from where it should be by what was known before, m."""
    return math.dist(n.position, at(before, n.stamp).position)


def _late(own: OwnState | None, slow: float | None, now: float, params: PlannerParams) -> str:
    """Return that odometry is too old to fly on, or will be soon, or ''."""
    if own is None:
        return ''
    if slow is not None:
        return f'odometry too slow ({slow:.2f} s old before the next comes)'
    age = now - own.stamp
    return f'odometry late ({age:.2f} s)' if overdue(age, own.spans, params.odom_timeout) else ''


def _blind(looked: float | None, now: float, params: PlannerParams) -> str:
    """Return that perception, or the camera before it, has fallen silent, or ''."""
    silent = 0.0 if looked is None else now - looked
    # The tolerance lets a timer that fires exactly at the timeout brake at once.
    return (f'no image processed for {silent:.2f} s'
            if silent > params.perception_timeout - 1e-6 else '')


def _without_command(memory: Memory) -> Memory:
    return replace(memory, command=None, params=None, fading=None, pending=np.zeros(3))


def _law(me: OwnState, flock: list[NeighborEstimate], params: PlannerParams) -> Array:
    return acceleration(np.array([n.position - me.position for n in flock]),
                        np.array([n.velocity - me.velocity for n in flock]), params.law)


def _faded(wanted: Array, memory: Memory, now: float,
           params: PlannerParams) -> tuple[Array, Fading | None]:
    """Return the law's command, or what leads to it where it is still being faded in."""
    fading = memory.fading
    if memory.params is not params and memory.params != params:
        fading = Fading(np.zeros(3) if memory.command is None else memory.command, now)
    if fading is None:
        return wanted, None
    done = (now - fading.since + params.period) / max(params.handover_time, params.period)
    if done >= 1.0 - 1e-9:
        return wanted, None
    within = limit_norm(wanted, params.a_max)
    return fading.command + max(done, 0.0) * (within - fading.command), fading


def _guarded(command: LimitedCommand, memory: Memory, me: OwnState, keep_vertical: bool,
             params: PlannerParams) -> LimitedCommand:
    """Return the command as the guard allows it; of those lost it only keeps clear."""
    # Commands that were sent and not yet flown will be flown in any case: count them as velocity.
    # The neighbour, too, goes on accelerating until a new command acts (see _bounds).
    velocity = me.velocity + memory.pending
    bounds = []
    for n in memory.flock.values():
        age = me.stamp - n.stamp
        if age > params.coast_timeout:
            continue
        lost = n.name not in memory.neighbors
        # Do not predict the climb of a lost one: it is the least sure, and would free the way.
        along = np.array([1.0, 1.0, 0.0]) if lost and keep_vertical else np.ones(3)
        its = along * limit_norm(memory.motions[n.name].acceleration, TRUSTED_ACCELERATION)
        predicted = _bounds(n, along, its, age, me, velocity, params)
        steady = _bounds(n, along, np.zeros(3), age, me, velocity, params)
        if predicted is None or steady is None:
            continue
        lowest = max(predicted.lowest, steady.lowest)
        if age > FRESH:
            # The longer it is out of sight, the less sure its place: widen the margin.
            margin = params.guarding.m + UNKNOWN_SPEED * (age - FRESH)
            wary = replace(params, guarding=replace(params.guarding, m=margin))
            lowest = max([lowest, *(b.lowest for guess in (its, np.zeros(3)) if (
                b := _bounds(n, along, guess, age, me, velocity, wary)) is not None)])
        # A neighbour's acceleration is a guess. It may always make us keep farther away; it may
        # make us follow only while the neighbour is seen: never chase a guess.
        highest = predicted.highest if age <= FRESH else max(predicted.highest, steady.highest)
        bounds.append(predicted._replace(
            lowest=lowest, highest=math.inf if lost else highest, seen=not lost))
    guarded = guard(command.acceleration, me.velocity, bounds, params.a_max, params.v_max,
                    params.period, keep_vertical)
    if not guarded.limited:
        return command
    reasons = ', '.join(filter(None, [command.reason, guarded.reason]))
    return LimitedCommand(guarded.acceleration, True, reasons, guarded.away)


def _bounds(n: NeighborEstimate, along: Array, its: Array, age: float, me: OwnState,
            velocity: Array, params: PlannerParams) -> RadialBounds | None:
    """Return the guard's bounds for a neighbour that goes on with an acceleration (3,), m/s^2."""
    known = min(max(age, 0.0), TRUSTED_TIME)
    its_velocity = along * n.velocity
    place = n.position + age * its_velocity + known * (age - 0.5 * known) * its
    speeding = min(age + params.response_time, TRUSTED_TIME)
    return radial_bounds(
        me.position - place, along * velocity - its_velocity - speeding * its, params.law,
        params.guarding, its if age < TRUSTED_TIME else np.zeros(3))
