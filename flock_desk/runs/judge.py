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
Bounds on the figures of a summary: ``evaluate``, ``demo`` and ``fly`` fail if one is broken.

Each bound names a figure, dots leading into the summary, with a least or a greatest value, or
both. ``evaluate --expect`` reads them from a YAML file::

    recall: {min: 0.98}
    distance_rms_m: {max: 0.004}
    nees_position: {min: 1.5, max: 6.0}
    rejections.outside the gate: {max: 3}
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
import difflib
import math
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from flock_follower.system.files import read_text

#: Keys under which anything may appear, a count of 0 unless it does.
COUNTERS = ('rejections.', 'setpoints.reasons.')


class FigureBound(NamedTuple):
    """
    A figure and the bounds that it must keep, both included; None is no bound.

    ``load``: how far beyond them a busy machine can push the figure; infinite: any distance.
    """

    key: str
    least: float | None = None
    most: float | None = None
    load: float = 0.0

    def __str__(self) -> str:
        """Return the bounds as text, such as '≥ 9.9, ≤ 10.1'."""
        return ', '.join(f'{sign} {value:g}' for sign, value in (
            ('≥', self.least), ('≤', self.most)) if value is not None)


class Judgment(NamedTuple):
    """A bound, the figure found, and its fault, or ''; ``judged``: whether the bound counts."""

    bound: FigureBound
    figure: float | None
    fault: str
    judged: bool = True

    @property
    def verdict(self) -> str:
        """Return 'ok', 'FAILED' or 'not judged'."""
        return 'not judged' if not self.judged else 'FAILED' if self.fault else 'ok'


def load_bounds(path: str | Path) -> list[FigureBound]:
    """
    Read a file of bounds.

    :raises ValueError: naming the file, the key and its fault.
    :raises OSError: if the file cannot be read.
    """
    try:
        return parse_bounds(yaml.safe_load(read_text(path)))
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f'{path}: {" ".join(str(error).split())}') from None


def parse_bounds(document: Any) -> list[FigureBound]:
    """
    Return the bounds of a parsed file.

    :raises ValueError: naming the key and its fault.
    """
    if not isinstance(document, Mapping) or not document:
        raise ValueError('must map figures of the summary to {min: ..., max: ...}')
    for key, ends in document.items():
        if not isinstance(ends, Mapping) or not ends or not set(ends) <= {'min', 'max'} or any(
                type(end) not in (int, float) or not math.isfinite(end) for end in ends.values()):
            raise ValueError(f'{key} = {ends!r}: must have min, max or both, finite numbers')
    return [FigureBound(str(key), ends.get('min'), ends.get('max'))
            for key, ends in document.items()]


def check_names(bounds: Collection[FigureBound], summary: Mapping[str, Any]) -> None:
    """
    Refuse a bound on a name that is no figure of the summary.

    :raises ValueError: naming the unknown name, and the figures of similar names, or all figures.
    """
    figures = [key for key, value in flat(summary) if not isinstance(value, (str, list))]
    for bound in bounds:
        if bound.key not in figures and not bound.key.startswith(COUNTERS):
            near = difflib.get_close_matches(bound.key, figures) or figures
            raise ValueError(f'{bound.key} is no figure of the summary: must be one of '
                             f'{", ".join(near)}')


def judge(bounds: Collection[FigureBound], summary: Mapping[str, Any],
          busy: bool = False) -> list[Judgment]:
    """
    Return the verdict on every bound; a figure that is None or not finite breaks its bound.

    :param busy: whether the machine was too busy. Then a broken bound is not judged if load can
        push the figure as far. A bound that holds does hold: load improves no figure.
    """
    figures, judgments = dict(flat(summary)), []
    for bound in bounds:
        key, least, most, load = bound
        excess = math.inf  # of an unknown figure
        figure = figures.get(key, 0 if key.startswith(COUNTERS) else None)
        fault = ''
        if figure is None:
            fault = f'{key} is not known: it was not measured, or is not finite'
        elif not math.isfinite(figure):
            fault = f'{key} = {figure}: must be finite'
        elif least is not None and figure < least:
            fault = f'{key} = {figure:.6g}: must be at least {least:g}'
            excess = least - figure
        elif most is not None and figure > most:
            fault = f'{key} = {figure:.6g}: must be at most {most:g}'
            excess = figure - most
        judged = not (busy and fault and (excess <= load or figure is None))
        judgments.append(Judgment(bound, figure, fault, judged))
    return judgments


def flat(summary: Mapping[str, Any], prefix: str = '') -> Iterable[tuple[str, Any]]:
    """Yield every figure under its dotted name."""
    for key, value in summary.items():
        if isinstance(value, Mapping):
            yield from flat(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value
