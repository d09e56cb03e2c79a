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
Scenarios as YAML files; an error names the file, the key, its value and the valid values.

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

A variant is a scenario with a name of its own; it contains only the keys that differ.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, MISSING, replace
from functools import cache
import inspect
import math
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import yaml

from flock_desk.scenarios.courses import course
from flock_desk.scenarios.scenario import Scenario
from flock_follower.system.files import resource

FOLDER = 'config/scenarios'
_VARIANTS = 'variants'
_KINDS = {float: 'a number', int: 'an integer', str: 'a text', bool: 'true or false'}


class ScenarioError(ValueError):
    """A scenario file that cannot be flown; the message names the key and the reason."""


def names() -> list[str]:
    """Return the names of the scenarios of the package."""
    return sorted(_files())


@cache
def _files() -> dict[str, Path]:
    """Return the file of each scenario of the package, by its name."""
    return {name: path for path in resource(FOLDER).glob('*.yaml')
            for name in (path.stem, *yaml.safe_load(path.read_text('utf-8')).get(_VARIANTS, {}))}


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

    :raises ScenarioError: also for operations or a flock, which fly in lock step only.
    """
    scenario = load(name)
    for part in ('operations', 'flock'):
        if getattr(scenario, part):
            raise ScenarioError(f'scenario = {name!r}: its {part} can be flown in lock step only: '
                                f'flights --scenario {name}')
    return scenario


def parse(text: str, path: str, variant: str = '') -> Scenario:
    """
    Return the scenario in the text of a file, or a variant of it.

    :raises ScenarioError: naming file, key, value and the valid values.
    """
    stem = Path(path).stem
    try:
        root = yaml.safe_load(text)
        variants = root.pop(_VARIANTS, None) or {} if isinstance(root, dict) else {}
        if not isinstance(variants, dict):
            raise ValueError(f'{_VARIANTS} = {variants!r}: must be a mapping of names to keys')
        scenario: Scenario = _part(Scenario, root, '', name=stem)
        if variant in variants:
            scenario = _part(Scenario, variants[variant], f'{_VARIANTS}.{variant}', scenario,
                             name=variant)
        elif variant not in ('', stem):
            raise ValueError(f'has no variant {variant}, only {", ".join(variants)}')
        course(scenario, 0)
    except (ValueError, yaml.YAMLError) as error:
        raise ScenarioError(f'{path}: {" ".join(str(error).split())}') from None
    return scenario


def _part(kind: Any, given: Any, where: str, before: Any = None, **more: Any) -> Any:
    """Return a part of a kind, a dataclass; missing keys are as in ``before``, or the default."""
    hints, prefix = get_type_hints(kind), f'{where}.'.lstrip('.')
    allowed = [f.name for f in fields(kind) if f.name != 'name']
    if not isinstance(given, dict):
        raise ValueError(f'{where or "the file"}: must be a mapping of {", ".join(allowed)}')
    if unknown := [key for key in given if key not in allowed]:
        raise ValueError(f'{prefix}{unknown[0]}: unknown key: must be one of '
                         f'{", ".join(allowed)}')
    values = {**more, **{key: _value(hints[key], value, prefix + key, getattr(before, key, None))
                         for key, value in given.items()}}
    for f in fields(kind):
        if before is None and f.name not in values and (
                f.default is MISSING and f.default_factory is MISSING):
            raise ValueError(f'{prefix}{f.name}: is missing')
    try:
        return kind(**values) if before is None else replace(before, **values)
    except ValueError as error:
        raise ValueError(f'{prefix}{error}') from None


def _value(kind: Any, given: Any, where: str, before: Any = None) -> Any:
    """Return a value of a declared type."""
    if get_origin(kind) is UnionType:  # a part that may be missing
        kind = get_args(kind)[0]
    if is_dataclass(kind):
        return _part(kind, given, where, before)
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        endless = kinds[-1] is Ellipsis
        if len(kinds) == 2 and not endless and not isinstance(given, list):
            given = [given, given]  # an interval of one value
        if not isinstance(given, list) or not (endless or len(given) == len(kinds)):
            raise ValueError(f'{where} = {given!r}: must be a list'
                             + ('' if endless else f' of {len(kinds)} numbers'))
        return tuple(_value(kinds[0], each, f'{where}[{i}]') for i, each in enumerate(given))
    if kind is float and type(given) is int:
        given = float(given)
    if type(given) is not kind or (kind is float and not math.isfinite(given)):
        raise ValueError(f'{where} = {given!r}: must be {_KINDS[kind]}')
    return given


def key_tables() -> str:
    """Return one table for each part of the file."""
    return '\n'.join(_table(where, part) for where, part in _parts('', Scenario))


def _parts(where: str, part: Any) -> Iterator[tuple[str, Any]]:
    """Yield a part and all that it holds, each with its key."""
    yield where, part
    hints = get_type_hints(part)
    for field in fields(part):
        for kind in (hints[field.name], *get_args(hints[field.name])):
            if is_dataclass(kind):
                yield from _parts(f'{where}.{field.name}'.lstrip('.'), kind)


def _table(where: str, part: Any) -> str:
    rows = [f'\n## {where or "The file"}\n', ' '.join((inspect.getdoc(part) or '').split()) + '\n',
            '| key | default | valid | meaning |', '|---|---|---|---|']
    for field in fields(part):
        if field.name == 'name':  # that of the file
            continue
        default, valid = field.default, field.metadata.get('valid') or ''
        if isinstance(default, tuple):
            default = list(default)
        if default is MISSING or is_dataclass(default):
            default = 'needed' if field.default_factory is MISSING else 'see below'
        if isinstance(valid, tuple):
            valid = ', '.join(valid)
        rows.append(f'| `{field.name}` | {default} | {valid} | '
                    f'{field.metadata.get("meaning", "")} |')
    return '\n'.join(rows)
