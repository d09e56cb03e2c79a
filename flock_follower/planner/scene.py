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
The scene of one step, and the decision that the step makes.

The scene is the ego state, the present neighbors, and lost neighbors that may still be near.

``survey`` also updates the memory: the neighbors to keep clear of, their motions, and the loss of
sight of the neighbor that the vehicle followed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, SHORTEST
from flock_follower.planner.inputs import (
    find_newest,
    MAX_ACCELERATION_AGE,
    Neighbor,
    OwnState,
    predict,
    Prediction,
    Rejection,
    TRUSTED_TIME,
)
from flock_follower.planner.memory import by_name, Loss, Memory, update_motions
from flock_follower.planner.modes import State
from flock_follower.planner.neighborhood import (
    build_neighborhood,
    lost_leader,
    Neighborhood,
    NOBODY,
)
from flock_follower.planner.params import AVOID, FOLLOWER, PlannerParams
from flock_follower.planner.vertical_yaw import OVERHEAD_DISTANCE

RECEIVED_SIGMAS = 2.0  # standard deviations of a received position that count as possible places


class Decision(NamedTuple):
    """The outcome of one step."""

    state: State
    reason: str = ''
    """The reason for the state; '' for TRACK of a neighbor in sight."""
    acceleration: Array | None = None
    """Commanded acceleration (3,), m/s^2, ENU; None: no command may be sent."""
    yaw: float | None = None
    """Commanded yaw, rad, ENU; None exactly if the acceleration is None."""
    yaw_rate: float = 0.0
    """Rate, rad/s, ENU, that turns the vehicle to the commanded yaw, and with this yaw."""
    separation_axis: Array | None = None
    """Unit vector (3,) away from the neighbor to keep clear of; None without one."""
    retreat: Array | None = None
    """Velocity (3,), m/s, to brake to if odometry is lost; None: brake to a hover."""
    stamp: float | None = None
    """Stamp of the newest estimate on which the command is based, s; None without one."""
    limits: str = ''
    """The active limits: of 'a_max', 'v_max' and the reasons of the guard's bounds."""
    rejected: tuple[Rejection, ...] = ()
    warnings: tuple[str, ...] = ()
    """Warnings: neighbors that cannot be followed, and the reaction to lost neighbors."""
    altitude: float = math.nan
    """The commanded altitude, m; NaN without one."""
    edges: tuple[str, ...] = ()
    """The neighbors with an edge; the vehicle only keeps clear of others."""


class Scene(NamedTuple):
    """The vehicle and its surroundings at the time of one step."""

    state: State
    me: OwnState
    """Ego state, predicted to now."""
    blinded: bool
    """Whether no images are processed."""
    neighbors: Neighborhood
    """The present neighbors in TRACK; otherwise empty."""
    leader: Neighbor | None
    """Last estimate of a lost leader to search for while others are followed."""
    missed: Neighbor | None
    """The lost neighbor: ``leader``, or the last one lost if no neighbor is followed."""
    predictions: Mapping[str, Prediction]
    """Predictions of the neighbors to keep clear of, by name."""


def survey(memory: Memory, me: OwnState, state: State, blinded: bool, params: PlannerParams,
           elapsed: float) -> tuple[Memory, Scene]:
    """Return the memory with all neighbors to keep clear of, and the scene after ``elapsed`` s."""
    neighbors, leader = NOBODY, None
    if state is State.TRACK:
        neighbors = build_neighborhood(
            memory, me, [*memory.neighbors.values()], params, elapsed)
        leader = lost_leader(memory, neighbors, me, params)
    flock = _flock(memory, me.stamp, state, leader, params)
    missed = leader
    if leader is None and neighbors.faced is None:
        missed = find_newest((n for n in flock.values() if n.member.role != AVOID), me)
    brought_up = memory._replace(flock=flock, motions=update_motions(
        memory.motions, flock.values()) if flock else memory.motions)
    scene = Scene(state, me, blinded, neighbors, leader, missed, {
        name: _predict(n, brought_up, me, params) for name, n in flock.items()})
    lost = _loss(memory, flock, scene, params)
    return brought_up if lost is memory.lost else brought_up._replace(lost=lost), scene


def _predict(n: Neighbor, memory: Memory, me: OwnState,
             params: PlannerParams) -> Prediction:
    """Return the prediction of a neighbor; if received, with the spread of its covariance."""
    age = me.stamp - n.stamp
    it = predict(n, memory.acceleration(n), age, params)
    if not n.received:  # errors of own sightings are part of the margin
        return it
    offset = np.subtract(it.position, me.position)
    along = offset / max(math.hypot(*offset.tolist()), SHORTEST)
    variance = along @ (n.position_covariance + age ** 2 * n.velocity_covariance) @ along
    return it._replace(spread=it.spread + RECEIVED_SIGMAS * math.sqrt(max(float(variance), 0.0)))


def _flock(memory: Memory, now: float, state: State, leader: Neighbor | None,
           params: PlannerParams) -> Mapping[str, Neighbor]:
    """
    Return the neighbors to keep clear of: present ones, and lost ones that may be near.

    :param leader: the leader to look for.
    """
    # The vehicle always keeps clear of vehicles to avoid; without TRACK no other estimate ages.
    flock = {name: n for name, n in memory.flock.items() if now - n.stamp <= params.coast_timeout
             or (state is not State.TRACK and n.member.role != AVOID)
             or (leader is not None and leader.name == name)
             or (silent(n, now, params) and now - n.stamp <= params.resume_timeout)}
    return by_name(flock | {n.name: n for n in memory.neighbors.values()
                            if state is State.TRACK or n.member.role == AVOID
                            or n.name in memory.flock})


def silent(n: Neighbor, now: float, params: PlannerParams) -> bool:
    """Return whether a received follower has become silent, so that it may have failed."""
    return (n.received and n.member.role == FOLLOWER
            and now - n.stamp > params.heard_timeout)


def expected_now(n: Neighbor, memory: Memory, now: float, params: PlannerParams) -> Neighbor:
    """Return a lost neighbor at its expected place, predicted by at most ``coast_timeout``."""
    age = min(now - n.stamp, params.coast_timeout)
    it = predict(n, memory.acceleration(n), age, params)
    return n._replace(stamp=n.stamp + age, position=np.array(it.position),
                      velocity=np.array(it.velocity))


def _loss(memory: Memory, flock: Mapping[str, Neighbor], scene: Scene,
          params: PlannerParams) -> Loss | None:
    """Return the loss of the neighbor that was followed, or is searched for."""
    me, leader = scene.me, scene.leader
    if (scene.state is State.TRACK and leader is None) or memory.followed is None:
        return None
    seen_at = -math.inf if scene.missed is None else scene.missed.stamp
    if memory.lost is None or me.stamp - seen_at <= MAX_ACCELERATION_AGE:
        # Seen again, if only for a moment: the retreat begins anew at the place that was seen.
        lost = _new_loss(memory, flock, scene, params)
    else:
        along = memory.lost.towards
        ahead = max(float(along @ (me.position - memory.lost.origin)), 0.0)
        lost = memory.lost._replace(origin=memory.lost.origin + ahead * along)
    # Without a camera and a place there is no direction to back away from.
    return lost._replace(approach=0.0) if scene.blinded and not lost.name else lost


def _new_loss(memory: Memory, flock: Mapping[str, Neighbor], scene: Scene,
              params: PlannerParams) -> Loss:
    """Return the loss of the neighbor that was followed in the last tick."""
    me, leader = scene.me, scene.leader
    near = [leader] if leader else [n for n in flock.values() if n.member.role != AVOID]
    towards = np.array([math.cos(me.yaw), math.sin(me.yaw), 0.0])
    if not near:  # the odometry jumped: the neighbor is at the near edge of the band, or farther
        free = float(towards @ me.position) + math.sqrt(params.law.d0)
        return Loss(towards, me.position, free, memory.coming, float(me.position[2]),
                    np.zeros(3), '')
    n = min(near, key=lambda n: (math.dist(n.position, me.position), n.name))
    x, y, _ = expected_now(n, memory, me.stamp, params).position - me.position
    if math.hypot(x, y) > OVERHEAD_DISTANCE:
        towards = np.array([x, y, 0.0]) / math.hypot(x, y)
    soon = predict(n, memory.acceleration(n), TRUSTED_TIME, params)
    approach = max(-float(towards @ n.velocity), -float(towards @ soon.velocity), 0.0)
    side = across_path(soon.velocity, np.subtract(me.position, soon.position))
    return Loss(towards, me.position, float(towards @ n.position), approach,
                float(n.position[2]), side, n.name)


def across_path(velocity: Sequence[float], offset: Array) -> Array:
    """
    Return the horizontal unit vector (3,) across a path, towards the vehicle; zero without path.

    :param velocity: of the neighbor (3,), m/s.
    :param offset: ego position minus the neighbor's (3,), m.
    """
    x, y, _ = velocity
    length = math.hypot(x, y)
    if length < SHORTEST:
        return np.zeros(3)
    across = np.array([-y, x, 0.0]) / length
    return math.copysign(1.0, float(across @ offset)) * across
