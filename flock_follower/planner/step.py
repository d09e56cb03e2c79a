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

The states are those of :mod:`flock_follower.planner.state`. Leaving IDLE a flight begins anew,
with the altitude and yaw of that moment: nothing of an earlier one survives. When following
begins, begins again, or goes on with other parameters, the law's command is faded in; the guard
acts on what comes of that, and at once. Nothing here reads a clock: equal inputs give equal
outputs.

What a command has to keep, the most important first: the distance to those in sight; within what
``a_max`` and ``v_max`` leave, which no command exceeds; the fences; out of the way of those out of
sight; the neighbour in sight; not falling behind. The altitude goes before all that is horizontal.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
import math

import numpy as np

from flock_follower.flocking import acceleration
from flock_follower.geometry import Array
from flock_follower.planner.altitude import Altitude
from flock_follower.planner.distance_only import clear_of_sphere, said
from flock_follower.planner.guard import (
    guard,
    HalfSpace,
    ordered,
    RadialBounds,
    REASONS,
    SEPARATION,
)
from flock_follower.planner.inputs import at, NeighborEstimate, OwnState, Rejection
from flock_follower.planner.keeping_clear import fences, in_sight, out_of_sight
from flock_follower.planner.leader_warnings import observed, reports
from flock_follower.planner.limits import (
    brake,
    limit_command,
    limit_horizontal,
    limit_norm,
    LimitedCommand,
)
from flock_follower.planner.memory import (
    Fading,
    ingest,
    Loss,
    Memory,
    NEIGHBOR_JUMP,
    off,
)
from flock_follower.planner.odometry_rhythm import too_slow
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.prediction import expected, SEEN, unflown
from flock_follower.planner.sight import FieldOfView
from flock_follower.planner.state import blind, late, next_state, odometry_fault, State
from flock_follower.planner.yaw import facing, OVERHEAD, scanning, searching, turning


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
    """The limits that bound: those of 'a_max', 'v_max', and of the guard's reasons, that did."""
    rejected: tuple[Rejection, ...] = ()
    warnings: tuple[str, ...] = ()
    """What the neighbours do that is beyond the follower's means."""
    lift: float = 0.0
    """The part of the vertical acceleration that only makes up for a wrong hover thrust, m/s^2."""

    @property
    def guarded(self) -> bool:
        """Return whether the guard altered the command."""
        return any(reason in self.limits for reason in REASONS)


def step(memory: Memory, now: float, engaged: bool, own: OwnState | None,
         neighbors: Iterable[NeighborEstimate], params: PlannerParams,
         looked: float | None = None, waiting: str = '', view: FieldOfView | None = None,
         ground: float | None = None) -> tuple[Memory, Decision]:
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
    :param view: what the camera sees, to keep the nearest neighbour in it; None where unknown.
    :param ground: height at which the vehicle was armed, m, in the frame of the odometry.
    """
    last = memory.now
    memory, rejected = ingest(memory, now, own, neighbors, params)
    elapsed = params.period if last is None else min(max(now - last, 0.0), 2.0 * params.period)
    fault = odometry_fault(memory.own, now, params)
    slow = None if memory.own is None else too_slow(
        memory.own.spans, params.odom_timeout, memory.slow)
    newest = max((n.stamp for n in memory.neighbors.values()), default=None)
    unfollowed = None if memory.followed is None else now - memory.followed
    memory = replace(memory, slow=slow is not None, given_up=memory.given_up or (
        unfollowed is not None and unfollowed > params.resume_timeout))
    state, reason = next_state(
        engaged, fault or late(memory.own, slow, now, params) or blind(looked, now, params),
        None if newest is None else now - newest, unfollowed, params, waiting, memory.given_up)
    if state is State.IDLE:
        return memory.begun_afresh(), Decision(state, reason, rejected=rejected)
    if memory.own is None or fault:
        return memory.without_command(), Decision(state, reason, rejected=rejected)

    me, jumped = at(memory.own, now), memory.own.stamp == memory.jumped
    tracking = state is State.TRACK
    memory = _with_flock(memory, now, params) if tracking else memory
    flock = [at(n, now) for n in memory.neighbors.values()] if tracking else []
    nearest = min(flock, key=lambda n: math.dist(n.position, me.position), default=None)
    memory = replace(memory, lost=_loss(memory, me, tracking, elapsed),
                     home=me.position if memory.home is None else memory.home)

    altitude, vertical = memory.altitude, None
    if params.altitude_mode == 'law':
        altitude = None
    else:
        # After a jump of the odometry its height at arming is of another frame.
        altitude = (altitude or Altitude.begun(
            me, None if jumped else ground, params)).following(nearest, params, elapsed)
        altitude, vertical = altitude.controlled(me, params, elapsed)

    # Commands that were sent and not yet flown will be flown in any case: they count as velocity.
    # What only holds it up in the air moves it nowhere.
    lift = np.array([0.0, 0.0, 0.0 if altitude is None else altitude.lift])
    velocity = me.velocity + memory.pending - lift * params.period
    fading, warnings = None, _said(memory, params)
    if tracking:
        warnings = reports(flock, memory.motions, me, params)
        wanted, fading = _faded(_law(me, flock, params), memory, flock, me, now, params)
    elif state is State.COAST:
        wanted = np.zeros(3)
    else:
        wanted = brake(me.velocity, params.a_max, params.brake_time_constant)
    if vertical is None:
        command = limit_command(wanted, velocity, params.a_max, params.v_max, params.period)
    else:
        command = limit_horizontal(wanted, vertical, velocity, params.a_max, params.v_max,
                                   params.period)
    if params.guard and state is not State.SEARCH:
        command = _guarded(command, memory, me, velocity, vertical is not None, nearest, view,
                           params)
    # What is still to be flown is a guess: whatever it was, the measured velocity counts, too.
    final = limit_command(command.acceleration, me.velocity, params.a_max, params.v_max,
                          params.period, command.away)
    if final.limited and final.reason not in command.reason:
        command = command._replace(reason=', '.join(filter(None, [final.reason, command.reason])))
    command = command._replace(acceleration=final.acceleration)

    last_yaw = me.yaw if memory.yaw is None else memory.yaw
    yaw = _yaw(last_yaw, state, memory, me, nearest, params, elapsed)
    stamp = newest if tracking else (
        memory.followed if state is State.COAST and SEPARATION in command.reason else None)
    memory = replace(
        memory, followed=newest if tracking else memory.followed, altitude=altitude, yaw=yaw,
        command=command.acceleration, params=params if tracking else None, fading=fading,
        pending=unflown(memory.pending, command.acceleration - lift, elapsed, params))
    yaw_rate = turning(last_yaw, yaw, me, params, elapsed)
    return memory, Decision(state, reason, command.acceleration, yaw, yaw_rate, command.away,
                            stamp, command.reason, rejected, warnings, float(lift[2]))


def _with_flock(memory: Memory, now: float, params: PlannerParams) -> Memory:
    """Return the memory with those in sight, and those lost that may still be near."""
    known = {name: n for name, n in memory.flock.items()
             if now - n.stamp <= params.coast_timeout}
    for n in memory.neighbors.values():
        before = known.get(n.name)
        if before is not None and off(n, before) > NEIGHBOR_JUMP:
            # The old track may be a second drone: avoid it until coast_timeout.
            name = f'{n.name} before'
            known[name] = replace(before, name=name)
    known.update(memory.neighbors)
    return replace(memory, flock=known, motions=observed(memory.motions, known.values()))


def _loss(memory: Memory, me: OwnState, tracking: bool, elapsed: float) -> Loss | None:
    """Return the loss of whom it followed, with how far it has retreated since."""
    if tracking or memory.followed is None:
        return None
    if memory.lost is not None:
        back = -float(memory.lost.towards @ me.velocity) * elapsed
        return memory.lost._replace(retreated=memory.lost.retreated + max(back, 0.0))
    towards = np.array([math.cos(me.yaw), math.sin(me.yaw), 0.0])
    followed = [at(n, me.stamp) for n in memory.flock.values()]
    if followed:
        x, y, _ = min((n.position - me.position for n in followed), key=lambda p: float(p @ p))
        if math.hypot(x, y) > OVERHEAD:
            towards = np.array([x, y, 0.0]) / math.hypot(x, y)
    return Loss(me.stamp, towards)


def _said(memory: Memory, params: PlannerParams) -> tuple[str, ...]:
    """Return what it does about whom it does not see, where that is more than to wait."""
    if memory.lost is not None and memory.ranged and memory.own is not None:
        return said(memory.ranged.values(), memory.own)
    if memory.lost is None or memory.lost.retreated < params.retreat_max - 0.05:
        return ()
    return (f'moved {memory.lost.retreated:.1f} m out of the way of a neighbor out of sight: '
            'no further without seeing',)


def _yaw(last: float, state: State, memory: Memory, me: OwnState,
         nearest: NeighborEstimate | None, params: PlannerParams, elapsed: float) -> float:
    """Return the yaw to command."""
    if nearest is not None:
        return facing(last, me, nearest, params, elapsed)
    if state is State.SEARCH:
        return scanning(last, params, elapsed)
    if memory.lost is None:
        return last
    if state is State.COAST and memory.flock:
        newest = max(memory.flock.values(), key=lambda n: n.stamp)
        return facing(last, me, at(newest, me.stamp), params, elapsed)
    x, y, _ = memory.lost.towards
    since = me.stamp - (memory.followed or 0.0) - params.coast_timeout
    return searching(last, math.atan2(y, x), max(since, 0.0), params, elapsed)


def _law(me: OwnState, flock: list[NeighborEstimate], params: PlannerParams) -> Array:
    return acceleration(np.array([n.position - me.position for n in flock]),
                        np.array([n.velocity - me.velocity for n in flock]), params.law)


def _faded(wanted: Array, memory: Memory, flock: list[NeighborEstimate], me: OwnState, now: float,
           params: PlannerParams) -> tuple[Array, Fading | None]:
    """Return the law's command, or what leads to it where it is still being faded in."""
    fading = memory.fading
    if any(math.dist(n.position, me.position) ** 2 <= params.law.d0 for n in flock):
        return wanted, None  # too near already: at once
    if memory.params is not params and memory.params != params:
        fading = Fading(np.zeros(3) if memory.command is None else memory.command, now)
    if fading is None:
        return wanted, None
    done = (now - fading.since + params.period) / max(params.handover_time, params.period)
    if done >= 1.0 - 1e-9:
        return wanted, None
    within = limit_norm(wanted, params.a_max)
    return fading.command + max(done, 0.0) * (within - fading.command), fading


def _guarded(command: LimitedCommand, memory: Memory, me: OwnState, velocity: Array,
             keep_vertical: bool, nearest: NeighborEstimate | None, view: FieldOfView | None,
             params: PlannerParams) -> LimitedCommand:
    """Return the command as the guard allows it; of those lost it only keeps clear."""
    near, sight = list[RadialBounds](), list[HalfSpace]()
    ranged = {name: n for name, n in memory.ranged.items() if name not in memory.neighbors}
    for n in ranged.values():
        if sphere := clear_of_sphere(n, memory.flock.get(n.name), me, velocity, params):
            near.append(sphere)
    for n in memory.flock.values():
        if n.name in ranged:
            continue  # where it is not, its distance says
        its, age = memory.motions[n.name].acceleration, me.stamp - n.stamp
        it = expected(n, its, age, params)
        if memory.lost is None:
            here = n.name in memory.neighbors
            guess = [] if age <= SEEN else [expected(n, np.zeros(3), age, params)]
            near += in_sight(it, me.position, velocity, here, here and not guess, keep_vertical,
                             params)
            for steady in guess:
                near += in_sight(steady, me.position, velocity, here, here, keep_vertical, params)
        elif found := out_of_sight(it, memory.lost, me.position, velocity, params):
            near.append(found)
        if nearest is not None and view is not None and n.name == nearest.name:
            sight = view.bounds(it.position - me.position, velocity, it, params)
    fence = fences(memory.home, memory.lost, me.position, velocity, params)
    guarded = guard(command.acceleration, velocity, ordered(near, fence, sight), params.a_max,
                    params.v_max, params.period, keep_vertical)
    if not guarded.limited:
        return command
    reasons = ', '.join(filter(None, [command.reason, guarded.reason]))
    return LimitedCommand(guarded.acceleration, True, reasons, guarded.away)
