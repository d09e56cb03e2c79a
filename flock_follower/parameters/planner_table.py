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

"""The parameters of the planner, with the core's own defaults and ranges, and what they suit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import lru_cache
import math
from typing import Any

from flock_follower.flocking import FlockingParams
from flock_follower.parameters.cameras_table import CAMERA_SPECS, cameras
from flock_follower.parameters.odometry_table import ODOMETRY_SPECS
from flock_follower.parameters.spec import Spec
from flock_follower.planner.params import (
    ALTITUDE_MODES,
    GuardParams,
    Member,
    PlannerParams,
    YAW_MODES,
)

FLIGHT = PlannerParams()
DELAY = 0.05  # s by which a command may come late, be it by a late tick or on its way
LAW_NAMES = tuple(f.name for f in fields(FlockingParams))
GUARD_NAMES = tuple(f.name for f in fields(GuardParams))


def number(name: str, description: str, read_only: bool = False) -> Spec:
    """Return the declaration of a number of the core, with its default and range there."""
    owner = (FLIGHT.law if name in LAW_NAMES else FLIGHT.guarding if name in GUARD_NAMES
             else FLIGHT)
    return Spec.of(owner, name, description, read_only)


SPECS = [
    Spec('require_bridge', True, 'command only while mavlink_bridge/state says ACTIVE; false '
         'where somebody else flies the commands, such as MAVROS', read_only=True),
    number('K', 'gain of the alignment of velocities'),
    number('beta', 'decay of the alignment with distance'),
    number('d0', 'lower bound of the squared distance; below d1'),
    number('d1', 'upper bound of the squared distance; above d0'),
    Spec('guard', FLIGHT.guard, 'hold the band where the law alone does not; it cannot be '
         'switched off while the bridge is ACTIVE'),
    number('tau', 'guard: reaction time'),
    number('b', 'guard: deceleration with which an approach to an edge is stopped'),
    number('m', 'guard: margin to each edge, at most 0.24 of the width of the band'),
    number('a_max', 'largest acceleration, of the vector; never above its value at the start, and '
           'only lowered while the bridge is ACTIVE; braking and separation keep that of the '
           'start'),
    number('v_max', 'largest speed, of the vector; likewise'),
    number('period', 'time between commands; at most planner_timeout - 0.05', read_only=True),
    Spec('planner_timeout', 0.2, 'as the bridge has it: age up to which it obeys a command; here '
         'only to refuse a period that does not fit', 's', 0.05, 1.0, read_only=True),
    number('predict_timeout', 'age up to which a neighbor is extrapolated and followed'),
    number('heard_timeout', 'age up to which what others tell of a neighbor is used'),
    number('coast_timeout', 'age of the last neighbor up to which to coast, then brake'),
    number('odom_timeout', 'age of the odometry up to which to command at all; it brakes from '
           'half of it on, or, where odometry usually becomes older, when it is overdue'),
    number('perception_timeout', 'time without an image processed by relative_pose, once one was, '
           'after which to brake; at least 2 periods of the camera'),
    number('brake_time_constant', 'time in which braking reduces the speed to 37 %'),
    number('response_time', 'time in which the acceleration follows its command to 63 %'),
    Spec('altitude_mode', FLIGHT.altitude_mode, 'follow the altitude of the leader, or of the '
         'nearest neighbor attended to, or hold the one at which it became active',
         choices=ALTITUDE_MODES),
    number('altitude_offset', 'how far above the neighbor that it follows to fly'),
    number('altitude_min', 'least altitude, above the height at arming; where the bridge does not '
           'know that, it is the altitude at which it became active. Who begins below it does not '
           'jump up'),
    number('altitude_max', 'greatest altitude, above the same; set below its default, it permits '
           'leaving the plane of a closing neighbor out of sight upwards, by at most 1 m'),
    number('range_max', 'greatest horizontal distance from where it became active'),
    number('climb_rate_max', 'largest rate at which the altitude to hold changes'),
    number('altitude_frequency', 'natural frequency of the control of altitude'),
    number('max_vertical_acceleration', 'largest acceleration of the control of altitude'),
    number('leader_speed_max', 'speed up to which a neighbor out of sight is reckoned with'),
    number('leader_acceleration_max', 'acceleration up to which one out of sight is reckoned '
           'with; more makes it retreat earlier'),
    number('retreat_max', 'how far to move out of the way of a neighbor out of sight; farther, by '
           'at most 3 m, if it was coming; 0: not'),
    number('resume_timeout', 'time without a neighbor followed up to which it follows by itself; '
           'then it stops commanding until planner/engage is called'),
    Spec('yaw_mode', FLIGHT.yaw_mode, 'face the leader, or the nearest neighbor attended to, or '
         'hold the yaw at which it became active', choices=YAW_MODES),
    number('yaw_rate_max', 'largest rate at which the commanded yaw turns, and to turn to it'),
    number('scan_rate', 'rate of turning to look for a neighbor; 0: none'),
    Spec('neighbors_file', '', 'YAML file of the neighbors, as relative_pose has it: their roles '
         'and radii; empty: everyone seen is a leader of no size', read_only=True),
    number('radius', 'of the own hull: distances are kept between hulls'),
    Spec('camera_rpy', [0.0, 0.0, 0.0], 'as relative_pose has it: roll, pitch, yaw of the camera '
         'on the body', 'rad', fixed_length=True, read_only=True),
    *CAMERA_SPECS,
    *ODOMETRY_SPECS,
]


def build(values: dict[str, Any], name: str = '') -> PlannerParams:
    """
    Return the parameters of the core.

    :param name: one's own, as others know it: it may stand in the neighbours' file, too.
    :raises ValueError: where they do not fit together, or the neighbours' file is wrong.
    :raises OSError: where it cannot be read.
    """
    _refuse_unfit(values)
    cameras(values)
    own = {f.name: values[f.name] for f in fields(PlannerParams) if f.name in values}
    return PlannerParams(law=FlockingParams(**_of(LAW_NAMES, values)),
                         guarding=GuardParams(**_of(GUARD_NAMES, values)),
                         vehicles={other: who for other, who in _vehicles(
                             values['neighbors_file']).items() if other != name}, **own)


def _of(names: Sequence[str], values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: values[name] for name in names if name in values}


@lru_cache
def _vehicles(path: str) -> Mapping[str, Member]:
    """Return who flies along, by name; read once, as parameters are set in flight, too."""
    if not path:
        return {}
    from flock_follower.perception.markers import load
    return {n.name: Member(n.role, n.radius, tuple(
        math.atan2(*normal[1::-1]) for normal in (
            marker.T_body_marker.rotation[:, 2].round(6) + 0.0 for marker in n.markers)))
        for n in load(path).neighbors}


def _refuse_unfit(values: dict[str, Any]) -> None:
    """Refuse a period too long for those who obey the commands, or for what they are to do."""
    period, timeout = values['period'], values['planner_timeout']
    if period > timeout - DELAY + 1e-9:
        raise ValueError(
            f'period = {period!r}: must be at most planner_timeout - {DELAY:g} s, where '
            f'planner_timeout = {timeout!r}: each command would be too old before the next comes')
    # A correction held for longer than it is meant to take overshoots.
    if period > values['brake_time_constant']:
        raise ValueError(f'period = {period!r}: must be at most brake_time_constant = '
                         f'{values["brake_time_constant"]!r} s')
    if 2.0 * values['altitude_frequency'] * period > 1.0 + 1e-9:
        raise ValueError(
            f'period = {period!r}: must be at most 1 / (2 altitude_frequency) = '
            f'{0.5 / values["altitude_frequency"]:.3g} s, where altitude_frequency = '
            f'{values["altitude_frequency"]!r}')
