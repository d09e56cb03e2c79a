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
for every node; if this section and the section of a node set the same parameter, the last setting
in the file wins, as in rcl. A name under ``/**`` must be a parameter of at least one node: each
node takes the parameters that it has.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import difflib
from pathlib import Path
import re
from typing import Any, Final

import yaml

from flock_follower.parameters.flight_names import FLIGHT_NAMES
from flock_follower.parameters.spec import expanded, expanded_names, refuse_unknown, Spec
from flock_follower.system.files import read_text

#: Key of a node's diagnostics: its parameter files.
PARAMETER_FILES: Final = 'parameter_files'
#: Name similarity, 0 to 1, from which a section is taken for a misspelled one.
_MISSPELLED_SIMILARITY = 0.85
#: Last token of a section for every node.
ALL_NODES: Final = '**'
#: Last tokens of sections for nodes of any name.
_ANY_NAME = (ALL_NODES, '*')
#: Former section of shared parameters: ROS applies it to no node.
_FORMER_SHARED = 'follower'


def names_for_any_node(paths: Sequence[str | Path], node: str, specs: Sequence[Spec]) -> set[str]:
    """
    Return all parameters that sections such as ``/**`` set for a node, known to it or not.

    :param node: the node's full name, as '/drone1/planner'. :param specs: of its own parameters.
    :raises ValueError: naming the file and its fault, such as a name that no node knows.
    :raises OSError: if a file cannot be read.
    """
    found: set[str] = set()
    for path in paths:
        with naming(path):
            for section, values in read_sections(read(path)):
                if last(section) in _ANY_NAME and means(section, node):
                    known = expanded_names(FLIGHT_NAMES, values) | names(specs, values)
                    refuse_unknown(values, known, section)
                    found |= values.keys() & known
    return found


def listed_files(files: Sequence[str]) -> str:
    """Return the parameter files of nodes with the same name as text; '' is a node without."""
    return ' and '.join(f'with {each or "no file"}' for each in files)


def files_in(arguments: Sequence[str]) -> list[str]:
    """Return the parameter files that a ROS command line names."""
    files, of_ros = [], False
    for argument, following in zip(arguments, [*arguments[1:], '']):
        if argument in ('--ros-args', '--'):
            of_ros = argument == '--ros-args'
        elif of_ros and argument == '--params-file':
            files.append(following)
    return files


def ignored_sections(path: str | Path, node: str) -> str:
    """
    Return a warning about sections that ROS will not apply to a node; '' if there are none.

    :param node: the node's full name, as '/drone1/planner'.
    :raises ValueError: if no section is for the node, but one section has its name in another
        namespace, or a similar name; or if the file is no YAML.
    :raises OSError: if the file cannot be read.
    """
    with naming(path):
        sections = [section for section, _ in read_sections(read(path))]
    meant = [section for section in sections if difflib.SequenceMatcher(
        None, last(section), last(node)).ratio() >= _MISSPELLED_SIMILARITY]
    if any(means(section, node) for section in sections):
        if not meant or any(last(section) == last(node) for section in meant):
            return ''
        return f'{path}: {meant[0]} is another node: did you mean {node}?'
    if meant:
        raise ValueError(f'{path}: holds parameters for {", ".join(meant)}, but none for {node}: '
                         f'name the section {node}, or /**/{last(node)}')
    return f'{path}: holds no parameters for {node}, only for {", ".join(sections) or "no node"}'


@contextmanager
def naming(place: str | Path) -> Iterator[None]:
    """Prefix the text of an error with the name of a file or a node."""
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


def read_sections(document: Any) -> list[tuple[str, dict[str, Any]]]:
    """
    Return the full names of the nodes, or their patterns, with their parameters.

    :raises ValueError: if a value is not below ros__parameters, because ROS refuses such a file;
        if there is a section ``follower``, which ``/**`` has replaced.
    """
    sections = [*_find_sections('', document)]
    for section, _ in sections:
        if last(section) == _FORMER_SHARED:
            raise ValueError(f'{section}: no node has this name: rename it to the section of '
                             'shared parameters /**, and put it before the sections of the nodes')
    return sections


def _find_sections(prefix: str, document: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    if not isinstance(document, Mapping):
        raise ValueError(f'{prefix or "the file"} = {document!r}: must be below ros__parameters')
    for key, content in document.items():
        if key == 'ros__parameters' and isinstance(content or {}, Mapping):
            yield prefix, _flat('', content or {})
        else:
            yield from _find_sections(f'{prefix}/{str(key).strip("/")}', content)


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
