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

The states are those of :mod:`flock_follower.planner.modes`. Leaving IDLE begins a new flight with
the present altitude and yaw: nothing of an earlier flight remains. When following begins, begins
again, or continues with other parameters, the command of the law is faded in; the guard acts on
the result at once. Nothing here reads a clock: equal inputs give equal outputs.

The order of what a command keeps is that of :mod:`flock_follower.planner.guard`, within ``a_max``
and ``v_max``. Altitude has priority over all horizontal motion.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, wrap_angle
from flock_follower.planner import relative
from flock_follower.planner.guard import beside, climb_range, constrain, overflight, retreat
from flock_follower.planner.inputs import (
    at,
    expected,
    Neighbor,
    OwnState,
    Rejection,
    too_slow,
    TRUSTED_TIME,
)
from flock_follower.planner.limits import REASONS, SEPARATION
from flock_follower.planner.memory import ingest, Loss, Memory, NEIGHBOR_JUMP, observed, off
from flock_follower.planner.modes import blind, late, next_state, odometry_fault, State
from flock_follower.planner.neighborhood import (
    gathered,
    last_known,
    Neighborhood,
    NOBODY,
    nominal,
    reports,
    sought,
    unknown,
)
from flock_follower.planner.params import AVOID, PlannerParams
from flock_follower.planner.sight import Occlusion, occlusion, View
from flock_follower.planner.vertical_yaw import (
    Altitude,
    facing,
    OVERHEAD,
    searching,
    turning,
)

UP = np.array([0.0, 0.0, 1.0])


class Decision(NamedTuple):
    """The outcome of one step."""

    state: State
    reason: str = ''
    """Why this state, unless it is TRACK of a neighbor in sight."""
    acceleration: Array | None = None
    """Commanded acceleration (3,), m/s^2, ENU; None: no command may be sent."""
    yaw: float | None = None
    """Commanded yaw, rad, ENU; None exactly if the acceleration is None."""
    yaw_rate: float = 0.0
    """Rate that turns the vehicle to the commanded yaw, and along with it, rad/s, ENU."""
    separation_axis: Array | None = None
    """Unit vector (3,) away from the neighbor that the command keeps clear of; None: of none."""
    stamp: float | None = None
    """Stamp of the newest estimate the command rests on, s; None if it rests on none."""
    limits: str = ''
    """The limits that bound: those of 'a_max', 'v_max', and of the guard's reasons, that did."""
    rejected: tuple[Rejection, ...] = ()
    warnings: tuple[str, ...] = ()
    """Motions of the neighbors that are beyond the follower's means."""
    thrust_bias: float = 0.0
    """The part of the vertical acceleration that only makes up for a wrong hover thrust, m/s^2."""
    edges: tuple[str, ...] = ()
    """The neighbors at the ends of its edges; others are only kept clear of."""
    known: tuple[Neighbor, ...] = ()
    """All neighbors at hand, in TRACK, by name."""

    @property
    def guarded(self) -> bool:
        """Return whether the guard altered the command."""
        return any(reason in self.limits for reason in REASONS)


class _Mode(NamedTuple):
    """The state of one step, and the inputs that it depends on."""

    state: State
    reason: str
    silent: bool
    """Whether no command may be given: without fresh odometry, or after giving up."""
    blinded: bool
    """Whether no images are processed."""
    newest: float | None
    """Stamp of the newest estimate to follow, s: of one seen, else of one received."""


def step(memory: Memory, now: float, engaged: bool, own: OwnState | None,
         estimates: Iterable[Neighbor], params: PlannerParams, looked: float | None = None,
         waiting: str = '', view: View = (), ground: float | None = None,
         frames: Sequence[float] = ()) -> tuple[Memory, Decision]:
    """
    Return the memory for the next step, and the decision for the time ``now``, s.

    :param now: a step back by more than 0.1 s forgets everything.
    :param engaged: whether commands are wanted; :param own: the newest odometry, or None.
    :param estimates: of neighbors since the last step; the newest of each name counts.
    :param looked: when the last image was processed, s; None if none was, which is no fault.
    :param waiting: why it may not command although engaged, or what disengaged it, or ''.
    :param view: of the cameras; () if unknown; :param ground: height at arming, m, in odom.
    :param frames: stamps of the newest processed images, s, in their order.
    """
    last = memory.now
    memory, rejected = ingest(memory, now, own, estimates, params)
    elapsed = params.period if last is None else min(max(now - last, 0.0), 2.0 * params.period)
    if memory.own is not None and memory.own.relative and engaged and not (
            waiting or memory.given_up):
        return _relative(memory, memory.own, now, params, elapsed, rejected)
    memory, mode = _mode(memory, now, engaged, params, looked, waiting, view, frames)
    if mode.state is State.IDLE:
        return memory.begun_afresh(), Decision(mode.state, mode.reason, rejected=rejected)
    if memory.own is None or mode.silent:
        memory = memory._replace(command=None, params=None, fading=None, pending=np.zeros(3))
        return memory, Decision(mode.state, mode.reason, rejected=rejected)
    me, tracking = at(memory.own, now), mode.state is State.TRACK
    # Commands that are not flown yet count as velocity; part was flown since the measurement.
    coming = memory.pending * (1.0 + max(now - memory.own.stamp, 0.0) / params.response_time)
    memory, neighbors, leader, missed = _surroundings(memory, me, tracking, params, elapsed)
    altitude, vertical = _altitude(memory, mode, me, neighbors, missed, ground, coming, params,
                                   elapsed)
    bias = altitude.thrust_bias  # corrects a wrong hover thrust: it does not move the vehicle
    velocity = me.velocity + coming - bias * params.period * UP
    wanted, fading = nominal(memory, mode.state, me, velocity, neighbors, params)
    command = constrain(wanted, vertical, altitude.climb, memory, mode.state, mode.blinded, me,
                        velocity, neighbors, view, params)
    if me.stamp - memory.switched < relative.SETTLING:
        command = command._replace(
            acceleration=relative.without_step(command.acceleration, memory.command))
    last_yaw = me.yaw if memory.yaw is None else memory.yaw
    yaw = _yaw(last_yaw, mode.state, memory, me, neighbors.faced, missed, params, elapsed)
    stamp = mode.newest if tracking else (
        memory.followed if mode.state is State.COAST and SEPARATION in command.reason else None)
    left = math.exp(-elapsed / params.response_time)
    memory = memory._replace(
        followed=mode.newest if tracking else memory.followed, altitude=altitude, yaw=yaw,
        shares=neighbors.shares, edges=neighbors.edges,
        faced=neighbors.faced.name if neighbors.faced else memory.faced,
        leader=last_known(memory, neighbors), looking=leader is not None,
        command=command.acceleration, params=params if tracking else None, fading=fading,
        pending=left * memory.pending + (1.0 - left) * params.response_time * (
            command.acceleration - bias * UP))
    return memory, Decision(
        mode.state, mode.reason, command.acceleration, yaw,
        turning(last_yaw, yaw, me, params, elapsed), command.separation_axis, stamp,
        command.reason, rejected, _warnings(memory, mode, me, neighbors, leader, params), bias,
        tuple(sorted(neighbors.edges)), tuple(sorted(neighbors.flock, key=lambda n: n.name)))


def _surroundings(memory: Memory, me: OwnState, tracking: bool, params: PlannerParams,
                  elapsed: float
                  ) -> tuple[Memory, Neighborhood, Neighbor | None, Neighbor | None]:
    """
    Return the memory with all to keep clear of, and the neighbors at hand in TRACK, else none.

    The last two are the leader to look for while others are followed, and the lost neighbor: that
    leader, or the newest one of those lost if no neighbor is followed.
    """
    now = me.stamp
    neighbors = gathered(memory, me, [at(n, now) for n in memory.neighbors.values()], params,
                         elapsed) if tracking else NOBODY
    leader = sought(memory, neighbors, me, params) if tracking else None
    flock = _flock(memory, now, tracking, leader, params)
    missed = leader
    if leader is None and neighbors.faced is None:
        missed = max((n for n in flock.values() if n.member.role != AVOID),
                     key=lambda n: n.stamp, default=None)
    return memory._replace(
        flock=flock, motions=observed(memory.motions, flock.values()) if flock else memory.motions,
        lost=_loss(memory, flock, me, tracking, leader, params),
        home=me.position if memory.home is None else memory.home), neighbors, leader, missed


def _relative(memory: Memory, own: OwnState, now: float, params: PlannerParams, elapsed: float,
              rejected: tuple[Rejection, ...]) -> tuple[Memory, Decision]:
    """Return the memory and the decision while there is no odometry: see ``relative``."""
    flown = relative.step(memory, own, now, params, elapsed)
    if isinstance(flown, str):
        memory = memory._replace(command=None, pending=np.zeros(3))
        return memory, Decision(State.HOLD, flown, rejected=rejected)
    memory, leader, yaw, yaw_rate = flown
    return memory, Decision(
        State.RELATIVE, 'no odometry: flies by the marker alone', memory.command, yaw, yaw_rate,
        stamp=leader.stamp, rejected=rejected,
        thrust_bias=-float(memory.disturbance.acceleration[2]), known=(leader,))


def _mode(memory: Memory, now: float, engaged: bool, params: PlannerParams,
          looked: float | None, waiting: str, view: View,
          frames: Sequence[float]) -> tuple[Memory, _Mode]:
    """Return the mode of this step, and the memory with what the mode rests on."""
    fault = odometry_fault(memory.own, now, params)
    slow = None if memory.own is None else too_slow(
        memory.own.spans, params.odom_timeout, memory.slow)
    occluded = None if fault else _occluded(memory, now, frames, view)
    follow = [n for n in memory.neighbors.values() if n.member.role != AVOID and (
        occluded is None or n.received or n.name != memory.faced)]
    seen, received = (max((n.stamp for n in follow if n.received is by_message), default=None)
                      for by_message in (False, True))
    unfollowed = None if memory.followed is None else now - memory.followed
    begun = now if memory.begun is None else memory.begun
    given_up = memory.given_up or (
        now - begun if unfollowed is None else unfollowed) > params.resume_timeout
    blinded = blind(looked, now, params)
    state, reason = next_state(
        engaged, fault or late(memory.own, slow, now, params) or blinded,
        None if seen is None else now - seen, unfollowed, params, waiting, given_up,
        None if received is None else now - received, occluded is not None)
    memory = memory._replace(slow=slow is not None)
    if state is not State.IDLE:
        memory = memory._replace(given_up=given_up, begun=begun, occlusion=occluded)
    if state is State.TRACK:
        memory = memory._replace(met={**memory.met, **{n.name: n for n in follow}})
    newest = received if seen is None else seen
    return memory, _Mode(state, reason, bool(fault) or given_up, bool(blinded), newest)


def _occluded(memory: Memory, now: float, frames: Sequence[float], view: View) -> Occlusion | None:
    """Return whether the faced neighbor is occluded."""
    if memory.own is None or memory.followed is None:
        return None
    me = at(memory.own, now)
    n = memory.neighbors.get(memory.faced) or memory.flock.get(memory.faced)
    sent = np.zeros(3) if memory.command is None else memory.command
    forward = math.cos(me.yaw) * sent[0] + math.sin(me.yaw) * sent[1]
    return occlusion(memory.occlusion, n, me, frames, view, float(forward))


def _flock(memory: Memory, now: float, tracking: bool, leader: Neighbor | None,
           params: PlannerParams) -> Mapping[str, Neighbor]:
    """
    Return those at hand, and those lost that may still be near: to keep clear of.

    :param leader: the leader to look for.
    """
    # The vehicle always keeps clear of vehicles to avoid.
    here = [n for n in memory.neighbors.values() if tracking or n.member.role == AVOID]
    flock = {name: n for name, n in memory.flock.items()
             if now - n.stamp <= params.coast_timeout
             or not (tracking or n.member.role == AVOID) or (leader and leader.name == n.name)}
    for n in here:
        before = flock.get(n.name)
        if before is not None and not before.received and off(n, before) > NEIGHBOR_JUMP:
            # The old track may be a second drone: avoid it until coast_timeout.
            name = f'{n.name} before'
            flock[name] = before._replace(name=name)
    flock.update({n.name: n for n in here})
    return flock


def _awaited(n: Neighbor, memory: Memory, now: float, params: PlannerParams) -> Neighbor:
    """Return a lost neighbor where it is expected, predicted by at most ``coast_timeout``."""
    age = min(now - n.stamp, params.coast_timeout)
    it = expected(n, memory.acceleration(n), age, params)
    return n._replace(stamp=n.stamp + age, position=it.position, velocity=it.velocity)


def _loss(memory: Memory, flock: Mapping[str, Neighbor], me: OwnState, tracking: bool,
          leader: Neighbor | None, params: PlannerParams) -> Loss | None:
    """Return the loss of the neighbor that it followed or looks for."""
    if (tracking and leader is None) or memory.followed is None:
        return None
    if memory.lost is not None:
        along = memory.lost.towards
        ahead = max(float(along @ (me.position - memory.lost.origin)), 0.0)
        return memory.lost._replace(origin=memory.lost.origin + ahead * along)
    towards = np.array([math.cos(me.yaw), math.sin(me.yaw), 0.0])
    near = [leader] if leader else [n for n in flock.values() if n.member.role != AVOID]
    if not near:
        return Loss(towards, me.position)
    n = min(near, key=lambda n: math.dist(n.position, me.position))
    there = _awaited(n, memory, me.stamp, params)
    x, y, _ = there.position - me.position
    if math.hypot(x, y) > OVERHEAD:
        towards = np.array([x, y, 0.0]) / math.hypot(x, y)
    soon = expected(n, memory.acceleration(n), TRUSTED_TIME, params)
    approach = max(-float(towards @ n.velocity), -float(towards @ soon.velocity), 0.0)
    return Loss(towards, me.position, float(towards @ n.position), approach,
                float(n.position[2]), beside(soon.velocity, me.position - soon.position), n.name)


def _altitude(memory: Memory, mode: _Mode, me: OwnState, neighbors: Neighborhood,
              missed: Neighbor | None, ground: float | None, coming: Array,
              params: PlannerParams, elapsed: float) -> tuple[Altitude, float]:
    """
    Return the altitude to hold, and the vertical acceleration, m/s^2.

    :param missed: the neighbor to look for; its height is followed as far as it is predicted.
    """
    jumped = memory.own is not None and memory.own.stamp == memory.jumped
    # After a jump of the odometry its height at arming is of another frame.
    altitude = memory.altitude or Altitude.begun(me, None if jumped else ground, params)
    follows = params.altitude_mode == 'follow'
    level = neighbors.level
    if level is None and missed is not None and not mode.blinded:
        level = _awaited(missed, memory, me.stamp, params)
        if level.stamp < me.stamp:
            level = level._replace(velocity=np.zeros(3), acceleration=None)
    altitude = altitude.meeting(neighbors.peers, params, elapsed) if (
        follows and neighbors.peers) else altitude.following(
        level if follows else None, params, elapsed)
    if not params.guard:
        return altitude.controlled(me, params, elapsed, coming=float(coming[2]))
    near = neighbors.flock or [at(n, me.stamp) for n in memory.flock.values()
                               if me.stamp - n.stamp <= params.coast_timeout]
    raised = altitude
    if memory.lost is not None and not mode.blinded:
        above = overflight(memory.lost, me.position, altitude.held, params)
        raised = altitude._replace(held=max(altitude.held, min(above, altitude.highest)))
    controlled, vertical = raised.controlled(
        me, params, elapsed, *climb_range(near, me, params), float(coming[2]))
    # The climb lasts as long as the loss: the next one begins at the altitude held before.
    return controlled._replace(held=altitude.held), vertical


def _yaw(last: float, state: State, memory: Memory, me: OwnState, faced: Neighbor | None,
         missed: Neighbor | None, params: PlannerParams, elapsed: float) -> float:
    """Return the yaw to command."""
    if params.yaw_mode != 'leader':
        return last
    if missed is not None:
        since = me.stamp - missed.stamp - params.coast_timeout
        there = _awaited(missed, memory, me.stamp, params)
        return facing(last, me, there, params, elapsed) if since <= 0.0 else searching(
            last, me, there, since, params, elapsed)
    if faced is not None:
        # Seen again during a turn: the yaw commanded last is where it would overshoot to.
        return facing(me.yaw if memory.params is None else last, me, faced, params, elapsed)
    if state is State.SEARCH:  # it looks round, anticlockwise
        return wrap_angle(last + min(params.scan_rate, params.yaw_rate_max) * elapsed)
    return last


def _warnings(memory: Memory, mode: _Mode, me: OwnState, neighbors: Neighborhood,
              leader: Neighbor | None, params: PlannerParams) -> tuple[str, ...]:
    """Return warnings: neighbors that it cannot follow, and the reaction to lost ones."""
    if mode.state is State.TRACK:
        search = '' if leader is None else (
            f'looks for {leader.name}, not known of for {me.stamp - leader.stamp:.1f} s')
        return (*filter(None, [mode.reason, search]),
                *reports(neighbors, memory.motions, me, params),
                *unknown(memory, neighbors, me, params))
    if memory.lost is None:
        return ()
    if memory.ranged:
        return tuple(f'{n.name} out of sight, {math.dist(n.position, me.position):.1f} m away by '
                     'its ranges' for n in memory.ranged.values())
    retreated = memory.lost.retreated(me.position)
    return () if retreated < retreat(memory.lost, params) - 0.05 else (
        f'moved {retreated:.1f} m out of the way of a neighbor out of sight: no further without '
        'seeing',)
