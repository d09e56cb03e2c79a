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
State of the planner between two steps, and the acceptance of new inputs.

An input that cannot be used is rejected with a reason. Nothing here reads a clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import math
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import numpy as np

from flock_follower.geometry import Array
from flock_follower.messages import FUTURE_TOLERANCE
from flock_follower.messages.jumps import jump, ODOMETRY_JUMP
from flock_follower.planner.inputs import (
    distance_known,
    implausible,
    Neighbor,
    OwnState,
    propagate,
    Rejection,
    too_far,
    uncertain,
    untimely,
)
from flock_follower.planner.params import member, PlannerParams
from flock_follower.planner.sight import Occlusion
from flock_follower.planner.vertical_yaw import Altitude

SMOOTHING_TIME = 0.3  # s in which an estimated acceleration is followed: most of its noise goes
SMOOTHING_GAP = 1.0  # s without an estimate after which the smoothing begins anew


class Motion(NamedTuple):
    """A neighbor's smoothed acceleration (3,), m/s^2, and its velocity (3,), m/s, at a stamp."""

    stamp: float
    velocity: list[float]
    acceleration: list[float]


def update_motions(motions: Mapping[str, Motion],
                   neighbors: Iterable[Neighbor]) -> dict[str, Motion]:
    """
    Return the motions of the neighbors, updated with their newest estimates.

    The acceleration is that of the estimate; if the estimate has none, the change of velocity.
    """
    updated = {}
    for n in neighbors:
        last, own = motions.get(n.name), n.acceleration
        velocity, acceleration = n.velocity.tolist(), None if own is None else own.tolist()
        if last is None or not 0.0 <= n.stamp - last.stamp <= SMOOTHING_GAP:
            last = Motion(n.stamp, velocity, acceleration or [0.0, 0.0, 0.0])
        elif last.stamp != n.stamp:
            elapsed = n.stamp - last.stamp
            if acceleration is None:
                acceleration = [(v - w) / elapsed for v, w in zip(velocity, last.velocity)]
            share = math.expm1(-elapsed / SMOOTHING_TIME)
            (x, y, z), (ax, ay, az) = last.acceleration, acceleration
            last = Motion(n.stamp, velocity, [
                x - share * (ax - x), y - share * (ay - y), z - share * (az - z)])
        updated[n.name] = last
    return updated


DRAG_TIME = 1.0  # s over which drag is observed
#: m: an estimate this far from the prediction is of another vehicle. Not ``ODOMETRY_JUMP``: a
#: neighbor accelerates unknown to us, and its estimate errs by up to half a meter.
NEIGHBOR_JUMP = 1.0


class Loss(NamedTuple):
    """The loss of sight of the followed neighbor."""

    towards: Array
    """Horizontal unit vector (3,) to its predicted place at the loss."""
    origin: Array
    """Place of the follower at the loss, moved on along ``towards`` since (3,), m: origin of the
    retreat."""
    free: float
    """Coordinate along ``towards`` up to which the last line of sight was free, m, in the
    frame of the odometry."""
    approach: float
    """Horizontal speed of approach at the loss, m/s; the largest possible if unknown."""
    height: float
    """Height of the neighbor at the loss, m."""
    side: Array
    """Horizontal unit vector (3,) across the neighbor's path, towards the follower."""
    name: str
    """Name of the lost neighbor; '' if its place is unknown."""

    def retreat_distance(self, position: Array) -> float:
        """Return the horizontal distance of a position (3,) from the origin, m."""
        return math.dist(position[:2], self.origin[:2])


NONE: Mapping[str, Any] = {}  # never changed


class Memory(NamedTuple):
    """The state that one step passes to the next step; ``Memory()`` is the initial state."""

    now: float | None = None
    own: OwnState | None = None
    neighbors: Mapping[str, Neighbor] = NONE
    flock: Mapping[str, Neighbor] = NONE
    """The present and the lost neighbors from which the follower keeps clear."""
    ranged: Mapping[str, Neighbor] = NONE
    """The neighbors of which only the distance is known now."""
    motions: Mapping[str, Motion] = NONE
    """Motions of the flock."""
    shares: Mapping[str, float] = NONE
    """As ``edges``, of the last step with a followed neighbor; see ``Neighborhood``."""
    edges: frozenset[str] = frozenset()
    faced: str = ''
    """The faced neighbor of the last step with a followed neighbor."""
    leader: Neighbor | None = None
    """Last estimate of the faced leader, seen or received."""
    looking: bool = False
    """Whether the vehicle searches for this leader while it follows other neighbors."""
    followed: float | None = None
    """Stamp of the newest estimate that was followed since IDLE, s."""
    lost: Loss | None = None
    """The loss of the followed neighbor, while it is lost."""
    given_up: bool = False
    """Whether there was no neighbor for too long: then no commands until engaged again."""
    begun: float | None = None
    """Time at which the state left IDLE, s."""
    altitude: Altitude | None = None
    """Altitude to hold since IDLE."""
    yaw: float | None = None
    """Last commanded yaw since IDLE, rad."""
    command: Array | None = None
    """Last commanded acceleration, m/s^2; None if the last step commanded nothing."""
    pending: Array = np.zeros(3)
    """Velocity (3,), m/s, that was commanded, but is not flown yet."""
    drag: Array = np.zeros(3)
    """Acceleration (3,), m/s^2, that drag or wind takes from the flown one."""
    params: PlannerParams | None = None
    """Parameters of the law in the last step; None if the law was not applied."""
    fading: tuple[Array, float] | None = None
    """Start of the fade-in of the law's command: the command (3,), m/s^2; the time, s."""
    occlusion: Occlusion | None = None
    """Whether the faced neighbor is occluded."""
    jumped: float | None = None
    """Stamp of the last jump of odometry, s: earlier estimates are in another frame."""
    disturbance: Any = None
    """See ``relative.Disturbance``."""
    coming: float = 0.0
    """Speed, m/s, at which a neighbor may approach while odometry is lost; see ``retreat``."""
    switched: float = -math.inf
    """Time at which odometry was last lost or returned, s: then the frame changes."""

    def acceleration(self, n: Neighbor) -> list[float]:
        """Return a neighbor's acceleration, (3,), m/s^2; zero for a received one, as outdated."""
        motion = self.motions.get(n.name)
        return [0.0, 0.0, 0.0] if n.received or motion is None else motion.acceleration

    def in_frame_of(self, own: OwnState, now: float, params: PlannerParams) -> Memory:
        """Return the memory for another odometry frame, without positions of the old frame."""
        altitude = None if self.altitude is None else Altitude.begin(own, None, params)
        return Memory(
            now=self.now, own=own, faced=self.faced, followed=self.followed, begun=self.begun,
            given_up=self.given_up, altitude=altitude, yaw=self.yaw, command=self.command,
            pending=self.pending, jumped=own.stamp, switched=now)

    def begun_afresh(self) -> Memory:
        """Return the memory without the data of the last flight."""
        return Memory(now=self.now, own=self.own, neighbors=self.neighbors,
                      jumped=self.jumped, given_up=self.given_up)


def ingest(memory: Memory, now: float, own: OwnState | None, neighbors: Iterable[Neighbor],
           params: PlannerParams) -> tuple[Memory, tuple[Rejection, ...]]:
    """
    Return the memory with the valid new inputs, without old inputs, and the rejections.

    The order of the estimates has no influence, because all later steps sort by name.
    """
    rejected: list[Rejection] = []
    if memory.now is not None and now < memory.now - FUTURE_TOLERANCE:
        rejected.append(Rejection('time jumped back', f'by {memory.now - now:.1f} s'))
        memory = Memory(given_up=memory.given_up)
    me, jumped, drag = memory.own, memory.jumped, memory.drag
    if own is not None:
        if problem := implausible(own) or untimely(own.stamp, now, params.odom_timeout):
            rejected.append(Rejection(f'odometry {problem.reason}', problem.detail))
        elif me is None or own.stamp >= me.stamp:
            if me is not None and own.relative is not me.relative:
                memory, me = memory.in_frame_of(own, now, params), own
                jumped, drag = own.stamp, memory.drag
            # From tick to tick, not from message to message: a jump between two ticks counts even
            # if the message of it was lost, and so does one of many small steps.
            by = 0.0 if me is None else jump(me, own, own.stamp - me.stamp, ODOMETRY_JUMP)
            if by:
                rejected.append(Rejection('odometry jumped', f'by {by:.2f} m'))
                jumped = own.stamp
                memory = memory._replace(
                    neighbors={}, flock={}, ranged={}, altitude=_after_jump(memory, own),
                    lost=None, leader=None, looking=False)
            if me is not None and not by and own.stamp > me.stamp:
                drag = _drag(memory, me, own, params)
            me = own
    kept = {name: n for name, n in memory.neighbors.items()
            if not untimely(n.stamp, now, max_age(n, params)) and not too_far(n, me)}
    ranged = {name: n for name, n in memory.ranged.items()
              if not untimely(n.stamp, now, params.coast_timeout)}
    for n in in_order(neighbors):
        what, before = 'received estimate' if n.received else 'estimate', kept.get(n.name)
        vague = uncertain(n, params)
        unusable = implausible(n) or untimely(n.stamp, now, max_age(n, params))
        outside, old = too_far(n, me), jumped is not None and n.stamp < jumped
        if (known := member(params.vehicles, n.name, n.received)) is not n.member:
            n = n._replace(member=known)
        if vague and not (unusable or outside or old or n.received) and (
                distance_known(n, me, params.max_position_std)):
            ranged[n.name] = n
        elif problem := unusable or vague or outside:
            rejected.append(Rejection(f'{what} {problem.reason}', f'{n.name}: {problem.detail}'))
        elif old:
            rejected.append(Rejection(f'{what} older than the jump of odometry', n.name))
        elif before is None or (before.received and not n.received):  # sightings come first
            kept[n.name] = n
        elif before.received == n.received and n.stamp >= before.stamp:
            if by := jump(before, n, n.stamp - before.stamp, NEIGHBOR_JUMP):
                rejected.append(Rejection(f'{what} jumped', f'{n.name}: by {by:.2f} m'))
            else:
                kept[n.name] = n
    ranged = {name: n for name, n in ranged.items()
              if name not in kept or n.stamp > kept[name].stamp}
    return memory._replace(now=now, own=me, neighbors=by_name(kept), ranged=by_name(ranged),
                           jumped=jumped, drag=drag), tuple(rejected)


def in_order(estimates: Iterable[Neighbor]) -> list[Neighbor]:
    """Return estimates by name and stamp, in an order that does not depend on the given one."""
    found = sorted(estimates, key=attrgetter('name'))
    if len({n.name for n in found}) < len(found):
        found.sort(key=_rank)
    return found


def _rank(n: Neighbor) -> tuple[Any, ...]:
    """Return a key that is equal only for equal estimates; NaN has no order, its bytes have."""
    known = math.isfinite(n.stamp)
    arrays = (n.position, n.velocity, n.position_covariance, n.velocity_covariance,
              n.acceleration)
    return (n.name, known, n.stamp if known else 0.0, n.received,
            *(b'' if each is None else each.tobytes() for each in arrays), repr((n.stamp, n.yaw)))


Known = TypeVar('Known')


def by_name(known: dict[str, Known]) -> dict[str, Known]:
    """Return a mapping sorted by name, so that sums and ties do not depend on the history."""
    return dict(sorted(known.items())) if len(known) > 1 else known


def _after_jump(memory: Memory, own: OwnState) -> Altitude | None:
    """Return the altitude in the frame of odometry that has jumped: its bounds jump, too."""
    if memory.altitude is None or memory.own is None:
        return None
    z, before = float(own.position[2]), propagate(memory.own, own.stamp)
    return memory.altitude.after_jump(z, z - float(before.position[2]))


def _drag(memory: Memory, before: OwnState, own: OwnState, params: PlannerParams) -> Array:
    """Return the acceleration flown minus the change of velocity (3,), m/s^2, smoothed."""
    elapsed = own.stamp - before.stamp
    lacking = memory.pending / params.response_time - (own.velocity - before.velocity) / elapsed
    return memory.drag + min(elapsed / DRAG_TIME, 1.0) * (lacking - memory.drag)


def update_pending(memory: Memory, command: Array, elapsed: float, params: PlannerParams) -> Array:
    """Return the commanded, not yet flown velocity (3,), m/s, after one more command."""
    left = math.exp(-elapsed / params.response_time)
    return left * memory.pending + (1.0 - left) * params.response_time * command


def max_age(n: Neighbor, params: PlannerParams) -> float:
    """Return the age up to which an estimate is used, s."""
    return params.heard_timeout if n.received else params.predict_timeout
