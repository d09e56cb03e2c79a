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

The states are those of :mod:`flock_follower.planner.modes`. When the state leaves IDLE, a new
flight begins with the present altitude and yaw, without data of an earlier flight. When following
begins, begins again, or continues with changed parameters, the law's command is faded in; the
guard acts at once. No function reads a clock: equal inputs give equal outputs.

The order of the bounds on a command is that of :mod:`flock_follower.planner.guard`, within
``a_max`` and ``v_max``. Altitude has priority over all horizontal motion.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, wrap_angle
from flock_follower.planner import relative
from flock_follower.planner.bound_keeping import SEPARATION
from flock_follower.planner.guard import climb_rates, constrain
from flock_follower.planner.inputs import Neighbor, OwnState, propagate
from flock_follower.planner.memory import ingest, Memory, update_pending
from flock_follower.planner.modes import blind, next_state, odometry_delay, odometry_fault, State
from flock_follower.planner.neighborhood import last_known, nominal, reports
from flock_follower.planner.params import AVOID, PlannerParams
from flock_follower.planner.retreat import fallback_retreat, overflight, retreat
from flock_follower.planner.scene import Decision, expected_now, Scene, survey
from flock_follower.planner.sight import FieldsOfView, Occlusion, occlusion
from flock_follower.planner.vertical_yaw import Altitude, face_yaw, search_yaw, turn_rate


class Inputs(NamedTuple):
    """The inputs of one step."""

    now: float
    """s; a step back by more than 0.1 s forgets everything."""
    engaged: bool
    """Whether commands are requested."""
    own: OwnState | None
    """The newest odometry, or None."""
    estimates: Sequence[Neighbor]
    """Estimates of neighbors since the last step; the newest of each name counts."""
    looked: float | None = None
    """Time of the last processed image, s; None before the first, which is no fault."""
    waiting: str = ''
    """Reason why the planner may not command, or why it was disengaged, or ''."""
    view: FieldsOfView = ()
    """Fields of view of the cameras; () if unknown."""
    ground: float | None = None
    """Height at arming, m, in odom."""
    frames: Sequence[float] = ()
    """Stamps of the newest processed images, s, in their order."""


def step(memory: Memory, inputs: Inputs, params: PlannerParams) -> tuple[Memory, Decision]:
    """Return the memory for the next step, and the decision for the time of the inputs."""
    last, now = memory.now, inputs.now
    memory, rejected = ingest(memory, now, inputs.own, inputs.estimates, params)
    elapsed = params.period if last is None else min(max(now - last, 0.0), 2.0 * params.period)
    if memory.own is not None and memory.own.relative and inputs.engaged and not (
            inputs.waiting or memory.given_up):
        memory, decision = relative.step(memory, memory.own, now, params, elapsed)
        return memory, decision._replace(rejected=rejected)
    blinded = blind(inputs.looked, now, params)
    me = None if memory.own is None else propagate(memory.own, now)
    memory, state, reason, newest = _mode(memory, me, inputs, params, blinded)
    if state is State.IDLE:
        return memory.begun_afresh(), Decision(state, reason, rejected=rejected)
    if (memory.own is None or me is None
            or memory.given_up or odometry_fault(memory.own, now, params)):
        memory = memory._replace(command=None, params=None, fading=None, pending=np.zeros(3))
        return memory, Decision(state, reason, rejected=rejected)
    tracking = state is State.TRACK
    # Velocity that was commanded and flown since the measurement, m/s; the rest is pending.
    flown = memory.pending * (max(now - memory.own.stamp, 0.0) / params.response_time)
    memory, scene = survey(memory, me, state, bool(blinded), params, elapsed)
    neighbors = scene.neighbors
    altitude, vertical = _altitude(memory, scene, inputs.ground, flown, params, elapsed)
    velocity = me.velocity + flown + memory.pending
    fallback = fallback_retreat(memory, scene, params)
    unlimited, fading = nominal(memory, state, me, velocity, neighbors, params)
    command = constrain(
        unlimited, vertical, altitude.climb, memory, scene, velocity, inputs.view, params)
    if me.stamp - memory.switched < relative.SETTLING_TIME:
        command = command._replace(
            acceleration=relative.without_step(command.acceleration, memory.command))
    last_yaw = me.yaw if memory.yaw is None else memory.yaw
    yaw = _yaw(last_yaw, memory, scene, params, elapsed)
    stamp = newest if tracking else (
        memory.followed if state is State.COAST and SEPARATION in command.reason else None)
    memory = memory._replace(
        followed=newest if tracking else memory.followed, altitude=altitude, yaw=yaw,
        shares=neighbors.shares, edges=neighbors.edges,
        faced=neighbors.faced.name if neighbors.faced else memory.faced,
        leader=last_known(memory, neighbors), looking=scene.leader is not None,
        command=command.acceleration, params=params if tracking else None, fading=fading,
        pending=update_pending(memory, command.acceleration, elapsed, params),
        coming=0.0 if fallback is None else fallback.approach)
    return memory, Decision(
        state, reason, command.acceleration, yaw,
        turn_rate(last_yaw, yaw, me, params, elapsed), command.separation_axis,
        None if fallback is None else fallback.velocity, stamp,
        command.reason, rejected, _warnings(memory, scene, reason, params), altitude.commanded,
        tuple(sorted(neighbors.edges)))


def _mode(memory: Memory, me: OwnState | None, inputs: Inputs, params: PlannerParams,
          blinded: str) -> tuple[Memory, State, str, float | None]:
    """
    Return memory, state, the reason for the state, and the stamp of the newest estimate, s.

    That estimate is one to follow: one seen, else one received. The memory has given up if no
    neighbor was followed for too long; it then sends no commands.
    """
    now = inputs.now
    fault = odometry_fault(memory.own, now, params)
    occluded = None if fault or me is None else _judge_occlusion(memory, me, inputs)
    follow = [n for n in memory.neighbors.values() if n.member.role != AVOID and (
        occluded is None or n.received or n.name != memory.faced)]
    seen, received = (max((n.stamp for n in follow if n.received is by_message), default=None)
                      for by_message in (False, True))
    unfollowed = None if memory.followed is None else now - memory.followed
    begun = now if memory.begun is None else memory.begun
    given_up = memory.given_up or (
        now - begun if unfollowed is None else unfollowed) > params.resume_timeout
    state, reason = next_state(
        inputs.engaged, fault or odometry_delay(memory.own, now, params) or blinded,
        None if seen is None else now - seen, unfollowed, params, inputs.waiting, given_up,
        None if received is None else now - received, occluded is not None)
    if state is not State.IDLE:
        memory = memory._replace(given_up=given_up, begun=begun, occlusion=occluded)
    return memory, state, reason, received if seen is None else seen


def _judge_occlusion(memory: Memory, me: OwnState, inputs: Inputs) -> Occlusion | None:
    """Return the occlusion of the faced neighbor, or None."""
    if memory.followed is None:
        return None
    n = memory.neighbors.get(memory.faced) or memory.flock.get(memory.faced)
    sent = np.zeros(3) if memory.command is None else memory.command
    forward = math.cos(me.yaw) * sent[0] + math.sin(me.yaw) * sent[1]
    return occlusion(memory.occlusion, n, me, inputs.frames, inputs.view, float(forward))


def _altitude(memory: Memory, scene: Scene, ground: float | None, flown: Array,
              params: PlannerParams, elapsed: float) -> tuple[Altitude, float]:
    """
    Return the altitude to hold, and the vertical acceleration, m/s^2.

    The height of the lost neighbor is followed as far as it is predicted.

    :param flown: velocity (3,), m/s, that was commanded and flown since the measurement. Without
        it the control oscillates if odometry is late.
    """
    me, neighbors, missed = scene.me, scene.neighbors, scene.missed
    me, coming = me._replace(velocity=me.velocity + flown), float(memory.pending[2])
    jumped = memory.own is not None and memory.own.stamp == memory.jumped
    # After a jump of the odometry its height at arming is of another frame.
    altitude = Altitude.begin(me, None if jumped else ground, params) if (
        memory.altitude is None) else memory.altitude.with_limits_of(params)
    level = neighbors.level
    if level is None and missed is not None and not scene.blinded:
        level = expected_now(missed, memory, me.stamp, params)
        if level.stamp < me.stamp:
            level = level._replace(velocity=np.zeros(3), acceleration=None)
    altitude = altitude.follow(
        level if params.altitude_mode == 'follow' else None, params, elapsed)
    if not params.guard:
        return altitude.control(me, params, coming=coming)
    near = neighbors.flock or [propagate(n, me.stamp) for n in memory.flock.values()
                               if me.stamp - n.stamp <= params.coast_timeout]
    raised = -math.inf
    if memory.lost is not None and not scene.blinded:
        # The climb lasts as long as the loss: the next one begins at the altitude held before.
        raised = min(overflight(memory.lost, me.position, altitude.held, params), altitude.highest)
    return altitude.control(
        me, params, *climb_rates(near, me, params), coming, raised)


def _yaw(last: float, memory: Memory, scene: Scene, params: PlannerParams,
         elapsed: float) -> float:
    """Return the yaw to command."""
    me, faced, missed = scene.me, scene.neighbors.faced, scene.missed
    if params.yaw_mode != 'leader':
        return last
    if missed is not None:
        since = me.stamp - missed.stamp - params.coast_timeout
        there = expected_now(missed, memory, me.stamp, params)
        return face_yaw(last, me, there, params, elapsed) if since <= 0.0 else search_yaw(
            last, me, there, since, params, elapsed)
    if faced is not None:
        # Seen again during a turn: the yaw commanded last is where it would overshoot to.
        return face_yaw(me.yaw if memory.params is None else last, me, faced, params, elapsed)
    lost = memory.lost
    if lost is not None and not lost.name and memory.jumped is not None:
        ahead = Neighbor('', me.stamp, me.position + lost.towards, np.zeros(3))
        return search_yaw(last, me, ahead, me.stamp - memory.jumped, params, elapsed)
    if scene.state is State.SEARCH:  # it looks round, anticlockwise
        return wrap_angle(last + min(params.scan_rate, params.yaw_rate_max) * elapsed)
    return last


def _warnings(memory: Memory, scene: Scene, reason: str,
              params: PlannerParams) -> tuple[str, ...]:
    """Return warnings: neighbors that cannot be followed, and the reaction to lost ones."""
    me, leader = scene.me, scene.leader
    if scene.state is State.TRACK:
        search = '' if leader is None else (
            f'looks for {leader.name}, last known {me.stamp - leader.stamp:.1f} s ago')
        return (*filter(None, [reason, search]), *reports(memory, scene.neighbors, params))
    retreated = 0.0 if memory.lost is None else memory.lost.retreat_distance(me.position)
    if memory.lost is None or retreated < retreat(memory.lost, params) - 0.05:
        return ()
    return (f'moved {retreated:.1f} m out of the way of a neighbor out of sight: no further '
            'without seeing',)
