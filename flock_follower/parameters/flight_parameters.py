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

"""The parameters of all nodes that a flight needs; no node loads this module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from flock_follower.mavlink.connection import parse_connection
from flock_follower.mavlink.link import Signing
from flock_follower.mavlink.parameter_table import gate_limits, MAVLINK_BRIDGE, origin
from flock_follower.parameters.files import effective_parameters, read_parameters
from flock_follower.perception.parameter_table import RELATIVE_POSE, tracker
from flock_follower.planner.parameter_table import PLANNER, planner_params

#: The tables by the name of the node.
TABLE: Final = {'relative_pose': RELATIVE_POSE, 'planner': PLANNER,
                'mavlink_bridge': MAVLINK_BRIDGE}


def refuse_start(files: Sequence[str | Path], given: Mapping[str, Mapping[str, Any]],
                 namespace: str) -> None:
    """
    Refuse parameters with which a node ends at its start: a launch would restart it for ever.

    :param files: parameter files. :param given: values set in addition to the files, by node.
    :param namespace: of the nodes.
    :raises ValueError, OSError: naming the file or the parameter.
    """
    for path in files:
        read_parameters(path, TABLE)
    space = namespace.strip('/')
    values = {node: effective_parameters(
        files, given.get(node, {}), f'/{space}/{node}' if space else f'/{node}', specs)
        for node, specs in TABLE.items()}
    tracker(values['relative_pose'])
    planner_params(values['planner'], space)
    own = values['mavlink_bridge']
    gate_limits(own)
    origin(own['global_origin'])
    parse_connection(own['connection'])
    if own['signing_key_file']:
        Signing.from_file(own['signing_key_file'], 0.0)
