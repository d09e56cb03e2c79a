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
Which altitude to fly at, and the vertical acceleration that gets there.

The altitude to hold follows that of the nearest neighbour, because a camera that looks ahead
loses one that climbs or descends. It is controlled with the characteristic polynomial
s^3 + 2 w s^2 + w^2 s + w^3 / 5: critically damped, and an integral that takes up what the
autopilot's estimate of the hover thrust errs by.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.replacing import replace

LIFT_MAX = 1.2  # m/s^2: PX4's estimate of the hover thrust was seen to err by 1
SPEED_HORIZON = 0.5  # s
INTEGRAL_SHARE = 0.2  # of w^3: 3.3 s at 1.5 rad/s, where thrust errs for 10 s


@dataclass(frozen=True)
class Altitude:
    """The altitude to hold, m, and what holds it, between one step and the next."""

    held: float
    """m."""
    lowest: float
    """m: below it only where the flight began there."""
    highest: float
    """m."""
    climb: float = 0.0
    """How fast ``held`` changes, m/s."""
    lift: float = 0.0
    """The integral, m/s^2."""

    @classmethod
    def begun(cls, me: OwnState, ground: float | None, params: PlannerParams) -> Altitude:
        """
        Return the altitude of becoming active, to hold.

        :param ground: height at which the vehicle was armed, m, None where nobody knows.
        """
        z = float(me.position[2])
        if ground is None:
            return cls(z, z, z + params.altitude_max)
        return cls(z, min(ground + params.altitude_min, z), max(ground + params.altitude_max, z))

    def following(self, leader: NeighborEstimate | None, params: PlannerParams,
                  elapsed: float) -> Altitude:
        """Return it after following a neighbour, at the same time as oneself, for some time, s."""
        if leader is None or params.altitude_mode != 'follow':
            return replace(self, climb=0.0)
        wanted = float(leader.position[2]) + params.altitude_offset
        within = min(max(wanted, self.lowest), self.highest)
        most = params.climb_rate
        missing = within - self.held
        if abs(missing) > most * elapsed:
            climb = math.copysign(most, missing)
            return replace(self, held=self.held + climb * elapsed, climb=climb)
        # Not smoothed, though its noise makes most of the command's jerk: 0.1 s later, and of 100
        # leaders that climb at 0.8 m/s one is lost, and comes as near as 0.5 m.
        climb = float(leader.velocity[2]) if within == wanted else 0.0
        return replace(self, held=within, climb=min(max(climb, -most), most))

    def controlled(self, me: OwnState, params: PlannerParams,
                   elapsed: float) -> tuple[Altitude, float]:
        """Return it, and the vertical acceleration, m/s^2, for the next period."""
        w, most = params.altitude_frequency, min(params.max_vertical_acceleration, params.a_max)
        error = self.held - float(me.position[2])
        wanted = w * w * error + 2.0 * w * (self.climb - float(me.velocity[2]))
        # No faster than v_max when the command acts, and a little later.
        slowest, fastest = ((speed - float(me.velocity[2])) / SPEED_HORIZON
                            for speed in (-params.v_max, params.v_max))
        vertical = min(max(min(max(wanted, slowest), fastest), -most), most)
        lift = self.lift + INTEGRAL_SHARE * w ** 3 * error * elapsed
        # Anti-windup: at the limit the integral may only come back.
        if vertical != wanted and abs(lift) > abs(self.lift):
            lift = self.lift
        lift = min(max(lift, -LIFT_MAX), LIFT_MAX)
        total = min(max(vertical + self.lift, -params.a_max), params.a_max)
        return replace(self, lift=lift if math.isfinite(lift) else 0.0), total
