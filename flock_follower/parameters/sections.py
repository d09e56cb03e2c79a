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
from flock_follower.parameters.cameras import CAMERA_SPECS
from flock_follower.parameters.flight_names import FLIGHT_NAMES
from flock_follower.parameters.spec import expanded, refuse_unknown, Spec

#: Key of a node's diagnostics: its parameter files.
PARAMETER_FILES: Final = 'parameter_files'
#: The section whose parameters hold for each node of a follower that has them.
SHARED: Final = 'follower'

#: From this similarity on, a name is taken as a misspelt one; 1 is equal.
_MISSPELT = 0.85
#: The name of sections for every node.
ALL = '**'


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
        with naming(path):
            for section, values in find_sections('', read(path)):
                if means(section, follower) and last(section) == SHARED:
                    refuse_unknown(values, FLIGHT_NAMES | names(CAMERA_SPECS, values), SHARED)
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
    with naming(path):
        sections = [section for section, _ in find_sections('', read(path))]
    meant = [section for section in sections if difflib.SequenceMatcher(
        None, last(section), last(node)).ratio() >= _MISSPELT]
    if any(means(section, node) for section in sections):
        misspelt = [] if any(last(section) == last(node) for section in meant) else meant
        return f'{path}: {misspelt[0]} is another node: did you mean {node}?' if misspelt else ''
    if meant:
        raise ValueError(f'{path}: holds parameters for {", ".join(meant)}, but none for {node}: '
                         f'name the section {node}, or /**/{last(node)}')
    return f'{path}: holds no parameters for {node}, only for {", ".join(sections) or "no node"}'


@contextmanager
def naming(place: str | Path) -> Iterator[None]:
    """Put a file, or a node, before the text of an error."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f'{place}: {error}') from None


def read(path: str | Path) -> Any:
    try:
        return yaml.safe_load(read_text(path))
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f'not valid YAML: {" ".join(str(error).split())}') from None


def names(specs: Sequence[Spec], values: Mapping[str, Any]) -> set[str]:
    return {spec.name for spec in expanded(specs, values)}


def find_sections(prefix: str, document: Any) -> Iterator[tuple[str, dict[str, Any]]]:
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
            yield from find_sections(f'{prefix}/{str(key).strip("/")}', content)


def means(section: str, node: str) -> bool:
    """Return whether a section applies to a node in ROS: * is one name, ** any number."""
    wildcards = {'**': r'(/\w+)*', '*': r'/\w+'}
    pattern = ''.join(wildcards.get(token, '/' + re.escape(token))
                      for token in section.strip('/').split('/'))
    return re.fullmatch(pattern, node) is not None


def last(section: str) -> str:
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
