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
Control without odometry: controls distance and relative velocity to the leader by the marker.

The ego motion is then integrated from the autopilot's attitude and the flown accelerations; its
velocity drifts. The leader's estimate has the same drift, so distance and relative velocity have
no drift. Only these two are used. The speed over the ground is neither known nor limited.

A relative velocity, which is limited, and reached with the time constant VELOCITY_TIME, leads the
follower to the middle of the law's band. So all relative motion is damped; the common motion is
that of the leader (relative data cannot damp more: SWA, arXiv 2508.16460). An observer compensates
the relative acceleration that was not commanded: by the follower's tilt error, and by the leader's
motion. Other neighbors in sight limit the approach.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, SHORTEST
from flock_follower.messages.commands import OLDEST_MARKER, RELATIVE_ACCELERATION_MAX
from flock_follower.planner.inputs import (
    find_newest,
    Neighbor,
    OwnState,
    predict,
    propagate,
    untimely,
)
from flock_follower.planner.limits import limit_norm
from flock_follower.planner.memory import Memory, update_pending
from flock_follower.planner.modes import State
from flock_follower.planner.params import AVOID, PlannerParams
from flock_follower.planner.scene import Decision
from flock_follower.planner.vertical_yaw import Altitude, face_yaw, turn_rate

#: Largest vertical acceleration, m/s^2, besides the offset of the disturbance: the altitude
#: leaves the rest of ``RELATIVE_ACCELERATION_MAX`` to the distance.
VERTICAL_MAX = 0.6
#: Largest change of the command from one tick to the next, m/s^2: when the frame changes, too.
STEP_MAX = 0.25
#: For this long after the odometry has returned, s, changes of the command stay as small.
SETTLING_TIME = 1.0
#: Relative speed for each meter off the middle of the band, 1/s.
GAP_GAIN = 0.5
#: Largest relative speed, m/s.
APPROACH_SPEED_MAX = 0.4
#: Time constant with which the relative velocity is reached, s.
VELOCITY_TIME = 0.6
#: Of the observer of the disturbance, 1/s.
BANDWIDTH = 0.8
#: Largest disturbance that is compensated, m/s^2: without odometry the tilt of PX4 was wrong by
#: 1 m/s^2 for 10 s.
MAX_COMPENSATED_DISTURBANCE = 0.8
#: m beyond the band: an error of the tilt is then larger than the acceleration that may offset it,
#: the follower runs away, and commands nothing more.
RUNAWAY = 1.0
#: The gap to another neighbor is closed with a time constant not below this, s.
CLOSING = 2.0


class Disturbance(NamedTuple):
    """
    Relative acceleration that was not commanded.

    It comes from a tilt error or from the leader's acceleration.
    """

    velocity: Array | None = None
    """Estimated relative velocity (3,), m/s."""
    response: Array = np.zeros(3)
    """The part of the commanded acceleration (3,), m/s^2, that is flown already."""
    acceleration: Array = np.zeros(3)
    """Estimated disturbance (3,), m/s^2."""

    def update(self, velocity: Array, command: Array | None, elapsed: float,
               response_time: float) -> Disturbance:
        """Return the estimate after a relative velocity (3,), m/s: a Luenberger observer."""
        if self.velocity is None or command is None:
            return self._replace(velocity=velocity)
        response = self.response + (command - self.response) * -math.expm1(
            -elapsed / response_time)
        error = velocity - self.velocity
        estimate = self.acceleration + elapsed * BANDWIDTH ** 2 * error
        return Disturbance(
            self.velocity + elapsed * (response + self.acceleration + 2.0 * BANDWIDTH * error),
            response, limit_norm(estimate, MAX_COMPENSATED_DISTURBANCE))


def step(memory: Memory, own: OwnState, now: float, params: PlannerParams,
         elapsed: float) -> tuple[Memory, Decision]:
    """Return the memory for the next step, and the decision: HOLD if nothing can be commanded."""
    old = untimely(own.stamp, now, params.odom_timeout)
    seen = {name: n for name, n in memory.neighbors.items()
            if not n.received and now - n.stamp <= OLDEST_MARKER}
    leader = seen.get(memory.faced) or find_newest(
        (n for n in seen.values() if n.member.role != AVOID), own)
    if old is not None or leader is None:
        return _hold(memory, 'no neighbor in sight' if old is None else (
            f'the motion by attitude is {old.detail} old'))
    me, there = propagate(own, now), propagate(leader, now)
    gap, _ = _gap(there.position, me, leader, params)
    if gap > math.sqrt(params.law.d1) + RUNAWAY:
        return _hold(memory, f'{leader.name} is {gap:.1f} m away')
    altitude = (memory.altitude or Altitude.begin(me, None, params))._replace(
        lowest=-math.inf, highest=math.inf)
    rising = me.velocity
    if params.altitude_mode == 'follow':
        altitude = altitude._replace(held=float(there.position[2]) + params.altitude_offset)
        rising = me.velocity - [0.0, 0.0, there.velocity[2]]
    disturbance = (memory.disturbance or Disturbance()).update(
        me.velocity - there.velocity, memory.command, elapsed, params.response_time)
    bias = -disturbance.acceleration
    altitude, vertical = altitude._replace(climb=0.0).control(
        me._replace(velocity=rising), params)
    others = [n for n in seen.values() if n is not leader]
    command = limit_relative(
        level_command(me, memory.pending, leader, others, params) + bias[:2],
        min(max(vertical, -VERTICAL_MAX), VERTICAL_MAX) + float(bias[2]), memory.command)
    last = me.yaw if memory.yaw is None else memory.yaw
    yaw = face_yaw(last, me, there, params, elapsed) if params.yaw_mode == 'leader' else last
    return memory._replace(
        faced=leader.name, followed=leader.stamp, altitude=altitude, yaw=yaw, command=command,
        disturbance=disturbance,
        pending=update_pending(memory, command - bias, elapsed, params),
    ), Decision(State.RELATIVE, 'no odometry: flies by the marker alone', command, yaw,
                turn_rate(last, yaw, me, params, elapsed), stamp=leader.stamp)


def _hold(memory: Memory, reason: str) -> tuple[Memory, Decision]:
    return memory._replace(command=None, pending=np.zeros(3)), Decision(
        State.HOLD, f'no odometry, and {reason}')


def level_command(me: OwnState, coming: Array, leader: Neighbor, others: Sequence[Neighbor],
                  params: PlannerParams) -> Array:
    """
    Return the horizontal acceleration (2,), m/s^2, without limits.

    :param me: ego state, now; :param coming: velocity commanded, but not flown yet (3,), m/s.
    :param leader: the newest estimate of the neighbor to follow, at its stamp.
    :param others: the newest estimates of the neighbors to keep clear of.
    """
    law, age = params.law, me.stamp - leader.stamp
    a = [0.0, 0.0, 0.0] if leader.acceleration is None else leader.acceleration.tolist()
    there = predict(leader, a, age, params)
    velocity = me.velocity + coming
    gap, towards = _gap(np.array(there.position), me, leader, params)
    middle = math.sqrt(0.5 * (law.d0 + law.d1))
    fastest = min(APPROACH_SPEED_MAX, params.v_max)
    approach = limit_norm(GAP_GAIN * (gap - middle) * towards, fastest)
    relative = approach + np.array(there.velocity[:2]) - velocity[:2]
    result: Array = relative / VELOCITY_TIME
    for n in others:
        other = n.position + (me.stamp - n.stamp) * n.velocity
        gap, towards = _gap(other, me, n, params)
        closing = float(towards @ (velocity - n.velocity)[:2])
        # The full m in a narrow band, too: without odometry no far edge to others is kept.
        most = ((gap - math.sqrt(law.d0) - params.guarding.m) / CLOSING - closing) / VELOCITY_TIME
        result = result - max(float(towards @ result) - most, 0.0) * towards
    return result


def _gap(place: Array, me: OwnState, n: Neighbor, params: PlannerParams) -> tuple[float, Array]:
    """Return the horizontal distance between hulls, m, and the direction (2,) to a place."""
    x, y, _ = (place - me.position).tolist()
    distance = math.hypot(x, y)
    towards = np.array([x, y]) / distance if distance > SHORTEST else np.zeros(2)
    return distance - params.radius - n.member.radius, towards


def limit_relative(horizontal: Array, vertical: float, last: Array | None) -> Array:
    """
    Return the acceleration (3,), m/s^2: within the limit, the vertical first, and without steps.

    :param last: acceleration of the previous tick (3,), m/s^2; None if there was none.
    """
    up = min(max(vertical, -RELATIVE_ACCELERATION_MAX), RELATIVE_ACCELERATION_MAX)
    flat = limit_norm(horizontal, math.sqrt(RELATIVE_ACCELERATION_MAX ** 2 - up * up))
    return without_step(np.array([*flat, up]), last)


def without_step(acceleration: Array, last: Array | None) -> Array:
    """Return an acceleration (3,), m/s^2, at most STEP_MAX from the last one (None: zero)."""
    before = np.zeros(3) if last is None else last
    return before + limit_norm(acceleration - before, STEP_MAX)
