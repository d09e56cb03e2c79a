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

"""Altitude, yaw and limits: what a command holds besides the law's acceleration."""

from __future__ import annotations

import math

import numpy as np

from flock_follower.geometry import Array, wrap_angle
from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.planner.limits import limit_command, limit_norm, LimitedCommand
from flock_follower.planner.params import PlannerParams

YAW_GAIN = 1.5  # 1/s: a rate that follows within 0.3 s, delays included, leaves a damping of 0.75
OVERHEAD = 0.1  # m: closer than this horizontally, the direction to a neighbour is noise


def unflown(before: Array, command: Array, elapsed: float, params: PlannerParams) -> Array:
    """Return the velocity that is commanded and not flown one period from now, (3,), m/s."""
    if params.response_time == 0.0:
        return np.zeros(3)
    left = math.exp(-elapsed / params.response_time)
    return left * before + (1.0 - left) * params.response_time * command


def held_altitude(held: float | None, me: OwnState, params: PlannerParams) -> float | None:
    """Return the altitude to hold, m: that of before, else the present one; None for none."""
    if not params.altitude_hold:
        return None
    return float(me.position[2]) if held is None else held


def facing(last: float, me: OwnState, flock: list[NeighborEstimate], params: PlannerParams,
           elapsed: float) -> float:
    """Return the yaw that turns from the last one towards the nearest neighbour."""
    x, y, _ = min((n.position - me.position for n in flock), key=lambda p: float(p @ p))
    if params.yaw_mode != 'leader' or math.hypot(x, y) < OVERHEAD:
        return last
    most = params.yaw_rate_max * elapsed
    return wrap_angle(last + min(max(wrap_angle(math.atan2(y, x) - last), -most), most))


def scanning(last: float, params: PlannerParams, elapsed: float) -> float:
    """Return the yaw that turns on from the last one to look round, anticlockwise."""
    if params.yaw_mode != 'leader':
        return last
    return wrap_angle(last + min(params.scan_rate, params.yaw_rate_max) * elapsed)


def turning(before: float, commanded: float, me: OwnState, params: PlannerParams,
            elapsed: float) -> float:
    """
    Return the yaw rate, rad/s, anticlockwise, with which to turn along with the commanded yaw.

    That is the rate of the commanded yaw, plus a correction towards that yaw: an autopilot that
    is given a rate does not control the yaw itself.

    :param before: the yaw commanded ``elapsed`` seconds ago, rad; ``commanded`` now.
    """
    ahead = wrap_angle(commanded - before) / elapsed if elapsed > 0.0 else 0.0
    rate = ahead + YAW_GAIN * wrap_angle(commanded - me.yaw)
    return min(max(rate, -params.yaw_rate_max), params.yaw_rate_max)


def limited(wanted: Array, me: OwnState, altitude: float | None,
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
