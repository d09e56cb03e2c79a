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

"""The parameters of the planner, and the properties of vehicles known before the flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import NamedTuple

from flock_follower.flocking import FlockingParams
from flock_follower.messages import DUPLICATE, FASTEST, POSITION_STD_MAX
from flock_follower.ranges import (
    A_MAX,
    Checked,
    ODOM_TIMEOUT,
    parameter,
    PREDICT_TIMEOUT,
    Range,
    V_MAX,
)

ROLES = LEADER, FOLLOWER, AVOID = 'leader', 'follower', 'avoid'
RADIUS = Range(0.0, 5.0, 'm')


@dataclass(frozen=True)
class Member(Checked):
    """
    The role and size of a vehicle, known before the flight.

    :raises ValueError: naming the field, its value and the valid range.
    """

    role: str = parameter(
        LEADER, ROLES,
        "A 'leader' does not obey the law and goes where it wants; a 'follower' runs this "
        "package, too; one to 'avoid' is only kept clear of.")
    radius: float = parameter(0.0, RADIUS, 'Of its hull, m: distances are between hulls.')
    faces: tuple[float, ...] = parameter(
        (math.pi,), Range(-math.pi, math.pi, 'rad'),
        'Directions in which its markers face, anticlockwise from its own, rad.')


SEEN_DEFAULT, RECEIVED_DEFAULT = Member(LEADER), Member(FOLLOWER)  # strangers


def member(members: Mapping[str, Member], name: str, received: bool) -> Member:
    """
    Return role and size of a vehicle; if it is not listed, its role depends on its detection.

    A duplicate of a neighbor's marker is avoided, with the neighbor's radius.
    """
    base, duplicate, _ = name.partition(DUPLICATE)
    known = members.get(base, RECEIVED_DEFAULT if received else SEEN_DEFAULT)
    return Member(AVOID, known.radius) if duplicate else known


EDGE_RETURN_SPEED = 0.4  # m/s: beyond the margin of an edge the distance returns no faster
#: Largest margin to an edge, as a share of the band's width: half of a narrow band is left to the
#: law. From 1 to 1.5 m half of this costs 9 to 14 % jerk, and half more saves at most 4 %.
WIDEST_MARGIN = 0.24


@dataclass(frozen=True)
class GuardParams(Checked):
    """
    Parameters of the guard.

    :raises ValueError: naming the parameter, its value and the valid range.
    """

    tau: float = parameter(0.5, Range(0.05, 5.0, 's'), 'guard: reaction time', live=True)
    b: float = parameter(
        0.2, Range(0.1, 10.0, 'm/s^2'),
        'guard: deceleration with which an approach to an edge is stopped', live=True)
    T_g: float = parameter(
        0.4, Range(0.02, 2.0, 's'),
        "Time in which the distance's rate is brought to its bound, s.")
    m: float = parameter(
        0.38, Range(0.0, 5.0, 'm'),
        f'guard: margin to each edge, at most {WIDEST_MARGIN:g} of the width of the band',
        live=True)

    def closing_speed(self, gap: float, b: float | None = None) -> tuple[float, float]:
        """
        Return the speed S, m/s, and its slope S', 1/s, for a gap, m, to the margin of an edge.

        S is negative beyond the margin.

        :param b: deceleration, m/s^2; by default that of the parameters.
        """
        if gap < 0.0:
            returning = gap > -EDGE_RETURN_SPEED * self.tau
            return max(gap / self.tau, -EDGE_RETURN_SPEED), 1.0 / self.tau if returning else 0.0
        b = self.b if b is None else b
        root = math.sqrt(self.tau ** 2 + 2.0 * gap / b)
        return b * (root - self.tau), 1.0 / root


class Edges(NamedTuple):
    """The least and largest distance, m, to a neighbor, and the uncertainty of its position."""

    near: float
    far: float = math.inf
    margin: float = 0.0
    """Margin to each edge, m."""
    spread: float = 0.0
    """Largest distance of the neighbor from its expected position, m."""
    spreading: float = 0.0
    """Growth rate of ``spread``, m/s."""
    headway: float = 0.0
    """Headway, s: time for which the near edge leaves space at the closing speed."""
    fastest: float = 0.0
    """Speed of the neighbor towards the vehicle that the headway assumes, m/s."""

    @classmethod
    def of(cls, law: FlockingParams, params: GuardParams) -> Edges:
        """Return the edges of the law's band."""
        near, far = math.sqrt(law.d0), math.sqrt(law.d1)
        return cls(near, far, min(params.m, WIDEST_MARGIN * (far - near)))


#: Largest ``v_max`` beside other followers, m/s: in columns of six with 2 m/s members were lost,
#: and two came within 0.12 m of each other; with 1 m/s none came within 1.2 m.
COLUMN_V_MAX = 1.0
YAW_MODES = ('leader', 'hold')
CLIMB_SHARE = 0.6  # of v_max
ALTITUDE_MODES = ('follow', 'hold')


@dataclass(frozen=True)
class PlannerParams(Checked):
    """
    The parameters of a flight; the law's band of 1 to 8 m^2 and the limits are the paper's.

    :raises ValueError: naming the parameter, its value and the valid range.
    """

    law: FlockingParams = field(default_factory=lambda: FlockingParams(beta=0.25, d1=8.0))
    guard: bool = parameter(
        True, None,
        'keep the band of distances if the law alone does not; the guard cannot be switched off '
        'while the bridge is ACTIVE', live=True)
    guarding: GuardParams = field(default_factory=GuardParams)
    a_max: float = parameter(
        2.5, A_MAX,
        'largest magnitude of the acceleration; never above its initial value, and only lowered '
        'while the bridge is ACTIVE; braking and separation use the initial value',
        live=True)
    v_max: float = parameter(
        0.5, V_MAX, 'largest speed; the same conditions as for a_max', live=True)
    a_max_start: float = parameter(
        0.0, Range(0.0, 20.0, 'm/s^2'),
        'initial ``a_max``, m/s^2, if it was lowered in flight; see ``strongest``.')
    v_max_start: float = parameter(
        0.0, Range(0.0, 20.0, 'm/s'),
        'initial ``v_max``, m/s, if it was lowered in flight; see ``fastest``.')
    period: float = parameter(
        0.1, Range(0.02, 1.0, 's'),
        'time between commands')
    predict_timeout: float = parameter(
        PREDICT_TIMEOUT, Range(0.2, 2.0, 's'),
        'age up to which a neighbor is extrapolated and followed', live=True)
    heard_timeout: float = parameter(
        1.0, Range(0.05, 5.0, 's'),
        'age up to which a state received from another vehicle is used')
    coast_timeout: float = parameter(
        2.0, Range(0.2, 10.0, 's'),
        'age of the last estimate up to which the vehicle coasts; then it brakes', live=True)
    odom_timeout: float = parameter(
        0.3, ODOM_TIMEOUT,
        'largest age of the odometry for commands; the planner brakes from half of it on or, if '
        'odometry is usually older, when the next message is overdue', live=True)
    perception_timeout: float = parameter(
        0.2, Range(0.1, 1.0, 's'),
        'time without an image processed by relative_pose after which the planner brakes; at '
        'least 2 periods of the camera', live=True)
    max_position_std: float = parameter(
        POSITION_STD_MAX, Range(0.01, 10.0, 'm'),
        'Largest standard deviation of a usable position, sqrt(trace), m.')
    max_velocity_std: float = parameter(
        1.0, Range(0.01, 10.0, 'm/s'),
        'Largest standard deviation of a usable velocity, sqrt(trace), m/s.')
    brake_time_constant: float = parameter(
        0.3, Range(0.1, 5.0, 's'), 'time in which braking reduces the speed to 37 %')
    response_time: float = parameter(
        0.3, Range(0.01, 1.0, 's'),
        'time in which the acceleration follows its command to 63 %')
    handover_time: float = parameter(
        0.5, Range(0.0, 5.0, 's'),
        "Time over which the law's command is faded in when following begins or changes, s.")
    altitude_mode: str = parameter(
        'follow', ALTITUDE_MODES,
        'follow the altitude of the leader, or of the nearest neighbor with an edge, or hold the '
        'one at which it became active', live=True)
    altitude_offset: float = parameter(
        0.0, Range(-2.0, 2.0, 'm'),
        'height above the followed neighbor', live=True)
    altitude_min: float = parameter(
        1.0, Range(-1000.0, 1000.0, 'm'),
        'least altitude above the height at arming; if the bridge does not know that height, the '
        'altitude at which the planner became active. A vehicle that begins below it does not '
        'climb at once', live=True)
    altitude_max: float = parameter(
        100.0, Range(-1000.0, 10000.0, 'm'),
        'greatest altitude above the same height; a value below the default permits a climb of at '
        'most 1 m out of the way of an approaching neighbor out of sight', live=True)
    climb_rate_max: float = parameter(
        0.8, Range(0.05, 10.0, 'm/s'),
        'largest rate at which the altitude to hold changes', live=True)
    altitude_frequency: float = parameter(
        1.5, Range(0.1, 5.0, 'rad/s'), 'natural frequency of the control of altitude')
    max_vertical_acceleration: float = parameter(
        1.5, Range(0.1, 10.0, 'm/s^2'),
        'largest acceleration of the control of altitude')
    leader_speed_max: float = parameter(
        2.0, Range(0.0, FASTEST, 'm/s'),
        'largest assumed speed of a neighbor out of sight', live=True)
    leader_acceleration_max: float = parameter(
        1.0, Range(0.0, 5.0, 'm/s^2'),
        'largest assumed acceleration of a neighbor out of sight; with more the vehicle retreats '
        'earlier', live=True)
    retreat_max: float = parameter(
        4.0, Range(0.0, 10.0, 'm'),
        'largest retreat from a neighbor out of sight, besides 2 s of v_max if it was not lost '
        'above; up to 3 m more if it was approaching; 0: no retreat', live=True)
    resume_timeout: float = parameter(
        30.0, Range(0.1, 3600.0, 's'),
        'time without a followed neighbor, up to which the planner follows again by itself; then '
        'it stops commanding until planner/engage is called', live=True)
    yaw_mode: str = parameter(
        'leader', YAW_MODES,
        'face the leader, or the nearest neighbor with an edge, or hold the yaw at which it '
        'became active', live=True)
    yaw_rate_max: float = parameter(
        1.0, Range(0.2, 6.0, 'rad/s'),
        'largest rate of the commanded yaw, and of the turn to it', live=True)
    scan_rate: float = parameter(
        1.0, Range(0.0, 3.0, 'rad/s'),
        'yaw rate of the search for a neighbor; 0: no search', live=True)

    radius: float = parameter(
        0.0, RADIUS, "radius of this vehicle's hull: all distances are between hulls", live=True)
    vehicles: Mapping[str, Member] = field(default_factory=dict, hash=False)
    """Roles and sizes of other vehicles, by name."""

    @property
    def strongest(self) -> float:
        """Return the largest acceleration of braking and of keeping clear, m/s^2."""
        return max(self.a_max, self.a_max_start)

    @property
    def fastest(self) -> float:
        """Return the largest speed of keeping clear of others, m/s."""
        return max(self.v_max, self.v_max_start)

    @cached_property
    def edges(self) -> Edges:
        """Return the edges of the law's band, for all neighbors of all ticks."""
        return Edges.of(self.law, self.guarding)

    @property
    def climb_rate(self) -> float:
        """Return the largest vertical speed, m/s; a part of v_max is left for level motion."""
        return min(self.climb_rate_max, CLIMB_SHARE * self.v_max)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.v_max > COLUMN_V_MAX:
            others = [name for name, each in self.vehicles.items() if each.role == FOLLOWER]
            if others:
                raise ValueError(f'v_max = {self.v_max!r}: must be at most {COLUMN_V_MAX:g} m/s '
                                 f'beside other followers: {min(others)}')
        for low, high in (('predict_timeout', 'coast_timeout'),
                          ('coast_timeout', 'resume_timeout'), ('altitude_min', 'altitude_max')):
            if getattr(self, high) < getattr(self, low):
                raise ValueError(f'{high} = {getattr(self, high)!r}: must be at least {low} = '
                                 f'{getattr(self, low)!r}')
