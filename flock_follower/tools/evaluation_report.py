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

"""The report of an evaluation: one HTML file with the figures and the pictures in it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
import html
from pathlib import Path
from typing import Any

from flock_follower.tools.evaluation import Evaluation
from flock_follower.tools.expectations import Outcome
from flock_follower.tools.summary import flat

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; } h2 { font-size: 1.15em; margin: 1.8em 0 .5em; }
p { margin: .3em 0; color: #555; } img { max-width: 100%; display: block; margin: .4em 0; }
.figures { columns: 3 300px; column-gap: 2.2em; }
table { border-collapse: collapse; width: 100%; break-inside: avoid; margin-bottom: 1em; }
caption { text-align: left; font-weight: 600; padding: .2em 0; }
td { padding: .12em 0; border-bottom: 1px solid #eee; } td + td { text-align: right;
     font-variant-numeric: tabular-nums; padding-left: 1em; white-space: nowrap; }
.ok { color: #00734d; } .failed { color: #b03a00; font-weight: 600; }
"""


def write_report(evaluation: Evaluation, summary: Mapping[str, Any], outcomes: Sequence[Outcome],
                 path: Path) -> None:
    """
    Write the report; without matplotlib it has no pictures, and says so.

    :raises OSError: where it cannot be written.
    """
    parts = [f'<h1>{html.escape(evaluation.bag)}</h1>',
             f'<p>{summary["frames"]} images in {evaluation.duration:.1f} s, through perception, '
             'planner and setpoint gate in lock step.</p>',
             _judgement(outcomes), *_pictures(evaluation),
             '<h2>All figures</h2>', '<div class="figures">', *_tables(summary), '</div>']
    path.write_text(
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>Evaluation of {html.escape(evaluation.bag)}</title><style>{_STYLE}</style></head>'
        f'<body>{"".join(parts)}</body></html>\n', encoding='utf-8')


def _judgement(outcomes: Sequence[Outcome]) -> str:
    if not outcomes:
        return ''
    rows = []
    for (key, least, most), figure, fault in outcomes:
        bounds = ', '.join(text for text in (
            f'≥ {least:g}' if least is not None else '', f'≤ {most:g}' if most is not None else ''
        ) if text)
        mark = '<td class="failed">FAILED</td>' if fault else '<td class="ok">ok</td>'
        rows.append(f'<tr><td>{html.escape(key)}</td><td>{_text(figure)}</td><td>{bounds}</td>'
                    f'{mark}</tr>')
    return f'<h2>Expectations</h2><table style="max-width: 44em">{"".join(rows)}</table>'


def _pictures(evaluation: Evaluation) -> list[str]:
    try:
        from flock_follower.tools import evaluation_plots as plots
    except ImportError:
        return ['<p>Pictures need matplotlib, which is not installed.</p>']
    parts = []
    for name in evaluation.names:
        parts += [f'<h2>Flight: {html.escape(name)}</h2>',
                  _image(plots.flight_picture(evaluation, name), 'distance, path, limits')]
        if evaluation.truth:
            parts += [
                f'<h2>Errors against the truth: {html.escape(name)}</h2>',
                '<p>Relative to the follower, along its own axes. The band is twice the deviation '
                'that follows from the published covariances: 95 % of the errors should be '
                'inside.</p>',
                _image(plots.error_picture(evaluation, name), 'errors and their deviations')]
    return [*parts, '<h2>Stages</h2>',
            _image(plots.stage_picture(evaluation), 'stages, CPU time, states')]


def _image(png: bytes, description: str) -> str:
    data = base64.b64encode(png).decode('ascii')
    return f'<img alt="{description}" src="data:image/png;base64,{data}">'


def _tables(summary: Mapping[str, Any]) -> list[str]:
    """Return the figures on their own as one table, and one for each group of them."""
    alone = {key: value for key, value in summary.items() if not isinstance(value, Mapping)}
    groups = {key: value for key, value in summary.items() if isinstance(value, Mapping)}
    return [_table('', alone), *(_table(key, group) for key, group in groups.items())]


def _table(caption: str, figures: Mapping[str, Any]) -> str:
    rows = ''.join(f'<tr><td>{html.escape(key)}</td><td>{_text(value)}</td></tr>'
                   for key, value in flat(figures))
    title = f'<caption>{html.escape(caption)}</caption>' if caption else ''
    return f'<table>{title}{rows or "<tr><td>none</td></tr>"}</table>'


def _text(value: Any) -> str:
    if value is None:
        return 'unknown'
    if isinstance(value, list):
        return html.escape(', '.join(map(str, value)))
    return f'{value:.4g}' if isinstance(value, float) else html.escape(str(value))
