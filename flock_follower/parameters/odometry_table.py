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


"""The parameters of every node that takes ``odom``, and the source they make."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flock_follower.odometry.derivation import CHOICES
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.parameters.spec import Spec

SOURCE = SourceParams()

ODOMETRY_SPECS = [
    Spec('odom_child_position', list(SOURCE.child_position), 'place of the child frame of odom on '
         'base_link, FLU: of the IMU, where that is what the source reports', 'm',
         fixed_length=True, read_only=True),
    Spec('odom_child_rpy', list(SOURCE.child_rpy), 'roll, pitch, yaw of the child frame of odom '
         'on base_link', 'rad', fixed_length=True, read_only=True),
    Spec('odom_twist_frame', SOURCE.twist_frame, 'frame of the velocity in odom: child as in '
         'REP-105, or odom; none: derive it from the positions; auto: find out',
         choices=CHOICES, read_only=True),
    Spec('odom_std', list(SOURCE.std), 'standard deviations of position, m, attitude, rad, '
         'velocity, m/s, and angular velocity, rad/s, where odom has no covariances',
         fixed_length=True, read_only=True),
]


def source_params(values: Mapping[str, Any]) -> SourceParams:
    """
    Return how a node reads its odometry.

    :raises ValueError: naming the parameter that is out of range.
    """
    try:
        return SourceParams(
            tuple(values['odom_child_position']), tuple(values['odom_child_rpy']),
            values['odom_twist_frame'], tuple(values['odom_std']))
    except ValueError as error:
        raise ValueError(f'odom_{error}') from None


def odometry_source(values: Mapping[str, Any]) -> OdometrySource:
    """Return what reads a node's odometry, see :func:`source_params`."""
    return OdometrySource(source_params(values))
