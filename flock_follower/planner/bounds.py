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
The bounds on a command that one neighbor causes: separation, cohesion, sight.

The guard keeps ``sqrt(d0) < r < sqrt(d1)`` if the law alone does not. With p = x_F - x_L from the
neighbor to the ego vehicle, w = v_F - v_L, r = |p|, n = p / r and s = n . w, the guard limits the
rate s of the distance, so that the vehicle can stop before the margin m inside an edge:

    h_near = s + S(r - sqrt(d0) - m) >= 0     S(g) = b (sqrt(tau^2 + 2 g / b) - tau)   for g >= 0
    h_far  = S(sqrt(d1) - m - r) - s >= 0     S(g) = max(g / tau, -EDGE_RETURN_SPEED)  for g < 0

S(g) is the highest speed that can be stopped within g: a reaction time tau, then a deceleration b.
Both are barrier functions: if dh/dt >= -h / T_g, each stays positive, or returns to zero with the
time constant T_g (Ames et al., "Control Barrier Functions: Theory and Applications", ECC 2019).
As ds/dt = n . (a - a_L) + |w_t|^2 / r, with w_t the part of w across n, this requires

    n . a >= n . a_L - |w_t|^2 / r - (s + S(g_near)) / T_g - S'(g_near) s
    n . a <= n . a_L - |w_t|^2 / r - (s - S(g_far)) / T_g - S'(g_far) s

of the acceleration a. The unknown part of a_L reduces the margin, see ``docs/guard.md``.

Behind another follower a headway T_h grows the near edge with the ego speed -n . v_F towards it:

    g_near = r - sqrt(d0) - m - T_h (v_max - n . v_F)

Then dg_near/dt = s + T_h (n . a + w_t . v_F / r) contains the ego acceleration a. With A the right
side of the first inequality above, the bound becomes n . a >= (A - S'(g_near) T_h w_t . v_F / r) /
(1 + S'(g_near) T_h). At the edge the transfer function from the velocity of the vehicle ahead to
the follower's is (1 + tau z) / (1 + (tau + T_h) z), z the Laplace variable: without delays no
motion of a column grows from one follower to the next.

The air below and above another vehicle is disturbed, so there is a separate bound on the
horizontal distance. The height of a neighbor out of sight is unknown: only its horizontal distance
counts.

If only the distance to a neighbor is known (by ranges, out of sight), the neighbor may be anywhere
on a sphere around the ego vehicle. The follower then backs away from the last known place. This is
right as long as the neighbor cannot have reached the other side of the sphere: at ``v_max`` it
moves at most v_max t in a time t, which must be less than sqrt(r^2 + d^2), with r the distance to
the last known place and d the measured distance. After this time the direction is a guess, and the
fences have priority.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np

from flock_follower.geometry import GRAVITY, SHORTEST, wrap_angle
from flock_follower.messages import SANE
from flock_follower.planner.bound_keeping import Bound, COHESION, FENCE, SEPARATION, SIGHT
from flock_follower.planner.inputs import (
    Neighbor,
    OwnState,
    predict,
    Prediction,
)
from flock_follower.planner.params import (
    Edges,
    FOLLOWER,
    GuardParams,
    Member,
    PlannerParams,
)
from flock_follower.planner.sight import FieldsOfView, IMAGE_MARGIN, vertical
from flock_follower.planner.vectors import (
    difference,
    horizontal,
    opposite,
    scalar_product,
    ZERO_VECTOR,
)
from flock_follower.planner.vertical_yaw import OVERHEAD_DISTANCE

# The fixed margins; the margin m of the band is a parameter, GuardParams in planner/params.py.
DOWNWASH_SHARE = 0.9  # least horizontal distance at any height, as a share of sqrt(d0)
ALIKE = 0.35  # share of the horizontal distance: with less height between, the distance suffices
DEVIATIONS = 2.0  # standard deviations of a measured distance, if only that is known
# When the neighbor is seen again, v_max goes into its altitude first.
DISTANCE_ONLY_MARGIN = 0.3  # m of extra distance if only the distance is known
STOP_SHARE = 0.6  # of a_max: deceleration of the stop before a place that was not seen free
TURNING_SHARE = 0.8  # of yaw_rate_max, to follow a neighbor that passes
TURNING_TIME = 0.3  # s in which its passing is brought to what the yaw can follow
MARKER_ANGLE = math.radians(60.0)  # largest angle between a marker's normal and the line of sight
# A column that is pushed back buckles.
COLUMN_ANGLE = math.radians(30.0)  # largest angle to the marker's normal behind a follower
MARKER_GAIN = 1.0  # 1/s: speed around the neighbor for each meter of arc that is left
MARKER_SHARE = 0.3  # of v_max: speed with which an angle beyond the largest is reduced


def radial_bounds(offset: Sequence[float], relative_velocity: Sequence[float], edges: Edges,
                  params: GuardParams, neighbor_acceleration: Sequence[float] = ZERO_VECTOR,
                  seen: bool = True, velocity: Sequence[float] = ZERO_VECTOR) -> list[Bound]:
    """
    Return the guard's bounds for one neighbor: separation, and cohesion if there is a far edge.

    Without a direction, or with a value that is not finite, the list is empty.

    :param offset: ego position minus the neighbor's, (3,), m.
    :param relative_velocity: ego velocity minus the neighbor's, (3,), m/s.
    :param neighbor_acceleration: a_L, the known part of the neighbor's acceleration (3,), m/s^2.
    :param seen: whether the neighbor is in sight.
    :param velocity: ego velocity (3,), m/s; used only with a headway.
    """
    (x, y, z), w, a = offset, relative_velocity, neighbor_acceleration
    distance = math.hypot(x, y, z)
    if not (SHORTEST < distance < SANE and math.hypot(*w, *a) < SANE):
        return []  # as for NaN, which fails every comparison
    n = x / distance, y / distance, z / distance
    rate = scalar_product(n, w)
    common = scalar_product(n, a) - max(scalar_product(w, w) - rate ** 2, 0.0) / distance
    # The growing sphere of possible places approaches at its growth rate.
    closing = rate - edges.spreading
    away = scalar_product(n, velocity)
    gap = distance - edges.near - edges.margin - edges.spread - edges.headway * max(
        edges.fastest - away, 0.0)
    speed, slope = params.closing_speed(gap)
    lowest = common - (closing + speed) / params.T_g - slope * closing
    if edges.headway > 0.0:
        turned = (scalar_product(w, velocity) - rate * away) / distance
        lowest = (lowest - slope * edges.headway * turned) / (1.0 + slope * edges.headway)
    bounds = [Bound(n, lowest, SEPARATION, distance, seen)]
    if math.isfinite(edges.far):
        speed, slope = params.closing_speed(edges.far - edges.margin - distance)
        highest = common - (rate - speed) / params.T_g - slope * rate
        bounds.append(Bound(opposite(n), -highest, COHESION, distance, seen))
    return bounds


def in_sight(it: Prediction, position: Sequence[float], velocity: Sequence[float], seen: bool,
             followed: bool, params: PlannerParams, radii: float = 0.0, headway: float = 0.0
             ) -> list[Bound]:
    """
    Return the bounds for one neighbor.

    :param position: ego position (3,), m; :param velocity: ego velocity when the command acts
        (3,), m/s.
    :param seen: whether the neighbor is in sight; if not, its last height is unreliable.
    :param followed: whether the neighbor is followed; if not, the vehicle only keeps clear of it.
    :param radii: sum of the radii of the neighbor and the ego vehicle, m.
    :param headway: see ``Edges``, s.
    """
    inner = params.edges
    band = Edges(inner.near + radii, inner.far + radii if followed else math.inf, inner.margin,
                 it.spread, it.spreading, headway, params.fastest)
    x, y, z = offset = difference(position, it.position)
    rate = difference(velocity, it.velocity)
    bounds = radial_bounds(offset, rate, band, params.guarding, it.acceleration,
                           velocity=velocity) if seen else []
    if not (seen and abs(z) < ALIKE * math.hypot(x, y)):
        near = (DOWNWASH_SHARE if seen else 1.0) * inner.near + radii
        level = band._replace(near=near, far=math.inf)
        bounds += radial_bounds(
            horizontal(offset), horizontal(rate), level, params.guarding,
            horizontal(it.acceleration), seen, horizontal(velocity))
    return bounds


def stop(along: Sequence[float], left: float, velocity: Sequence[float],
         params: PlannerParams) -> Bound:
    """Return the bound that makes the vehicle stop along a unit vector within ``left`` m."""
    guarding, rate = params.guarding, scalar_product(along, velocity)
    # Until the command acts the vehicle keeps its velocity.
    speed, slope = guarding.closing_speed(left - max(rate, 0.0) * params.response_time,
                                          max(guarding.b, STOP_SHARE * params.strongest))
    return Bound(
        opposite(along), (rate - max(speed, 0.0)) / guarding.T_g + slope * max(rate, 0.0), FENCE)


def clear_of_sphere(n: Neighbor, known: Neighbor | None, me: OwnState,
                    velocity: Sequence[float], params: PlannerParams) -> list[Bound]:
    """
    Return the bound, if any, for a neighbor of which only the distance is known.

    :param known: the last estimate of its position; None without an estimate.
    :param velocity: ego velocity when the command acts (3,), m/s.
    """
    acceleration = ZERO_VECTOR if n.acceleration is None else n.acceleration.tolist()
    it = predict(n, acceleration, me.stamp - n.stamp, params)
    sight = np.subtract(it.position, me.position)
    distance, level = math.hypot(*sight.tolist()), math.hypot(*sight[:2].tolist())
    if not level > SHORTEST:
        return []
    along = sight / distance
    towards, sure = np.array([sight[0], sight[1], 0.0]) / level, False
    if known is not None:
        x, y, _ = (known.position - me.position).tolist()
        apart = math.hypot(x, y)
        if apart > SHORTEST:
            towards = np.array([x, y, 0.0]) / apart
            sure = params.fastest * (me.stamp - known.stamp) <= math.hypot(apart, distance)
    variance = float(along @ n.position_covariance @ along)
    # The measured rate; until the command acts only the ego motion on that line changes.
    rate = float(along @ (it.velocity - me.velocity) - towards @ (velocity - me.velocity))
    inner = params.edges
    band = inner._replace(
        near=inner.near + params.radius + n.member.radius, far=math.inf, spreading=it.spreading,
        spread=it.spread + DISTANCE_ONLY_MARGIN + DEVIATIONS * math.sqrt(max(variance, 0.0)))
    return radial_bounds((-distance * towards).tolist(), (-rate * towards).tolist(), band,
                         params.guarding, (float(along @ it.acceleration) * towards).tolist(),
                         sure)


def sight_bounds(offset: Sequence[float], velocity: Sequence[float], it: Prediction, yaw: float,
                 view: FieldsOfView, params: PlannerParams) -> list[Bound]:
    """
    Return the bounds that keep a neighbor in the image; vectors (3,) in the odometry frame.

    A vehicle that accelerates forward by a lowers its nose, and the camera, by a / g. The yaw
    follows a passing neighbor at no more than ``yaw_rate_max``:

        g (tan(lowest) - tan e) <= f . a <= g (tan(highest) - tan e)    e: elevation
        |t . (v_L - v_F)| <= 0.8 yaw_rate_max r                         f, t: towards it, across

    :param offset: the neighbor's position minus the ego position, m.
    :param velocity: ego velocity, m/s; :param yaw: ego yaw, rad.
    """
    x, y, z = offset
    distance = math.hypot(x, y)
    if distance < OVERHEAD_DISTANCE:
        return []
    up, down = vertical(view, math.atan2(y, x) - yaw)
    forward = [x / distance, y / distance, 0.0]
    slope = z / distance
    # Its height alone never forces a horizontal motion: altitude control follows its height.
    faster = max(GRAVITY * (math.tan(max(up - IMAGE_MARGIN, 0.0)) - slope), 0.0)
    slower = max(GRAVITY * (math.tan(max(down - IMAGE_MARGIN, 0.0)) + slope), 0.0)
    left = [-y / distance, x / distance, 0.0]
    passing = scalar_product(left, difference(it.velocity, velocity))
    turning = TURNING_SHARE * params.yaw_rate_max * distance
    across = scalar_product(left, it.acceleration)
    return [Bound(opposite(forward), -faster, SIGHT), Bound(forward, -slower, SIGHT),
            Bound(left, (passing - turning) / TURNING_TIME + across, SIGHT),
            Bound(opposite(left), (-passing - turning) / TURNING_TIME - across, SIGHT)]


def marker_bounds(offset: Sequence[float], velocity: Sequence[float], it: Prediction, yaw: float,
                  member: Member, params: PlannerParams) -> list[Bound]:
    """
    Return the bounds on the viewing angle of a neighbor's marker.

    The viewing angle, between the line of sight and the marker's normal, is at most MARKER_ANGLE;
    behind a follower COLUMN_ANGLE. To keep it, the vehicle moves round the neighbor. The arguments
    are those of ``sight_bounds``.

    :param yaw: the neighbor's, rad.
    """
    x, y, _ = offset
    distance = math.hypot(x, y)
    if distance < OVERHEAD_DISTANCE or not member.faces:  # without a marker it has no angle
        return []
    there = math.atan2(-y, -x)
    off = min((wrap_angle(there - yaw - face) for face in member.faces), key=abs)
    side = math.copysign(1.0, off)
    outward = [side * y / distance, -side * x / distance, 0.0]
    widest = COLUMN_ANGLE if member.role == FOLLOWER else MARKER_ANGLE
    left = (widest - abs(off)) * distance
    fastest = max(MARKER_GAIN * left, -MARKER_SHARE * params.v_max)
    rate = scalar_product(outward, difference(velocity, it.velocity))
    across = scalar_product(outward, it.acceleration)
    return [Bound(opposite(outward), (rate - fastest) / TURNING_TIME - across, SIGHT)]
