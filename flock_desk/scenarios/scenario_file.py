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
Scenarios as YAML files; an error names file, line, key and the valid values.

A file holds the fields of :class:`flock_desk.scenarios.scenario.Scenario`; its
name is the scenario's. A missing key keeps its default::

    summary: the leader flies away at 0.4 m/s
    flight: {v_max: 0.5}
    leader:
      motion: legs
      legs:
        - {duration: 60, velocity: [0.4, 0, 0]}
    variants:
      faster: {flight: {v_max: 2}}

A variant is a scenario of its own name, which differs in the keys that it has.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, fields, is_dataclass, MISSING, replace
import difflib
from functools import cache
import inspect
import math
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import yaml

from flock_desk.scenarios.courses import course
from flock_desk.scenarios.flock import Flock
from flock_desk.scenarios.scenario import Scenario
from flock_follower.files import resource
from flock_follower.ranges import Range

FOLDER = 'config/scenarios'
_VARIANTS = 'variants'
_KINDS = {float: 'a number', int: 'an integer', str: 'a text', bool: 'true or false'}


class ScenarioError(ValueError):
    """A scenario file that cannot be flown; the message says where and why."""


def names() -> list[str]:
    """Return the names of the scenarios of the package."""
    return sorted(_files())


@cache
def _files() -> dict[str, Path]:
    """Return the file of each scenario of the package, by its name."""
    return {name: path for path in resource(FOLDER).glob('*.yaml')
            for name in (path.stem, *_variants(_composed(path.read_text('utf-8'), str(path))))}


def load(name: str) -> Scenario:
    """
    Return a scenario of the package by its name, or another one by the path of its file.

    A variant in such a file is FILE.yaml:NAME.

    :raises ScenarioError: if it does not exist, or its file is wrong.
    """
    file, _, variant = name.partition(':')
    path = Path(file)
    if path.suffix not in ('.yaml', '.yml'):
        if name not in _files():
            raise ScenarioError(f'scenario = {name!r}: must be one of {", ".join(names())}, or '
                                'the path of a .yaml file')
        path, variant = _files()[name], name
    try:
        return parse(path.read_text(encoding='utf-8'), str(path), variant)
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f'{path}: cannot be read: {error}') from None


def load_for_real_time(name: str) -> Scenario:
    """
    Return a scenario that the nodes can fly, see :func:`load`.

    :raises ScenarioError: also if it has operations or a flock, which flights in lock step
        alone know.
    """
    scenario = load(name)
    if scenario.operations:
        raise ScenarioError(f'scenario = {name!r}: its operations are obeyed in lock step only: '
                            f'flights --scenario {name}')
    if scenario.flock is not None:
        raise ScenarioError(f'scenario = {name!r}: its flock flies in lock step only: flights '
                            f'--scenario {name}; fly --followers flies a column')
    return scenario


def parse(text: str, path: str, variant: str = '') -> Scenario:
    """
    Return the scenario in the text of a file, or a variant of it.

    :raises ScenarioError: naming file, line, key, value and the allowed values.
    """
    root, reader, stem = _composed(text, path), _ScenarioReader(path), Path(path).stem
    if root is None:
        raise ScenarioError(f'{path}:1: is empty: must hold summary, leader and so on')
    variants = _variants(root)
    if isinstance(root, yaml.MappingNode):
        root.value = [(key, value) for key, value in root.value if key.value != _VARIANTS]
    scenario: Scenario = reader.dataclass(Scenario, root, '', name=stem)
    if variant not in ('', stem, *variants):
        raise ScenarioError(f'{path}: has no variant {variant}, only {", ".join(variants)}')
    if variant in variants:
        root = variants[variant]
        scenario = reader.dataclass(Scenario, root, f'{_VARIANTS}.{variant}.', scenario,
                                    name=variant)
    try:
        course(scenario, 0)
    except ValueError as error:
        lines = [key.start_mark.line + 1 for key, _ in root.value if key.value == 'leader']
        raise ScenarioError(
            f'{path}:{lines[0] if lines else root.start_mark.line + 1}: {error}') from None
    return scenario


def _variants(root: Any) -> dict[str, Any]:
    """Return the nodes of the variants in a file, by name."""
    if not isinstance(root, yaml.MappingNode):
        return {}
    return {key.value: value for part, node in root.value if part.value == _VARIANTS
            for key, value in node.value}


def with_flock(scenario: Scenario, text: str, path: str) -> Scenario:
    """
    Return a scenario with some keys of its flock changed, to those of a YAML mapping.

    :param path: what to call it in an error.
    :raises ScenarioError: also if the scenario has no flock.
    """
    if scenario.flock is None:
        raise ScenarioError(f'{path}: scenario {scenario.name} has no flock')
    node = _composed(text, path)
    flock = _ScenarioReader(path).dataclass(Flock, node, 'flock.', scenario.flock)
    return replace(scenario, flock=flock)


def _composed(text: str, path: str) -> Any:
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        line = f':{mark.line + 1}' if mark else ''
        problem = getattr(error, 'problem', None) or str(error)
        raise ScenarioError(f'{path}{line}: not valid YAML: {problem}') from None


class _ScenarioReader:
    """Turns nodes of YAML into values of declared types."""

    def __init__(self, path: str) -> None:
        self._path = path

    def dataclass(self, kind: Any, node: Any, where: str, before: Any = None,
                  name: str = '') -> Any:
        """Return one of a kind; a missing key is as in ``before``, or the default."""
        allowed = [f.name for f in fields(kind) if f.name != 'name']  # that of the file
        if not isinstance(node, yaml.MappingNode):
            raise self._error(node, f'{where.rstrip(".") or "the file"}: must be a mapping of '
                                    f'{", ".join(allowed)}')
        hints = get_type_hints(kind)
        values: dict[str, Any] = {'name': name} if name else {}
        lines: dict[str, Any] = {}
        for key, value in node.value:
            if key.value not in allowed:
                like = difflib.get_close_matches(str(key.value), allowed, 1)
                hint = f' (did you mean {like[0]}?)' if like else ''
                raise self._error(key, f'{where}{key.value}: unknown key{hint}: must be one of '
                                       f'{", ".join(allowed)}')
            if key.value in lines:
                raise self._error(key, f'{where}{key.value}: given twice, first in line '
                                       f'{lines[key.value].start_mark.line + 1}')
            lines[key.value] = value
            values[key.value] = self._value(hints[key.value], value, f'{where}{key.value}',
                                            getattr(before, key.value, None))
        for f in fields(kind):
            if before is None and f.name not in values and f.default is MISSING and (
                    f.default_factory is MISSING):
                raise self._error(node, f'{where}{f.name}: is missing')
        try:
            return kind(**values) if before is None else replace(before, **values)
        except ValueError as error:
            named = str(error).split(' = ')[0]
            raise self._error(lines.get(named, node), f'{where}{error}') from None

    def _value(self, kind: Any, node: Any, where: str, before: Any = None) -> Any:
        if get_origin(kind) is UnionType:  # a part that may be missing
            kind = get_args(kind)[0]
        if is_dataclass(kind):
            return self.dataclass(kind, node, f'{where}.', before)
        if get_origin(kind) is tuple:
            return self._tuple(get_args(kind), node, where)
        value = None
        if isinstance(node, yaml.ScalarNode):
            value = yaml.SafeLoader('').construct_object(node)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or (kind is float and not math.isfinite(value)):
            raise self._error(node, f'{where} = {self._shown(node)}: must be {_KINDS[kind]}')
        return value

    def _tuple(self, kinds: tuple[Any, ...], node: Any, where: str) -> tuple[Any, ...]:
        endless = kinds[-1] is Ellipsis
        if len(kinds) == 2 and not endless and isinstance(node, yaml.ScalarNode):
            return (self._value(kinds[0], node, where),) * 2  # an interval of one value
        if not isinstance(node, yaml.SequenceNode) or (
                not endless and len(node.value) != len(kinds)):
            size = '' if endless else f' of {len(kinds)} numbers'
            raise self._error(node, f'{where} = {self._shown(node)}: must be a list{size}')
        return tuple(self._value(kinds[0], item, f'{where}[{i}]')
                     for i, item in enumerate(node.value))

    def _shown(self, node: Any) -> str:
        return repr(node.value) if isinstance(node, yaml.ScalarNode) else f'a {node.id}'

    def _error(self, node: Any, problem: str) -> ScenarioError:
        return ScenarioError(f'{self._path}:{node.start_mark.line + 1}: {problem}')


def key_tables() -> str:
    """Return one table for each part of the file."""
    return ''.join(_table(where, part) for where, part in _parts('', Scenario))


def _parts(where: str, part: type) -> Iterator[tuple[str, type]]:
    """Yield a part and all that it holds, each with the key where it stands."""
    yield where, part
    hints = get_type_hints(part)
    for field in fields(part):  # type: ignore[arg-type]
        for kind in (hints[field.name], *get_args(hints[field.name])):
            if is_dataclass(kind):
                below = f'{where}.{field.name}'.lstrip('.')
                yield from _parts(below, kind)  # type: ignore[arg-type]


def _table(where: str, part: type) -> str:
    hints = get_type_hints(part)
    title = f'`{where}`' if where else 'The file'
    rows = [f'\n## {title}\n', ' '.join((inspect.getdoc(part) or '').split()) + '\n',
            '| key | default | valid | meaning |', '|---|---|---|---|',
            *(f'| `{field.name}` | {_default(field)} | {_valid(field, hints)} | '
              f'{field.metadata.get("meaning", "")} |'
              for field in fields(part) if field.name != 'name')]  # type: ignore[arg-type]
    return '\n'.join(rows) + '\n'


def _default(field: Field[Any]) -> str:
    if field.default is MISSING and field.default_factory is MISSING:
        return 'needed'
    if field.default is MISSING or is_dataclass(field.default):
        return 'see below'
    return _shown(field.default)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        same = len(value) == 2 and value[0] == value[1]
        return _shown(value[0]) if same else f'[{", ".join(map(_shown, value))}]' if value else (
            'none')
    if value is None:
        return 'none'
    return str(value).lower() if isinstance(value, bool) else (
        f'{value:g}' if isinstance(value, float) else str(value))


def _valid(field: Field[Any], hints: dict[str, Any]) -> str:
    valid = field.metadata.get('valid')
    if isinstance(valid, Range):
        return f'[{valid.low:g}, {valid.high:g}] {valid.unit}'.strip()
    if valid:
        return ', '.join(valid)
    kind = hints[field.name]
    if is_dataclass(kind) or get_origin(kind) is UnionType:
        return f'`{field.name}:` of keys'
    if any(is_dataclass(each) for each in get_args(kind)):
        return f'a list of `{field.name}`'
    return {bool: 'true, false', str: 'a text'}.get(kind, '')
