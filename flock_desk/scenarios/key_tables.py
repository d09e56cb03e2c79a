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

"""The keys of a scenario file, as Markdown tables: ``python -m flock_desk.flights --keys``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, fields, is_dataclass, MISSING
import inspect
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from flock_desk.scenarios.scenario import Scenario
from flock_follower.ranges import Range


def markdown() -> str:
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
            '| key | default | valid | meaning |', '|---|---|---|---|']
    for field in fields(part):  # type: ignore[arg-type]
        if field.name == 'name':
            continue  # that of the file
        rows.append(f'| `{field.name}` | {_default(field)} | {_valid(field, hints)} | '
                    f'{field.metadata.get("meaning", "")} |')
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
