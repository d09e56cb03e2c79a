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

"""The parameters of the messages between followers."""

from __future__ import annotations

from typing import Any

from flock_follower.flock.peers import checked_name
from flock_follower.parameters.odometry_table import ODOMETRY_SPECS
from flock_follower.parameters.spec import Spec

SPECS = [
    Spec('vehicle_name', '', 'name of this vehicle, unique in the flock, as others know it in '
         'their neighbors_file; empty: the namespace', read_only=True),
    *ODOMETRY_SPECS,
]


def build(values: dict[str, Any], namespace: str = '') -> str:
    """
    Return the name of this vehicle.

    :param namespace: of the node, from which the name comes where none is given.
    :raises ValueError: if there is no name.
    """
    name = values['vehicle_name'] or namespace.strip('/').replace('/', '_')
    return checked_name(name)
