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
Altitude and yaw control: the altitude to hold, the vertical acceleration and the yaw.

The altitude to hold follows the altitude of the nearest neighbor, because a camera that looks
ahead loses a neighbor that climbs or descends. The altitude control has the characteristic
polynomial (s + w)^2, critically damped. The gate offsets an error of the hover thrust.

The vehicle stops at the lowest and at the highest altitude: its vertical speed is limited by the
distance to them at the time when a command acts. With a limit on the target altitude only, the
vehicle overshot by 0.25 m, because of the target's climb and of commands not flown yet.

The neighbor's vertical velocity is smoothed, without lag if its acceleration is known. A small
velocity v, similar to the noise, counts as v / (1 + (CLIMB_NOISE / v)^4). A height difference, for
example after a loss, is reduced slowly: because of the vehicle's delay, a fast climb would exceed
``v_max``.

The yaw turns the camera to the neighbor, or turns round to search for it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from flock_follower.geometry import wrap_angle
from flock_follower.planner.inputs import Neighbor, OwnState, TRUSTED_ACCELERATION
from flock_follower.planner.params import PlannerParams

SPEED_SHARE = 0.8  # of v_max, vertically: it overshoots, as it answers late
CLIMB_NOISE = 0.1  # m/s: a neighbor's vertical velocity below this is mostly noise
CLIMB_GAIN = 0.3  # share of a change in it that is used at once if its acceleration is known
HEIGHT_GAIN = 0.5  # likewise of a change in its height
CATCH_UP_TIME = 0.5  # s in which a height that is missing is caught up with, as far as allowed
ALTITUDE_MARGIN = 0.1  # m: margin to both bounds, for thrust errors and noise
BRAKING = 0.5  # m/s^2 with which it stops before the lowest and the highest altitude
ALTITUDE_RETURN_SPEED = 0.3  # m/s with which it returns from beyond a bound
CLIMB_ACCELERATION = 0.6  # m/s^2 with which that begins


class Altitude(NamedTuple):
    """The altitude to hold, m, and the state of its control, between one step and the next."""

    held: float
    """Altitude to hold, m."""
    lowest: float
    """Lowest altitude, m; the vehicle is lower only if the flight began lower."""
    highest: float
    """Highest altitude, m."""
    climb: float = 0.0
    """Rate of ``held``, m/s."""
    commanded: float = math.nan
    """The altitude to which the command leads, m; NaN while neighbors limit the climb."""
    neighbor_climb: float | None = None
    """Vertical velocity of the followed neighbor, m/s; None without one."""
    ground: float | None = None
    """Height at which the vehicle was armed, m; None if unknown."""
    limits: tuple[float, float] | None = None
    """``altitude_min`` and ``altitude_max`` that give the bounds, m."""

    @classmethod
    def begin(cls, me: OwnState, ground: float | None, params: PlannerParams) -> Altitude:
        """
        Return the altitude at which the planner becomes active, to hold.

        :param ground: height at which the vehicle was armed, m; None if unknown.
        """
        z, limits = float(me.position[2]), (params.altitude_min, params.altitude_max)
        if ground is None:
            return cls(z, z, max(z + limits[1], z), ground=ground, limits=limits)
        low, high = _within_limits(ground, params)
        return cls(z, min(low, z), max(high, z), ground=ground, limits=limits)

    def after_jump(self, z: float, jump: float) -> Altitude:
        """Return this altitude, now ``z``, m, in an odometry frame higher by ``jump``, m."""
        return Altitude(z, min(self.lowest + jump, z), max(self.highest + jump, z),
                        ground=None if self.ground is None else self.ground + jump,
                        limits=self.limits)

    def with_limits_of(self, params: PlannerParams) -> Altitude:
        """Return the altitude with the bounds of parameters that have changed in flight."""
        limits = params.altitude_min, params.altitude_max
        if self.limits is None or limits == self.limits:
            return self
        if self.ground is None:
            return self._replace(limits=limits, highest=self.lowest + max(limits[1], 0.0))
        (low, high), (least, most) = _within_limits(self.ground, params), self.limits
        # A looser bound never moves a vehicle that began beyond it.
        lowest = low if limits[0] > least else min(low, self.lowest)
        highest = high if limits[1] < most else max(high, self.highest)
        if lowest > highest:  # their margins overlap
            lowest = highest = 0.5 * (lowest + highest)
        return self._replace(limits=limits, lowest=lowest, highest=highest)

    def follow(self, leader: Neighbor | None, params: PlannerParams,
               elapsed: float) -> Altitude:
        """Return the altitude after ``elapsed`` s of following a neighbor."""
        if leader is None:
            return self._replace(climb=0.0, neighbor_climb=None)
        goal = float(leader.position[2]) + params.altitude_offset
        within = min(max(goal, self.lowest), self.highest)
        most, faster = params.climb_rate, CLIMB_ACCELERATION * elapsed
        neighbor_climb = float(leader.velocity[2])
        if self.neighbor_climb is not None and leader.acceleration is not None:
            # Smoothed, without lag if it accelerates.
            change = min(max(float(leader.acceleration[2]), -TRUSTED_ACCELERATION),
                         TRUSTED_ACCELERATION) * elapsed
            due = self.neighbor_climb + change
            neighbor_climb = due + CLIMB_GAIN * (neighbor_climb - due)
        significant = 0.0
        if within == goal:
            share = (neighbor_climb / CLIMB_NOISE) ** 4  # share that exceeds its noise
            significant = min(max(neighbor_climb * share / (1.0 + share), -most), most)
        ahead = self.held + significant * elapsed
        ahead = min(max(ahead + HEIGHT_GAIN * (within - ahead), self.lowest), self.highest)
        held = min(max(ahead, self.held - most * elapsed), self.held + most * elapsed)
        climb = min(max(significant + (ahead - held) / CATCH_UP_TIME, -most), most)
        climb = min(max(climb, min(self.climb, significant) - faster),
                    max(self.climb, significant) + faster)
        return self._replace(held=held, climb=climb, neighbor_climb=neighbor_climb)

    def control(self, me: OwnState, params: PlannerParams, least: float = -math.inf,
                most: float = math.inf, coming: float = 0.0, raised: float = -math.inf
                ) -> tuple[Altitude, float]:
        """
        Return the next altitude, and the vertical acceleration, m/s^2, for the next period.

        :param least: least vertical speed, m/s, that neighbors permit; :param most: the largest.
            The lowest and the highest altitude have priority.
        :param coming: vertical velocity, m/s, that is commanded, but not flown yet.
        :param raised: least altitude to hold now, m; it does not change ``held``.
        """
        w = params.altitude_frequency
        strongest = min(params.max_vertical_acceleration, params.a_max)
        z, rate = float(me.position[2]), float(me.velocity[2])
        goal = max(self.held, raised)
        speed, fastest = self.climb + 0.5 * w * (goal - z), SPEED_SHARE * params.v_max
        # Until a command acts the vehicle keeps its velocity.
        reached = z + rate * params.response_time
        down, up = (min(_stopped_within(gap, 0.5 * w), fastest)
                    for gap in (reached - self.lowest, self.highest - reached))
        clear = max(min(speed, most), least)
        nominal = 2.0 * w * (min(max(clear, -down), up) - rate)
        vertical = min(max(nominal, -strongest), strongest)
        # An overshoot of the climb would be taken from backing off, which shares v_max with it.
        if most < math.inf:
            high = min(max(most, -down), up) - rate - coming
            vertical = min(vertical, max(high / params.guarding.T_g, -strongest))
        if least > -math.inf:
            low = max(min(least, up), -down) - rate - coming
            vertical = max(vertical, min(low / params.guarding.T_g, strongest))
        within = min(max(goal, self.lowest), self.highest)  # bounds may have changed in flight
        return self._replace(commanded=within if clear == speed else math.nan), vertical


def _within_limits(ground: float, params: PlannerParams) -> tuple[float, float]:
    """Return the lowest and the highest altitude, m, by the parameters."""
    return (ground + params.altitude_min + ALTITUDE_MARGIN,
            ground + params.altitude_max - ALTITUDE_MARGIN)


def _stopped_within(gap: float, gain: float) -> float:
    """
    Return the speed, m/s, from which it stops within a gap, m; negative: the return speed.

    :param gain: speed for each meter, 1/s, while the deceleration is at most BRAKING; farther away
        the deceleration is BRAKING.
    """
    near = BRAKING / gain ** 2
    if gap > near:
        return math.sqrt(2.0 * BRAKING * (gap - 0.5 * near))
    return max(gain * gap, -ALTITUDE_RETURN_SPEED)


YAW_GAIN = 1.5  # 1/s: a rate that follows within 0.3 s, delays included, leaves a damping of 0.75
YAW_LEAD = 0.4  # s: in which a vehicle turns to 63 % of a commanded yaw
OVERHEAD_DISTANCE = 0.1  # m: closer than this horizontally, the direction to a neighbor is noise
LOOK_ASIDE = 0.8  # rad to either side of the place of the loss, before looking all round
WIDER = 1.4  # times as far to the other side, until the turn is complete
LOOK_THERE = 0.5  # s for which the vehicle faces that place first


def face_yaw(last: float, me: OwnState, neighbor: Neighbor, params: PlannerParams,
             elapsed: float) -> float:
    """Return the next yaw on the way from the last yaw to a neighbor's predicted place."""
    x, y, _ = (neighbor.position - me.position).tolist()
    distance = math.hypot(x, y)
    if distance < OVERHEAD_DISTANCE:
        return last
    vx, vy, _ = (neighbor.velocity - me.velocity).tolist()
    passing = (x * vy - y * vx) / distance ** 2  # rad/s
    ahead = YAW_LEAD * min(max(passing, -params.yaw_rate_max), params.yaw_rate_max)
    return _turn_toward(last, math.atan2(y, x) + ahead, params, elapsed)


def search_yaw(last: float, me: OwnState, there: Neighbor, since: float, params: PlannerParams,
               elapsed: float) -> float:
    """
    Return the yaw towards the place where a neighbor is expected, to both sides, then all round.

    The first side is the one to which the neighbor moved.

    :param there: the neighbor at its expected place; :param since: duration of the search, s.
    """
    x, y, _ = there.position - me.position
    left = params.scan_rate * max(since - LOOK_THERE, 0.0)
    aside, end = 0.0, math.copysign(LOOK_ASIDE, x * there.velocity[1] - y * there.velocity[0])
    while left > abs(end - aside):
        left -= abs(end - aside)
        aside, end = end, -WIDER * end
    aside += math.copysign(left, end - aside)
    return _turn_toward(last, math.atan2(y, x) + aside, params, elapsed)


def turn_rate(before: float, commanded: float, me: OwnState, params: PlannerParams,
              elapsed: float) -> float:
    """
    Return the yaw rate, rad/s, anticlockwise, that follows the commanded yaw.

    The rate is that of the commanded yaw, plus a correction towards this yaw, because an autopilot
    that receives a rate does not control the yaw itself.

    :param before: the yaw commanded ``elapsed`` seconds ago, rad; ``commanded`` now.
    """
    ahead = wrap_angle(commanded - before) / elapsed if elapsed > 0.0 else 0.0
    rate = ahead + YAW_GAIN * wrap_angle(commanded - me.yaw)
    return min(max(rate, -params.yaw_rate_max), params.yaw_rate_max)


def _turn_toward(last: float, goal: float, params: PlannerParams, elapsed: float) -> float:
    most = params.yaw_rate_max * elapsed
    return wrap_angle(last + min(max(wrap_angle(goal - last), -most), most))
