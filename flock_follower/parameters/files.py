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
Reads complete parameter files: the checked values of the parameters of several nodes.

No node that flies loads this module; each node reads its sections by ``parameters.sections``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import difflib
from pathlib import Path
from typing import Any

from flock_follower.odometry.reader import SourceParams
from flock_follower.parameters.sections import (
    ALL_NODES,
    last,
    means,
    names,
    naming,
    read,
    read_sections,
)
from flock_follower.parameters.spec import (
    CAMERAS,
    check_values,
    refuse_unknown,
    Spec,
    specs_of,
)

Table = Mapping[str, Sequence[Spec]]
#: Parameters that must be the same in all nodes: the cameras, and the reading of the odometry.
COMMON = (CAMERAS, *(spec.name for spec in specs_of(SourceParams(), 'odom_')))

#: The file beside a recording that holds the parameters that were flown with.
FLOWN = 'parameters.yaml'


def read_parameters(path: str | Path, table: Table) -> dict[str, dict[str, Any]]:
    """
    Return the checked values of every parameter of the nodes of ``table``, defaults included.

    :raises ValueError: naming the file, and the parameter, its value and the valid range.
    :raises OSError: if the file cannot be read.
    """
    with naming(path):
        return parse_parameters(read(path), table)


def parameters_flown(bag: Path, table: Table) -> dict[str, dict[str, Any]] | None:
    """
    Return the values in the file beside a recording of the black box; None without a file.

    If the values name a neighbors' file, it is also searched beside the recording.

    :raises ValueError, OSError: see :func:`read_parameters`.
    """
    path = (bag if bag.is_dir() else bag.parent) / FLOWN
    if not path.is_file():
        return None
    values = read_parameters(path, table)
    for own in values.values():
        if own.get('neighbors_file'):
            own['neighbors_file'] = str(path.parent / own['neighbors_file'])
    return values


def effective_parameters(paths: Sequence[str | Path], given: Mapping[str, Any], node: str,
                         specs: Sequence[Spec]) -> dict[str, Any]:
    """
    Return the checked values with which a node starts, defaults included.

    :param paths: the node's parameter files; the last setting wins, as in ROS. :param given:
        parameters that override the files. :param node: its full name. :param specs: of its
        parameters.
    :raises ValueError: naming the parameter, its value and the valid range, or the file.
    :raises OSError: if a file cannot be read.
    """
    found: dict[str, Any] = {}
    for path in paths:
        with naming(path):
            for section, values in read_sections(read(path)):
                if means(section, node):
                    found |= values
    found |= given
    known = names(specs, found)
    return check_values(specs, {name: found[name] for name in found if name in known})


def parse_parameters(document: Any, table: Table) -> dict[str, dict[str, Any]]:
    """
    Return the checked values of a parsed parameter file, see :func:`read_parameters`.

    :raises ValueError: naming the fault.
    """
    named: dict[str, dict[str, Any]] = {name: {} for name in (*table, ALL_NODES)}
    found: dict[str, dict[str, Any]] = {node: {} for node in table}
    matched = False
    for section, parameters in read_sections(document):
        name = ALL_NODES if last(section) == '*' else last(section)
        if name in named:
            matched = True
            named[name].update(parameters)
            for node in table if name == ALL_NODES else (name,):
                found[node].update(parameters)
        elif near := difflib.get_close_matches(name, table, n=1):
            raise ValueError(f'unknown node {section}: did you mean {near[0]}?')
    if not matched:
        raise ValueError(f'holds ros__parameters neither of /** nor of {", ".join(table)}')
    known = {node: names(specs, found[node]) for node, specs in table.items()}
    for name, parameters in named.items():
        refuse_unknown(parameters, known.get(name) or set().union(*known.values()), name)
    values = {}
    for node, specs in table.items():
        with naming(node):
            values[node] = check_values(specs, found[node])
    of_cameras = sorted({name for own in values.values() for name in own if '.' in name})
    for name in (*COMMON, *of_cameras):
        settings = {node: own[name] for node, own in values.items() if name in own}
        if len({str(value) for value in settings.values()}) > 1:
            listed = ' and '.join(f'{value!r} for {node}' for node, value in settings.items())
            raise ValueError(f'{name} = {listed}: must be the same')
    return values
