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
The results of ``evaluate``, ``demo`` and ``fly``: a table on the console, a page of HTML.

The console prints the keys of the figures in summary.json, as bounds use them. The page prints
words; each bound and each tooltip has the key.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
import sys
import textwrap
from typing import Any, NamedTuple

from flock_desk.runs.console import LINE_WIDTH
from flock_desk.runs.figure_table import parts_of, shown, words
from flock_desk.runs.judge import FigureBound, flat, judge, Judgment
from flock_desk.runs.processes import TOO_BUSY_EXIT_CODE
from flock_desk.runs.summary import consistency, write_summary
from flock_follower.checks.processor import Load
from flock_follower.system.whole_file import whole_file

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; } h2 { font-size: 1.15em; margin: 1.8em 0 .5em; }
p { margin: .3em 0; color: #555; } img { max-width: 100%; display: block; margin: .4em 0; }
figure { display: inline-block; width: 31%; margin: 0 1% 1em 0; }
figcaption { color: #555; font-size: .9em; } code { color: #777; font-size: .85em; }
.figures td:first-child { min-width: 5.5em; } .warning { color: #b03a00; font-weight: 600; }
.figures { columns: 3 300px; column-gap: 2.2em; } .bounds { max-width: 60em; }
.bounds td + td { white-space: nowrap; }
table { border-collapse: collapse; width: 100%; break-inside: avoid; margin-bottom: 1em; }
caption { text-align: left; font-weight: 600; padding: .2em 0; }
td { padding: .12em 0; border-bottom: 1px solid #eee; } td + td { text-align: right;
     font-variant-numeric: tabular-nums; padding-left: 1em; overflow-wrap: break-word;
     max-width: 14em; }
body { overflow-wrap: anywhere; }
@media (max-width: 700px) { figure { width: 100%; margin: 0 0 1em; } .bounds td + td { white-space:
       normal; } .bounds code { display: none; } .plot { overflow-x: auto; }
       .plot img { max-width: none; width: 880px; } }
.ok { color: #00734d; } .FAILED { color: #b03a00; font-weight: 600; }
"""


class Illustration(NamedTuple):
    """A PNG or JPEG; with a caption it is one of several in a row."""

    data: bytes
    description: str
    caption: str = ''


class Chapter(NamedTuple):
    """A part of the page: its title, a paragraph (may be empty), and pictures."""

    title: str
    text: str = ''
    illustrations: Sequence[Illustration] = ()


def table(summary: Mapping[str, Any], judgments: Sequence[Judgment]) -> list[str]:
    """Return the table of the shown figures, with bound and verdict if a figure has a bound."""
    judged = {judgment.bound.key: judgment for judgment in judgments}
    figures = {key: value for key, value in flat(summary)
               if key in judged or (value is not None and shown(key))}
    figures |= {key: each.figure for key, each in judged.items() if key not in figures}
    width = max(map(len, figures), default=0)
    lines = []
    for key, value in figures.items():
        line = f'  {key:<{width}}  {text(value):>10}  {_verdict(key, value)}'
        if key in judged:
            line += f'{judged[key].bound!s:<16}  {judged[key].verdict}'
        lines += textwrap.wrap(line, LINE_WIDTH, drop_whitespace=False,
                               subsequent_indent=' ' * (width + 4))
    return [line.rstrip() for line in lines]


def announce(summary: Mapping[str, Any], judgments: Sequence[Judgment],
             pages: Sequence[Path], logs: Path | None = None, load: Load | None = None) -> int:
    """
    Print the table, the broken bounds and the files to look at; return the exit code.

    :param logs: the folder to look at if something failed.
    :param load: why bounds were not judged.
    """
    print('\n'.join([*table(summary, judgments), *(f'report: {page}' for page in pages)]),
          flush=True)
    faults = [f'FAILED: {each.fault}' for each in judgments if each.verdict == 'FAILED']
    if faults and logs is not None:
        faults.append(f'the logs of every process are in {logs}')
    busy = too_busy(judgments, load)
    for line in filter(None, [*faults, busy and f'too busy: {busy}']):
        print(line, file=sys.stderr)
    return 1 if faults else TOO_BUSY_EXIT_CODE if busy else 0


def too_busy(judgments: Sequence[Judgment], load: Load | None) -> str:
    """Return why bounds were not judged, and which, in one line; '' if all were."""
    unjudged = ', '.join(each.bound.key for each in judgments if not each.judged)
    return f'{load}; close other programs; not judged: {unjudged}' if unjudged else ''


def report(folder: Path, title: str, introduction: str, summary: Mapping[str, Any],
           bounds: Sequence[FigureBound], chapters: Sequence[Chapter],
           warnings: Sequence[str] = (), parts: Mapping[str, Any] | None = None,
           load: Load | None = None) -> list[Judgment]:
    """
    Judge a summary, write summary.json and report.html to a folder, and return the judgments.

    :param warnings: shown at the top of the report.
    :param load: of the machine meanwhile; None if it is unknown, or irrelevant.
    :param parts: summaries of the parts, which are judged and written, too, but not shown.
    :raises OSError: if a file cannot be written.
    """
    whole = {**summary, **(parts or {})}
    judgments = judge(bounds, whole, load is not None and load.busy)
    busy = too_busy(judgments, load)
    write_summary(whole, folder / 'summary.json')
    write_report(folder / 'report.html', title, introduction, summary, judgments, chapters,
                 [*([f'too busy: {busy}'] if busy else []), *warnings])
    return judgments


def write_report(path: Path, title: str, introduction: str, summary: Mapping[str, Any],
                 judgments: Sequence[Judgment], chapters: Sequence[Chapter] = (),
                 warnings: Sequence[str] = ()) -> None:
    """
    Write the page.

    :param warnings: shown at the top of the report.
    :raises OSError: if it cannot be written.
    """
    body = ''.join([
        f'<h1>{escape(title)}</h1><p>{escape(introduction)}</p>',
        *(f'<p class="warning">{escape(warning[:1].upper() + warning[1:])}.</p>'
          for warning in warnings), _bounds(judgments),
        *map(_chapter, chapters), '<h2>All figures</h2>',
        '<p>The tooltip of a figure shows its key in summary.json.</p><div class="figures">',
        _group('', {key: value for key, value in summary.items()
                    if not isinstance(value, Mapping)}),
        *(_group(key, value) for key, value in summary.items() if isinstance(value, Mapping)),
        '</div>'])
    page = ('<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f'<title>{escape(title)}</title><style>{_STYLE}</style></head>'
            f'<body>{body}</body></html>\n')
    with whole_file(path) as file:
        file.write(page.encode())


def _verdict(key: str, value: Any) -> str:
    return consistency(value) if key.startswith('nees_') else ''


def _label(key: str, depth: int = 0) -> str:
    """Return the words of a key's groups, without the outer ``depth``, and of the figure."""
    parts = parts_of(key)
    return escape(': '.join(words('.'.join(parts[:n + 1])) for n in range(depth, len(parts))))


def _bounds(judgments: Sequence[Judgment]) -> str:
    rows = []
    for each in judgments:
        rows.append(f'<tr><td>{_label(each.bound.key)} <code>{escape(each.bound.key)}</code></td>'
                    f'<td>{escape(text(each.figure))}</td><td>{each.bound}</td>'
                    f'<td class="{each.verdict}">{each.verdict}</td></tr>')
    return f'<h2>Bounds</h2><table class="bounds">{"".join(rows)}</table>' if rows else ''


def _chapter(chapter: Chapter) -> str:
    """Return title, paragraph and pictures; a picture with a caption shares its row."""
    parts = [f'<h2>{escape(chapter.title)}</h2><p>{escape(chapter.text)}</p>']
    for data, description, caption in chapter.illustrations:
        kind = 'png' if data.startswith(b'\x89PNG') else 'jpeg'
        image = (f'<img alt="{escape(description)}" src="data:image/{kind};base64,'
                 f'{base64.b64encode(data).decode("ascii")}">')
        parts.append(f'<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>'
                     if caption else f'<div class="plot">{image}</div>')
    return ''.join(parts)


def _group(group: str, figures: Mapping[str, Any]) -> str:
    """Return the table of a group of figures; '': the figures in no group."""
    rows = []
    for key, value in flat(figures, f'{group}.' if group else ''):
        shown_value = '<br>'.join(filter(None, [escape(text(value)), _verdict(key, value)]))
        rows.append(f'<tr title="{escape(key)}"><td>{_label(key, 1 if group else 0)}</td>'
                    f'<td>{shown_value}</td></tr>')
    title = f'<caption title="{escape(group)}">{_label(group)}</caption>' if group else ''
    return f'<table>{title}{"".join(rows) or "<tr><td>none</td></tr>"}</table>'


def text(value: Any) -> str:
    """Return a figure as text, rounded for reading."""
    if value is None:
        return 'unknown'
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    if isinstance(value, list):
        return ', '.join(map(str, value)) or 'none'
    if not isinstance(value, float):
        return str(value)
    return f'{value:.4g}' if abs(value) >= 1e-3 else f'{round(value, 5) + 0.0:g}'
