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

"""Where to turn the nose, and with it the camera: to the neighbour, after it, round for it."""

from __future__ import annotations

import math

from flock_follower.geometry import wrap_angle
from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.planner.params import PlannerParams

YAW_GAIN = 1.5  # 1/s: a rate that follows within 0.3 s, delays included, leaves a damping of 0.75
YAW_LEAD = 0.4  # s: in which a vehicle turns to 63 % of a commanded yaw
OVERHEAD = 0.1  # m: closer than this horizontally, the direction to a neighbour is noise
LOOK_ASIDE = 0.8  # rad to either side of where it was lost, before looking all round
LOOK_THERE = 1.0  # s for which it is awaited there first


def facing(last: float, me: OwnState, neighbor: NeighborEstimate, params: PlannerParams,
           elapsed: float) -> float:
    """Return the yaw that turns from the last one to where a neighbour is about to be."""
    x, y, _ = neighbor.position - me.position
    distance = math.hypot(x, y)
    if params.yaw_mode != 'leader' or distance < OVERHEAD:
        return last
    w = neighbor.velocity - me.velocity
    passing = float(x * w[1] - y * w[0]) / distance ** 2  # rad/s
    ahead = YAW_LEAD * min(max(passing, -params.yaw_rate_max), params.yaw_rate_max)
    return _turned(last, math.atan2(y, x) + ahead, params, elapsed)


def scanning(last: float, params: PlannerParams, elapsed: float) -> float:
    """Return the yaw that turns on from the last one to look round, anticlockwise."""
    if params.yaw_mode != 'leader':
        return last
    return wrap_angle(last + min(params.scan_rate, params.yaw_rate_max) * elapsed)


def searching(last: float, lost: float, since: float, params: PlannerParams,
              elapsed: float) -> float:
    """
    Return the yaw that looks where a neighbour was lost, to both sides, then all round.

    :param lost: direction in which it was lost, rad; :param since: how long it is searched, s.
    """
    if params.yaw_mode != 'leader':
        return last
    swept = params.scan_rate * max(since - LOOK_THERE, 0.0)
    aside = swept if swept < LOOK_ASIDE else 2.0 * LOOK_ASIDE - swept  # and on, clockwise
    return _turned(last, lost + aside, params, elapsed)


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


def _turned(last: float, wanted: float, params: PlannerParams, elapsed: float) -> float:
    most = params.yaw_rate_max * elapsed
    return wrap_angle(last + min(max(wrap_angle(wanted - last), -most), most))
