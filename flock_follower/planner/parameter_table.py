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

"""The parameters of the planner node, and the parameters of the core built from their values."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
import math
from typing import Any

from flock_follower.odometry.reader import SourceParams
from flock_follower.parameters.cameras import ANGLES, CAMERA_SPECS, cameras, DEFAULT_RPY
from flock_follower.parameters.neighbors_file import load
from flock_follower.parameters.settings import refuse
from flock_follower.parameters.spec import filled, Spec, specs_of
from flock_follower.planner.params import Member, PlannerParams

PLANNER = [
    Spec('require_bridge', True,
         'command only while mavlink_bridge/state is ACTIVE; false if another program flies the '
         'commands, such as MAVROS'),
    *specs_of(PlannerParams()),
    Spec('neighbors_file', '',
         'YAML file of the neighbors, the same as for relative_pose: roles and radii; empty: '
         'every vehicle seen is a leader of radius 0'),
    Spec('camera_rpy', list(DEFAULT_RPY),
         'roll, pitch, yaw of the camera on the body, the same as for relative_pose',
         ANGLES, fixed_length=True),
    Spec('rectified', False,
         'the images are undistorted already, the same as for relative_pose'),
    *CAMERA_SPECS,
    *specs_of(SourceParams(), 'odom_'),
]


def planner_params(values: Mapping[str, Any], name: str = '') -> PlannerParams:
    """
    Return the parameters of the planner's core.

    :param name: of this vehicle; the neighbors' file may contain it, too.
    :raises ValueError: if the parameters contradict each other or cannot fly, or the neighbors'
        file is wrong.
    :raises OSError: if the file cannot be read.
    """
    cameras(values)
    params = filled(PlannerParams(), values, vehicles={
        other: who for other, who in _vehicles(values['neighbors_file']).items() if other != name})
    refuse(values)
    return params


@lru_cache
def _vehicles(path: str) -> Mapping[str, Member]:
    """Return the neighbors by name; read once, because parameters are set in flight, too."""
    if not path:
        return {}
    return {n.name: Member(n.role, n.radius, tuple(
        math.atan2(*normal[1::-1]) for normal in (
            marker.T_body_marker.rotation[:, 2].round(6) + 0.0 for marker in n.markers)))
            for n in load(path).neighbors}
