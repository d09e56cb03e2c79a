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

"""The parameters of the nodes that a flight needs, together: no node loads this module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from flock_follower.mavlink.connection import parse_connection
from flock_follower.mavlink.parameter_table import MAVLINK_BRIDGE
from flock_follower.parameters.files import read_parameters
from flock_follower.perception.markers import load
from flock_follower.perception.parameter_table import RELATIVE_POSE
from flock_follower.planner.parameter_table import PLANNER

#: The tables by the name of the node.
TABLE: Final = {'relative_pose': RELATIVE_POSE, 'planner': PLANNER,
                'mavlink_bridge': MAVLINK_BRIDGE}


def refuse_start(files: Sequence[str | Path], given: Mapping[str, Mapping[str, Any]],
                 neighbors: str | Path) -> None:
    """
    Refuse what would end a node at each start: a launch would start it again for ever.

    :param files: parameter files. :param given: values of parameters beside them, by node.
    :param neighbors: the neighbors file.
    :raises ValueError, OSError: naming the file or the parameter.
    """
    for path in files:
        read_parameters(path, TABLE)
    load(neighbors)
    for node, values in given.items():
        for spec in TABLE.get(node, ()):
            if spec.name in values:
                spec.check(values[spec.name])
    parse_connection(given['mavlink_bridge']['connection'])
