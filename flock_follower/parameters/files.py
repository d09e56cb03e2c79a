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
ROS 2 parameter files, read without ROS.

A file maps names of nodes to their parameters, under ``ros__parameters``. The section ``/**`` is
for every node; if it and the section of a node set one parameter, the last one in the file wins,
as in rcl. A name under ``/**`` must be a parameter of one of the nodes, not of all. ROS has no
section for some nodes; the nodes themselves read the section ``follower``: each takes the
parameters that it has, unless its own section, ``/**`` or the command line sets them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import difflib
from pathlib import Path
import re
from typing import Any, Final

import yaml

from flock_follower.files import read_text
from flock_follower.mavlink.connection import parse_connection
from flock_follower.odometry.reader import SourceParams
from flock_follower.parameters.spec import (
    check_values,
    expanded,
    NAMES,
    refuse_unknown,
    Spec,
    specs_of,
)
from flock_follower.parameters.tables import MAVLINK_BRIDGE, PLANNER, RELATIVE_POSE
from flock_follower.perception.markers import load

Table = Mapping[str, Sequence[Spec]]
#: Key of a node's diagnostics: its parameter files.
PARAMETER_FILES: Final = 'parameter_files'
#: The parameters of the nodes that a flight needs.
TABLE: Final = {'relative_pose': RELATIVE_POSE, 'planner': PLANNER,
                'mavlink_bridge': MAVLINK_BRIDGE}
#: Parameters that must be the same in all nodes: the cameras, and the reading of the odometry.
COMMON = (NAMES, *(spec.name for spec in specs_of(SourceParams(), 'odom_')))

#: The section whose parameters hold for each node of a follower that has them.
SHARED: Final = 'follower'

#: The file beside a recording that holds the parameters that were flown with.
FLOWN = 'parameters.yaml'

#: From this similarity on, a name is taken as a misspelt one; 1 is equal.
_MISSPELT = 0.85
#: The name of sections for every node.
_ALL = '**'


def read_parameters(path: str | Path, table: Table) -> dict[str, dict[str, Any]]:
    """
    Return the checked values of every parameter of the nodes of ``table``, defaults included.

    :raises ValueError: naming the file, and the parameter, its value and the valid range.
    :raises OSError: if the file cannot be read.
    """
    with _naming(path):
        return parse_parameters(_read(path), table)


def parameters_flown(bag: Path, table: Table) -> dict[str, dict[str, Any]] | None:
    """
    Return the values in the file beside a recording of the black box; None without a file.

    A neighbours' file that they name is looked for beside the recording, too.

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


def parse_parameters(document: Any, table: Table) -> dict[str, dict[str, Any]]:
    """
    Return the checked values of a parsed parameter file, see :func:`read_parameters`.

    :raises ValueError: naming the fault.
    """
    named: dict[str, dict[str, Any]] = {name: {} for name in (*table, SHARED, _ALL)}
    found: dict[str, dict[str, Any]] = {node: {} for node in table}
    matched = False
    for section, parameters in _sections('', document):
        name = _ALL if _last(section) == '*' else _last(section)
        if name in named:
            matched = True
            named[name].update(parameters)
            for node in table if name == _ALL else table.keys() & {name}:
                found[node].update(parameters)
        elif near := difflib.get_close_matches(name, [*table, SHARED], n=1):
            raise ValueError(f'unknown node {section}: did you mean {near[0]}?')
    if not matched:
        raise ValueError(f'holds ros__parameters neither of /** nor of {", ".join(table)}')
    found = {node: {**named[SHARED], **values} for node, values in found.items()}
    known = {node: _names(specs, found[node]) for node, specs in table.items()}
    for name, parameters in named.items():
        refuse_unknown(parameters, known.get(name) or set().union(*known.values()), name)
    values = {}
    for node, specs in table.items():
        with _naming(node):
            values[node] = check_values(specs, found[node])
    of_cameras = sorted({name for own in values.values() for name in own if '.' in name})
    for name in (*COMMON, *of_cameras):
        settings = {node: own[name] for node, own in values.items() if name in own}
        if len({str(value) for value in settings.values()}) > 1:
            listed = ' and '.join(f'{value!r} for {node}' for node, value in settings.items())
            raise ValueError(f'{name} = {listed}: must be the same')
    return values


def shared(paths: Sequence[str | Path], node: str) -> dict[str, Any]:
    """
    Return the values of the sections ``follower`` beside a node; the last file wins.

    :param node: the node's full name, as '/drone1/planner'.
    :raises ValueError: naming the file and its fault.
    :raises OSError: if a file cannot be read.
    """
    follower = f'{node.rpartition("/")[0]}/{SHARED}'
    found: dict[str, Any] = {}
    for path in paths:
        with _naming(path):
            for section, values in _sections('', _read(path)):
                if _means(section, follower) and _last(section) == SHARED:
                    refuse_unknown(values, {name for specs in TABLE.values()
                                            for name in _names(specs, values)}, SHARED)
                    found.update(values)
    return found


def files_in(arguments: Sequence[str]) -> list[str]:
    """Return the parameter files that a ROS command line names."""
    files, of_ros = [], False
    for argument, following in zip(arguments, [*arguments[1:], '']):
        if argument in ('--ros-args', '--'):
            of_ros = argument == '--ros-args'
        elif of_ros and argument == '--params-file':
            files.append(following)
    return files


def unheeded(path: str | Path, node: str) -> str:
    """
    Return a warning if ROS takes nothing from a file for a node, or not all that was meant; or ''.

    :param node: the node's full name, as '/drone1/planner'.
    :raises ValueError: if no section is for the node, but one has its name in another namespace,
        or nearly its name; or if the file is no YAML.
    :raises OSError: if the file cannot be read.
    """
    with _naming(path):
        sections = [section for section, _ in _sections('', _read(path))]
    meant = [section for section in sections if difflib.SequenceMatcher(
        None, _last(section), _last(node)).ratio() >= _MISSPELT]
    if any(_means(section, node) for section in sections):
        misspelt = [] if any(_last(section) == _last(node) for section in meant) else meant
        return f'{path}: {misspelt[0]} is another node: did you mean {node}?' if misspelt else ''
    if meant:
        raise ValueError(f'{path}: holds parameters for {", ".join(meant)}, but none for {node}: '
                         f'name the section {node}, or /**/{_last(node)}')
    return f'{path}: holds no parameters for {node}, only for {", ".join(sections) or "no node"}'


@contextmanager
def _naming(place: str | Path) -> Iterator[None]:
    """Put a file, or a node, before the text of an error."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f'{place}: {error}') from None


def _read(path: str | Path) -> Any:
    try:
        return yaml.safe_load(read_text(path))
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f'not valid YAML: {" ".join(str(error).split())}') from None


def _names(specs: Sequence[Spec], values: Mapping[str, Any]) -> set[str]:
    return {spec.name for spec in expanded(specs, values)}


def _sections(prefix: str, document: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """
    Yield the full names of the nodes, or their patterns, with their parameters.

    :raises ValueError: for a value that is not below ros__parameters: ROS takes no such file.
    """
    if not isinstance(document, Mapping):
        raise ValueError(f'{prefix or "the file"} = {document!r}: must be below ros__parameters')
    for key, content in document.items():
        if key == 'ros__parameters' and isinstance(content or {}, Mapping):
            yield prefix, _flat('', content or {})
        else:
            yield from _sections(f'{prefix}/{str(key).strip("/")}', content)


def _means(section: str, node: str) -> bool:
    """Return whether a section applies to a node in ROS: * is one name, ** any number."""
    wildcards = {'**': r'(/\w+)*', '*': r'/\w+'}
    pattern = ''.join(wildcards.get(token, '/' + re.escape(token))
                      for token in section.strip('/').split('/'))
    return re.fullmatch(pattern, node) is not None


def _last(section: str) -> str:
    return section.rsplit('/', 1)[-1]


def _flat(prefix: str, values: Mapping[Any, Any]) -> dict[str, Any]:
    """Return nested parameters under the dotted names ROS gives them."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat.update(_flat(f'{prefix}{name}.', value))
        else:
            flat[f'{prefix}{name}'] = value
    return flat
