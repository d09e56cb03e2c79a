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

"""The planner's parameters, what is known of each vehicle beforehand, and a quick ``replace``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
import math
from typing import Any, ClassVar, TypeVar

from flock_follower.flocking import FlockingParams
from flock_follower.messages import DUPLICATE
from flock_follower.ranges import Checked, Range

T = TypeVar('T')


def replace(instance: T, **changes: Any) -> T:
    """
    Return a dataclass with some fields changed, as ``dataclasses.replace``, but nothing checked.

    It takes a sixth of the time. For classes without ``__post_init__`` or slots.
    """
    changed = object.__new__(type(instance))
    vars(changed).update(vars(instance))
    vars(changed).update(changes)
    return changed


ROLES = LEADER, FOLLOWER, AVOID = 'leader', 'follower', 'avoid'
RADIUS = Range(0.0, 5.0, 'm')
PHANTOM = ' before'  # behind the name of one that may still be where another was taken for it


@dataclass(frozen=True)
class Member(Checked):
    """
    What is known of a vehicle beforehand.

    :raises ValueError: naming what is wrong, its value and what is valid.
    """

    role: str = LEADER
    """
    A 'leader' does not obey the law and goes where it wants; a 'follower' runs this package, too;
    one to 'avoid' is only kept clear of.
    """
    radius: float = 0.0
    """Of its hull, m: distances are between hulls."""
    faces: tuple[float, ...] = (math.pi,)
    """Directions in which its markers face, anticlockwise from its own, rad."""

    RANGES: ClassVar[dict[str, Range]] = {
        'radius': RADIUS, 'faces': Range(-math.pi, math.pi, 'rad')}
    CHOICES: ClassVar[dict[str, tuple[str, ...]]] = {'role': ROLES}


SEEN, HEARD = Member(LEADER), Member(FOLLOWER)  # strangers


def member(members: Mapping[str, Member], name: str, heard: bool) -> Member:
    """
    Return what is known of a vehicle; of a stranger, that depends on how it is known.

    What carries the marker of another without being it is avoided, and as large as that one.
    """
    base, duplicate, _ = name.removesuffix(PHANTOM).partition(DUPLICATE)
    known = members.get(base, HEARD if heard else SEEN)
    return Member(AVOID, known.radius) if duplicate else known


RETURN_SPEED = 0.3  # m/s: beyond the margin of an edge the distance returns no faster than this


@dataclass(frozen=True)
class GuardParams(Checked):
    """
    How the guard holds the band.

    :raises ValueError: naming the parameter, its value and the valid range.
    """

    tau: float = 0.5
    """Reaction time, s."""
    b: float = 1.0
    """Deceleration of the distance's change, m/s^2."""
    T_g: float = 0.2
    """Time in which the distance's rate is brought to its bound, s."""
    m: float = 0.25
    """Margin to each edge, m; at most 0.24 of the band's width, 0.12 m for 1 to 1.5 m."""

    RANGES: ClassVar[dict[str, Range]] = {
        'tau': Range(0.05, 5.0, 's'),
        'b': Range(0.1, 10.0, 'm/s^2'),
        'T_g': Range(0.02, 2.0, 's'),
        'm': Range(0.0, 5.0, 'm'),
    }

    def closing_speed(self, gap: float) -> float:
        """Return S, m/s, for a gap, m, to the margin of an edge; negative beyond the margin."""
        if gap < 0.0:
            return max(gap / self.tau, -RETURN_SPEED)
        return self.b * (math.sqrt(self.tau ** 2 + 2.0 * gap / self.b) - self.tau)

    def closing_slope(self, gap: float) -> float:
        """Return S', 1/s, for a gap, m."""
        if gap < 0.0:
            return 1.0 / self.tau if gap > -RETURN_SPEED * self.tau else 0.0
        return 1.0 / math.sqrt(self.tau ** 2 + 2.0 * gap / self.b)


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
    guard: bool = True
    """Whether the guard holds the band where the law does not."""
    guarding: GuardParams = field(default_factory=GuardParams)
    a_max: float = 2.5
    """Largest acceleration, a vector norm, m/s^2."""
    v_max: float = 0.5
    """Largest speed, a vector norm, m/s."""
    a_max_start: float = 0.0
    """``a_max`` of the start, m/s^2, if it was lowered since; see ``strongest``."""
    v_max_start: float = 0.0
    """``v_max`` of the start, m/s, if it was lowered since; see ``fastest``."""
    period: float = 0.1
    """Time from one step to the next, s."""
    predict_timeout: float = 0.5
    """Age up to which an estimate is extrapolated and followed, s."""
    heard_timeout: float = 1.0
    """Age up to which what others tell of a neighbour is used, s."""
    coast_timeout: float = 2.0
    """Age of the last estimate followed up to which the follower coasts, s."""
    odom_timeout: float = 0.3
    """Age up to which the own odometry is used, s."""
    perception_timeout: float = 0.2
    """Time without an image processed after which it brakes, s."""
    max_position_std: float = 0.5
    """Largest standard deviation of a usable position, sqrt(trace), m."""
    max_velocity_std: float = 1.0
    """Largest standard deviation of a usable velocity, sqrt(trace), m/s."""
    brake_time_constant: float = 0.3
    """Time in which braking reduces the speed to 37 %, s."""
    response_time: float = 0.3
    """Time in which a vehicle's acceleration follows its command to 63 %, delays included, s."""
    handover_time: float = 0.5
    """Time over which the law's command is faded in when following begins or changes, s."""
    altitude_mode: str = 'follow'
    """
    Whether to 'follow' the leader's altitude, or that of the nearest neighbour attended to, or to
    'hold' that of becoming active.
    """
    altitude_offset: float = 0.0
    """How far above the neighbour that it follows to fly, m; below where negative."""
    altitude_min: float = 1.0
    """
    Least altitude, m above the height at arming; where that is unknown it is that of becoming
    active. Who begins below it stays there until it is left upwards.
    """
    altitude_max: float = 100.0
    """
    Greatest altitude, m above the same; set below its default, it is a ceiling under which a
    closing neighbour out of sight may be left upwards, by at most 1 m.
    """
    range_max: float = 500.0
    """Greatest horizontal distance from where it became active, m."""
    climb_rate_max: float = 0.8
    """Largest rate at which the altitude to hold changes, m/s."""
    altitude_frequency: float = 1.5
    """Natural frequency of the critically damped control of altitude, rad/s."""
    max_vertical_acceleration: float = 1.5
    """Largest vertical acceleration of the control of altitude, m/s^2."""
    leader_speed_max: float = 2.0
    """Speed up to which a neighbour out of sight is reckoned with, m/s."""
    leader_acceleration_max: float = 1.0
    """Acceleration up to which one out of sight is reckoned with, m/s^2."""
    retreat_max: float = 1.0
    """How far it moves out of the way of one that it no longer sees, m."""
    resume_timeout: float = 30.0
    """Time without an estimate followed after which it stops commanding, s."""
    yaw_mode: str = 'leader'
    """
    Whether to face the 'leader', or the nearest neighbour attended to, or to 'hold' the yaw.
    """
    yaw_rate_max: float = 1.0
    """Largest rate at which the commanded yaw turns, and largest yaw rate commanded, rad/s."""
    scan_rate: float = 0.5
    """Rate of turning in SEARCH, rad/s; 0, or the yaw mode 'hold': none."""

    radius: float = 0.0
    """Of one's own hull, m: distances are between hulls."""
    vehicles: Mapping[str, Member] = field(default_factory=dict, hash=False)
    """What is known beforehand of others, by name."""

    RANGES: ClassVar[dict[str, Range]] = {
        'a_max': Range(0.1, 20.0, 'm/s^2'),
        'v_max': Range(0.05, 20.0, 'm/s'),
        'a_max_start': Range(0.0, 20.0, 'm/s^2'),
        'v_max_start': Range(0.0, 20.0, 'm/s'),
        'period': Range(0.02, 1.0, 's'),
        'predict_timeout': Range(0.05, 2.0, 's'),
        'heard_timeout': Range(0.05, 5.0, 's'),
        'coast_timeout': Range(0.05, 10.0, 's'),
        'odom_timeout': Range(0.02, 2.0, 's'),
        'perception_timeout': Range(0.05, 2.0, 's'),
        'max_position_std': Range(0.01, 10.0, 'm'),
        'max_velocity_std': Range(0.01, 10.0, 'm/s'),
        'brake_time_constant': Range(0.1, 5.0, 's'),
        'response_time': Range(0.0, 1.0, 's'),
        'handover_time': Range(0.0, 5.0, 's'),
        'altitude_offset': Range(-10.0, 10.0, 'm'),
        'altitude_min': Range(-1000.0, 1000.0, 'm'),
        'altitude_max': Range(-1000.0, 10000.0, 'm'),
        'range_max': Range(1.0, 100000.0, 'm'),
        'climb_rate_max': Range(0.05, 10.0, 'm/s'),
        'altitude_frequency': Range(0.1, 5.0, 'rad/s'),
        'max_vertical_acceleration': Range(0.1, 10.0, 'm/s^2'),
        'leader_speed_max': Range(0.0, 50.0, 'm/s'),
        'leader_acceleration_max': Range(0.0, 20.0, 'm/s^2'),
        'retreat_max': Range(0.0, 10.0, 'm'),
        'resume_timeout': Range(0.1, 3600.0, 's'),
        'yaw_rate_max': Range(0.05, 6.0, 'rad/s'),
        'scan_rate': Range(0.0, 3.0, 'rad/s'),
        'radius': RADIUS,
    }
    CHOICES: ClassVar[dict[str, tuple[str, ...]]] = {
        'yaw_mode': YAW_MODES, 'altitude_mode': ALTITUDE_MODES}

    @property
    def strongest(self) -> float:
        """Return the largest acceleration of braking and of keeping clear, m/s^2."""
        return max(self.a_max, self.a_max_start)

    @property
    def fastest(self) -> float:
        """Return the largest speed at which it keeps clear of others, m/s."""
        return max(self.v_max, self.v_max_start)

    @property
    def climb_rate(self) -> float:
        """Return how fast it may climb or descend, m/s: v_max leaves room for the rest."""
        return min(self.climb_rate_max, CLIMB_SHARE * self.v_max)

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (('predict_timeout', 'coast_timeout'),
                          ('coast_timeout', 'resume_timeout'), ('altitude_min', 'altitude_max')):
            if getattr(self, high) < getattr(self, low):
                valid = self.RANGES[high]
                raise ValueError(
                    f'{high} = {getattr(self, high)!r}: must be a number in [{low}, '
                    f'{valid.high:g}] {valid.unit}, where {low} = {getattr(self, low)!r}')
