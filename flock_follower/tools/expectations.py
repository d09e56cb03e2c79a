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
Bounds on the figures of a summary, from a YAML file: what makes ``evaluate`` a gate in CI.

Each key is a figure of summary.json, dots leading into it, with a least or a greatest value, or
both::

    recall: {min: 0.98}
    distance_rms_m: {max: 0.004}
    nees_position: {min: 1.5, max: 6.0}
    rejections.outside the gate: {max: 3}
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
import difflib
import math
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from flock_follower.tools.summary import COUNTERS, flat


class Expectation(NamedTuple):
    """A figure and the bounds that it must keep, both included; None is no bound."""

    key: str
    least: float | None
    most: float | None


class Outcome(NamedTuple):
    """An expectation, the figure found, and what is wrong with it, or ''."""

    expectation: Expectation
    figure: float | None
    fault: str


def load_expectations(path: str | Path) -> list[Expectation]:
    """
    Read a file of expectations.

    :raises ValueError: naming the file, the key and what is wrong with it.
    :raises OSError: where the file cannot be read.
    """
    try:
        return parse_expectations(yaml.safe_load(Path(path).read_text(encoding='utf-8')))
    except yaml.YAMLError as error:
        raise ValueError(f'{path}: not valid YAML: {" ".join(str(error).split())}') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None


def parse_expectations(document: Any) -> list[Expectation]:
    """
    Return the expectations of a parsed file.

    :raises ValueError: naming the key and what is wrong with it.
    """
    if not isinstance(document, Mapping) or not document:
        raise ValueError('must map figures of the summary to {min: ..., max: ...}')
    expectations = []
    for key, bounds in document.items():
        if not isinstance(bounds, Mapping) or not bounds or not set(bounds) <= {'min', 'max'}:
            raise ValueError(f'{key} = {bounds!r}: must have min, max or both, and nothing else')
        for name, bound in bounds.items():
            if isinstance(bound, bool) or not isinstance(bound, (int, float)) or (
                    not math.isfinite(bound)):
                raise ValueError(f'{key}: {name} = {bound!r}: must be a finite number')
        expectation = Expectation(str(key), bounds.get('min'), bounds.get('max'))
        if expectation.least is not None and expectation.most is not None and (
                expectation.least > expectation.most):
            raise ValueError(f'{key}: min = {expectation.least:g}: must be at most max = '
                             f'{expectation.most:g}')
        expectations.append(expectation)
    return expectations


def check_names(expectations: Collection[Expectation], summary: Mapping[str, Any]) -> None:
    """
    Refuse an expectation of something that is no figure of the summary.

    :raises ValueError: naming it, and the figure that may have been meant.
    """
    figures = [key for key, value in flat(summary) if not isinstance(value, (str, list))]
    for key in (e.key for e in expectations):
        if key in figures or _counted(key):
            continue
        near = difflib.get_close_matches(key, figures, n=1)
        hint = f'did you mean {near[0]}?' if near else f'it has {", ".join(figures)}'
        raise ValueError(f'{key} is no figure of the summary: {hint}')


def judge(expectations: Collection[Expectation], summary: Mapping[str, Any]) -> list[Outcome]:
    """Return what became of every expectation; names must have been checked."""
    figures = dict(flat(summary))
    return [_judge(expectation, figures.get(expectation.key, 0 if _counted(expectation.key)
                                            else None)) for expectation in expectations]


def _judge(expectation: Expectation, figure: float | None) -> Outcome:
    key, least, most = expectation
    if figure is None:
        fault = f'{key} is not known: it needs the truth, or images, that the bag does not have'
    elif least is not None and not figure >= least:
        fault = f'{key} = {figure:.6g}: must be at least {least:g}'
    elif most is not None and not figure <= most:
        fault = f'{key} = {figure:.6g}: must be at most {most:g}'
    else:
        fault = ''
    return Outcome(expectation, figure, fault)


def _counted(key: str) -> bool:
    return any(key.startswith(f'{counter}.') for counter in COUNTERS)
