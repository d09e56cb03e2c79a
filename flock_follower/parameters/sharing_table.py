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

"""The parameters of the words between followers, with the core's own defaults and ranges."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from flock_follower.parameters.odometry_table import ODOMETRY_SPECS
from flock_follower.parameters.spec import Spec
from flock_follower.sharing.sharing_params import SharingParams

ALONE = SharingParams('nobody')


def number(name: str, description: str) -> Spec:
    """Return the declaration of a number of the core, with its default and range there."""
    return Spec.of(ALONE, name, description, read_only=True)


SPECS = [
    Spec('vehicle_name', '', 'name of this vehicle, unique in the flock, as others know it in '
         'their neighbors_file; empty: the namespace', read_only=True),
    number('position_std_max', 'words are used while the frame of who tells, and the place of '
           'whom it tells, are known as well'),
    number('yaw_std_max', 'the same of how it is turned'),
    number('word_age_max', 'age up to which words are taken, and what they tell is given out'),
    number('clock_tolerance', 'time by which a word may be ahead of the own clock'),
    number('seen_timeout', 'age of an own sighting up to which nobody is heard of that vehicle'),
    number('position_drift', 'of every odometry: a random walk'),
    number('yaw_drift', 'the same of its yaw'),
    number('odometry_noise', 'by which the positions of an odometry tremble'),
    number('sighting_noise', 'by which sightings err for long, beyond their covariance'),
    number('attitude_noise', 'the same of the yaw of whom one sees: how askew markers hang'),
    number('acceleration', 'what a vehicle told of may do since'),
    number('tellers_max', 'vehicles listened to at most'),
    *ODOMETRY_SPECS,
]


def build(values: dict[str, Any], namespace: str = '') -> SharingParams:
    """
    Return the parameters of the core.

    :param namespace: of the node, from which the name comes where none is given.
    :raises ValueError: where there is no name, or a number is out of range.
    """
    name = values['vehicle_name'] or namespace.strip('/').replace('/', '_')
    own = {f.name: values[f.name] for f in fields(SharingParams) if f.name in values}
    return SharingParams(name, **own)
