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

Both speak of figures by their keys in summary.json, whose names hold their units.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
import sys
from typing import Any, NamedTuple

from flock_follower.tools.judge import flat, Judgement
from flock_follower.whole_file import whole_file

#: The figures printed, beside all that have a bound; the others are in summary.json.
SHOWN = (
    'duration_s', 'frames', 'recall', 'detections.', 'rejections.', 'distance_m.',
    'true_distance_m.', 'distance_rms_m', 'distance_bias_m', 'position_rms_m', 'velocity_rms_m_s',
    'nees_position', 'nees_velocity', 'orientation_wrong_share', 'leader_speed_max_m_s',
    'leader_faster_than_v_max', 'time_in_band_share', 'planner.states.', 'planner.warning',
    'setpoints.', 'outages.', 'latency_ms.', 'cpu_ms_per_frame', 'realtime_factor',
    'skipped_images', 'cpu_cores.')
#: Characters of a line on the console.
WIDTH = 100

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; } h2 { font-size: 1.15em; margin: 1.8em 0 .5em; }
p { margin: .3em 0; color: #555; } img { max-width: 100%; display: block; margin: .4em 0; }
figure { display: inline-block; width: 31%; margin: 0 1% 1em 0; }
figcaption { color: #555; font-size: .9em; }
.figures { columns: 3 300px; column-gap: 2.2em; } .bounds { max-width: 44em; }
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
    key_width = max(map(len, keys))
    numbers = {key: text(bounds[key].figure if key in bounds else figures[key]) for key in keys}
    value_width = max(len(number) for key, number in numbers.items()
                      if not isinstance(figures.get(key), str))
    lines = []
    for key in keys:
        line = f'  {key:<{key_width}}  {numbers[key]:>{value_width}}'
        if key in bounds:
            mark = 'FAILED' if bounds[key].fault else 'ok'
            line += f'  {bounds[key].bound!s:<16}  {mark}'
        lines.append(line if len(line) <= WIDTH else f'{line[:WIDTH - 1]}…')
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
                 draw: Callable[[], Iterable[Chapter]] | Iterable[Chapter] = ()) -> None:
    """
    Write the page; where matplotlib is missing it has no pictures, and says so.

    :param draw: the chapters, or what returns them, and imports matplotlib for it.
    :raises OSError: where it cannot be written.
    """
    try:
        chapters = list(draw() if callable(draw) else draw)
    except ImportError:
        chapters = [Chapter('Pictures', 'They need matplotlib, which is not installed.')]
    body = ''.join([
        f'<h1>{escape(title)}</h1><p>{escape(introduction)}</p>', _bounds(judgements),
        *map(_chapter, chapters), '<h2>All figures</h2><div class="figures">',
        *_groups(summary), '</div>'])
    page = ('<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f'<title>{escape(title)}</title><style>{_STYLE}</style></head>'
            f'<body>{body}</body></html>\n')
    with whole_file(path) as file:
        file.write(page.encode())


def text(value: Any) -> str:
    """Return a figure as people read it."""
    if value is None:
        return 'unknown'
    if isinstance(value, list):
        return ', '.join(map(str, value))
    return f'{value:.4g}' if isinstance(value, float) else str(value)


def _shown(key: str) -> bool:
    return any(key == shown or (shown.endswith('.') and key.startswith(shown)) for shown in SHOWN)


def _bounds(judgements: Sequence[Judgement]) -> str:
    if not judgements:
        return ''
    rows = ''.join(
        f'<tr><td>{escape(bound.key)}</td><td>{escape(text(figure))}</td><td>{bound}</td>'
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


def _group(caption: str, figures: Mapping[str, Any]) -> str:
    rows = ''.join(f'<tr><td>{escape(key)}</td><td>{escape(text(value))}</td></tr>'
                   for key, value in flat(figures))
    title = f'<caption>{escape(caption)}</caption>' if caption else ''
    return f'<table>{title}{rows or "<tr><td>none</td></tr>"}</table>'
