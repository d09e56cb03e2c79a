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
What ``evaluate``, ``demo`` and ``fly`` show of a flight: a table on the console, a page of HTML.

The console names figures by their keys in summary.json, as bounds do; the page in words, with the
key beside each bound, and where the pointer rests on a figure.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
import sys
import textwrap
from typing import Any, NamedTuple

from flock_desk.runs.figure_names import name, text
from flock_desk.runs.judge import flat, Judgement
from flock_follower.whole_file import whole_file

#: The figures printed, beside all that have a bound; the others are in summary.json.
SHOWN = (
    'duration_s', 'frames', 'recall', 'detections.', 'rejections.', 'distance_m.',
    'true_distance_m.', 'distance_rms_m', 'distance_bias_m', 'position_rms_m', 'velocity_rms_m_s',
    'nees_position', 'nees_velocity', 'orientation_wrong_share', 'leader_speed_max_m_s',
    'leader_faster_than_v_max', 'own_speed_max_m_s', 'faster_than_v_max_share',
    'time_in_band_share', 'planner.states.', 'planner.warning', 'holds.', 'setpoints.', 'outages.',
    'latency_ms.', 'cpu_ms_per_frame', 'realtime_factor', 'skipped_images', 'cpu_cores.')
#: Characters of a line on the console.
WIDTH = 100

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; } h2 { font-size: 1.15em; margin: 1.8em 0 .5em; }
p { margin: .3em 0; color: #555; } img { max-width: 100%; display: block; margin: .4em 0; }
figure { display: inline-block; width: 31%; margin: 0 1% 1em 0; }
figcaption { color: #555; font-size: .9em; }
code { color: #777; font-size: .85em; } .part td:first-child { padding-left: 1.2em; }
.figures td:first-child { min-width: 5.5em; } .head td { font-style: italic; }
.warning { color: #b03a00; font-weight: 600; }
.figures { columns: 3 300px; column-gap: 2.2em; } .bounds { max-width: 60em; }
.bounds td + td { white-space: nowrap; }
table { border-collapse: collapse; width: 100%; break-inside: avoid; margin-bottom: 1em; }
caption { text-align: left; font-weight: 600; padding: .2em 0; }
td { padding: .12em 0; border-bottom: 1px solid #eee; } td + td { text-align: right;
     font-variant-numeric: tabular-nums; padding-left: 1em; }
.ok { color: #00734d; } .failed { color: #b03a00; font-weight: 600; }
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


def aligned(rows: Sequence[Sequence[str]], left: int = 2) -> list[str]:
    """Return rows as lines of columns two apart, the first ``left`` of them flush left."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ['  '.join(cell.ljust(width) if n < left else cell.rjust(width)
                      for n, (cell, width) in enumerate(zip(row, widths))).rstrip()
            for row in rows]


def table(summary: Mapping[str, Any], judgements: Sequence[Judgement]) -> list[str]:
    """Return the lines of the figures shown, bounds and verdicts beside those that have one."""
    bounds = {judgement.bound.key: judgement for judgement in judgements}
    figures = dict(flat(summary))
    keys = [key for key, value in figures.items()
            if key in bounds or (_shown(key) and value is not None)]
    keys += [key for key in bounds if key not in figures]
    names = {key: _shown_name(key, figures) for key in keys}
    key_width = max(map(len, names.values()))
    numbers = {key: text(bounds[key].figure if key in bounds else figures[key]) for key in keys}
    value_width = max((len(number) for key, number in numbers.items()
                       if not isinstance(figures.get(key), str)), default=0)
    lines = []
    for key in keys:
        line = f'  {names[key]:<{key_width}}  {numbers[key]:>{value_width}}'
        if key in bounds:
            mark = 'FAILED' if bounds[key].fault else 'ok'
            line += f'  {bounds[key].bound!s:<16}  {mark}'
        lines += textwrap.wrap(line, WIDTH, drop_whitespace=False,
                               subsequent_indent=' ' * (key_width + 4))
    return lines


def announce(summary: Mapping[str, Any], judgements: Sequence[Judgement],
             written: Sequence[Path], logs: Path | None = None) -> int:
    """
    Print the table, what failed and where more is to be seen; return the exit code.

    :param written: the files to look at.
    :param logs: the folder to look at where something failed.
    """
    print('\n'.join(table(summary, judgements)))
    print('\n'.join(f'{"picture" if path.suffix == ".png" else "report"}: {path}'
                    for path in written), flush=True)
    faults = [judgement.fault for judgement in judgements if judgement.fault]
    for fault in faults:
        print(f'FAILED: {fault}', file=sys.stderr)
    if faults and logs is not None:
        print(f'the logs of every process are in {logs}', file=sys.stderr)
    return 1 if faults else 0


def write_report(path: Path, title: str, introduction: str, summary: Mapping[str, Any],
                 judgements: Sequence[Judgement],
                 draw: Callable[[], Iterable[Chapter]] | Iterable[Chapter] = (), *,
                 warnings: Sequence[str] = ()) -> None:
    """
    Write the page; where matplotlib is missing it has no pictures, and says so.

    :param draw: the chapters, or what returns them, and imports matplotlib for it.
    :param warnings: what to know before reading on.
    :raises OSError: where it cannot be written.
    """
    try:
        chapters = list(draw() if callable(draw) else draw)
    except ImportError:
        chapters = [Chapter('Pictures', 'They need matplotlib, which is not installed.')]
    body = ''.join([
        f'<h1>{escape(title)}</h1><p>{escape(introduction)}</p>',
        *(f'<p class="warning">{escape(warning[:1].upper() + warning[1:])}.</p>'
          for warning in warnings), _bounds(judgements),
        *map(_chapter, chapters), '<h2>All figures</h2>',
        '<p>The pointer on a figure shows its key in summary.json.</p><div class="figures">',
        *_groups(summary), '</div>'])
    page = ('<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f'<title>{escape(title)}</title><style>{_STYLE}</style></head>'
            f'<body>{body}</body></html>\n')
    with whole_file(path) as file:
        file.write(page.encode())


def _shown(key: str) -> bool:
    return any(key == shown or (shown.endswith('.') and key.startswith(shown)) for shown in SHOWN)


def _shown_name(key: str, figures: Mapping[str, Any]) -> str:
    """Return a key; what is a part of the total before it is indented instead."""
    group, _, part = key.rpartition('.')
    return f'  {part}' if part != 'total' and f'{group}.total' in figures else key


def _bounds(judgements: Sequence[Judgement]) -> str:
    if not judgements:
        return ''
    rows = ''.join(
        f'<tr><td>{escape(_path_name(bound.key))} <code>{escape(bound.key)}</code></td>'
        f'<td>{escape(text(figure))}</td><td>{bound}</td>'
        + ('<td class="failed">FAILED</td></tr>' if fault else '<td class="ok">ok</td></tr>')
        for bound, figure, fault in judgements)
    return f'<h2>Bounds</h2><table class="bounds">{rows}</table>'


def _chapter(chapter: Chapter) -> str:
    paragraph = f'<p>{escape(chapter.text)}</p>' if chapter.text else ''
    return (f'<h2>{escape(chapter.title)}</h2>{paragraph}'
            + ''.join(map(_illustration, chapter.illustrations)))


def _illustration(illustration: Illustration) -> str:
    kind = 'png' if illustration.data.startswith(b'\x89PNG') else 'jpeg'
    image = (f'<img alt="{escape(illustration.description)}" src="data:image/{kind};base64,'
             f'{base64.b64encode(illustration.data).decode("ascii")}">')
    if not illustration.caption:
        return image
    return f'<figure>{image}<figcaption>{escape(illustration.caption)}</figcaption></figure>'


def _groups(summary: Mapping[str, Any]) -> list[str]:
    """Return the figures on their own as one table, and one for each group of them."""
    alone = {key: value for key, value in summary.items() if not isinstance(value, Mapping)}
    groups = {key: value for key, value in summary.items() if isinstance(value, Mapping)}
    return [_group('', alone), *(_group(key, group) for key, group in groups.items())]


def _group(key: str, figures: Mapping[str, Any]) -> str:
    title = f'<caption title="{escape(key)}">{escape(name(key))}</caption>' if key else ''
    rows = ''.join(_rows(figures, f'{key}.' if key else ''))
    return f'<table>{title}{rows or "<tr><td>none</td></tr>"}</table>'


def _rows(figures: Mapping[str, Any], prefix: str, part: bool = False) -> Iterator[str]:
    """Yield rows, those of a group within indented below its name, as those of a total are."""
    for key, value in figures.items():
        if isinstance(value, Mapping):
            yield f'<tr class="head"><td>{escape(name(key))}</td><td></td></tr>'
            yield from _rows(value, f'{prefix}{key}.', True)
            continue
        indented = part or ('total' in figures and key != 'total')
        yield (f'<tr{" class=part" if indented else ""} title="{escape(prefix + key)}">'
               f'<td>{escape(name(key))}</td><td>{escape(text(value))}</td></tr>')


def _path_name(key: str) -> str:
    """Return the name of a figure by its whole key: what it is of, and what it is."""
    return ': '.join(map(name, key.split('.')))
