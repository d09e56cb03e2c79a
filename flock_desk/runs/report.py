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
key beside each bound, and in the tooltip of each figure.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
import sys
import textwrap
from typing import Any, NamedTuple

from flock_desk.runs.judge import FigureBound, flat, judge, Judgement
from flock_desk.runs.summary import consistency, write_summary
from flock_follower.files import whole_file

#: The figures printed, beside all that have a bound; the others are in summary.json.
SHOWN = (
    'duration_s.', 'frames.', 'recall.', 'detections.', 'rejections.', 'distance_m.',
    'true_distance_m.', 'distance_rms_m.', 'distance_bias_m.', 'position_rms_m.',
    'velocity_rms_m_s.', 'nees_position.', 'nees_velocity.', 'orientation_wrong_share.',
    'leader_speed_max_m_s.', 'leader_faster_than_v_max.', 'own_speed_max_m_s.',
    'faster_than_v_max_share.', 'time_in_band_share.', 'planner.states.', 'planner.warning.',
    'holds.', 'setpoints.', 'outages.', 'latency_ms.', 'cpu_ms_per_frame.', 'realtime_factor.',
    'skipped_images.', 'cpu_cores.')
#: Characters of a line on the console.
WIDTH = 100
#: Units by the suffix of a key, the longest first.
_UNITS = (('_m_s2', 'm/s²'), ('_m_s3', 'm/s³'), ('_m_s', 'm/s'), ('_ms', 'ms'), ('_hz', 'Hz'),
          ('_m', 'm'), ('_s', 's'))
#: Names of the keys whose words do not say it.
_NAMES = {
    'recall': 'share of images in view with an estimate (recall)',
    'recall_of_processed': 'share of images looked at with an estimate',
    'processed_share': 'share of images looked at in time',
    'frames': 'images', 'frames_in_view': 'images with the leader in view',
    'distance_m': 'estimated distance', 'true_distance_m': 'true distance',
    'distance_rms_m': 'error of the distance, RMS',
    'distance_bias_m': 'error of the distance, mean',
    'position_rms_m': 'error of the relative position, RMS of the vector',
    'position_bias_m': 'error of the relative position, mean by axis',
    'velocity_rms_m_s': 'error of the relative velocity, RMS of the vector',
    'velocity_rms_of_all_m_s': 'the same RMS of velocities, refused ones too',
    'velocity_bias_m_s': 'error of the relative velocity, mean by axis',
    'nees_position': 'consistency of positions (NEES; 3 is expected)',
    'nees_velocity': 'consistency of velocities (NEES; 3 is expected)',
    'orientation_wrong_share': "share with the leader's attitude wrong by over 20°",
    'own_speed_max_m_s': 'greatest speed of the follower in the bag',
    'faster_than_v_max_share': 'share of time it is faster than v_max',
    'detections': 'images by the stage that measured the leader',
    'track': 'track: edges, where it was expected', 'roi': 'roi: search near there',
    'full': 'full: search everywhere', 'none': 'none',
    'rejections': 'not used, and why', 'holds': 'HOLD of the planner: how long, and why',
    'reasons': 'reasons given',
    'cpu_ms_per_frame': 'CPU time of perception per image, ms',
    'cpu_ms': 'CPU time', 'cpu_cores': 'CPU, in cores', 'total': 'all processes',
    'realtime_factor': 'times faster than real time',
    'timings': 'time that this took', 'wall_time_s': 'in all',
    'latency_ms': 'from image to MAVLink', 'p50': 'median', 'p95': '95 % below',
    'p99': '99 % below', 'failed_processes': 'processes that did not end well',
    'time_in_band_share': 'share of time in the band',
    'longest_gap_in_view_s': 'longest time without an estimate, leader in view',
    'leader_speed_max_m_s': 'greatest speed of the leader',
    'leader_faster_than_v_max': 'leader faster than v_max for over 1 s',
    'altitude_off_m': "farthest from the leader's height",
    'skipped_images': 'images not rendered in time', 'ended_early': 'ended early by the bridge',
    'speed_max_m_s': 'greatest speed', 'missed_ticks': 'ticks missed',
    'missed_ticks_share': 'share of ticks missed', 'warnings': 'warnings (count)',
    'warning': 'first warning', 'hold_count': 'times in HOLD', 'hold_s': 'time in HOLD',
    'acceleration_max_m_s2': 'greatest acceleration', 'rate_hz': 'rate',
    'outages': 'outages', 'hold_after_s': 'it held after', 'track_after_s': 'followed again after',
    'reason': 'reason', 'problems': 'problems reported by the nodes, seconds each',
    'external': 'autopilot elsewhere', 'pace': 'pace of its clock by ours',
    'nearest_m': 'nearest any two came', 'pairs': 'nearest by pair, m',
    'column_of': 'scenario', 'min': 'least', 'max': 'greatest',
    # Of flights in lock step.
    'in_band': 'share of runs that never left the band',
    'time_in_band': 'share of time in the band',
    'min_separation_m': 'nearest of all runs', 'max_separation_m': 'farthest of all runs',
    'time_in_sight': 'share of time with the leader in sight',
    'guard_active': 'share of time in which the guard acted'}

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


def table(summary: Mapping[str, Any], judgements: Sequence[Judgement]) -> list[str]:
    """Return the lines of the figures shown, bounds and verdicts beside those that have one."""
    bounds = {judgement.bound.key: judgement for judgement in judgements}
    figures = {key: value for key, value in flat(summary)
               if key in bounds or (value is not None and f'{key}.'.startswith(SHOWN))}
    figures |= {key: each.figure for key, each in bounds.items() if key not in figures}
    names = {key: _shown_name(key, figures) for key in figures}
    key_width = max(map(len, names.values()))
    value_width = max((len(text(value)) for value in figures.values()
                       if not isinstance(value, str)), default=0)
    lines = []
    for key, value in figures.items():
        line = f'  {names[key]:<{key_width}}  {text(value):>{value_width}}'
        if key in bounds:
            mark = 'FAILED' if bounds[key].fault else 'ok'
            line += f'  {bounds[key].bound!s:<16}  {mark}'
        elif verdict := _verdict(key, value):
            line += f'  {verdict}'
        lines += textwrap.wrap(line, WIDTH, drop_whitespace=False,
                               subsequent_indent=' ' * (key_width + 4))
    return lines


def _verdict(key: str, value: Any) -> str:
    return consistency(value) if key.startswith('nees_') else ''


def announce(summary: Mapping[str, Any], judgements: Sequence[Judgement],
             written: Sequence[Path], logs: Path | None = None) -> int:
    """
    Print the table, what failed and where to look for more; return the exit code.

    :param written: the files to look at.
    :param logs: the folder to look at if something failed.
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


def report(folder: Path, title: str, introduction: str, summary: Mapping[str, Any],
           bounds: Sequence[FigureBound], draw: Callable[[], Iterable[Chapter]], *,
           warnings: Sequence[str] = (), parts: Mapping[str, Any] | None = None
           ) -> list[Judgement]:
    """
    Judge a summary, write summary.json and report.html to a folder, and return the judgements.

    :param draw: returns the chapters; imports matplotlib.
    :param warnings: shown at the top of the report.
    :param parts: summaries of the parts, which are judged and written, too, but not shown.
    :raises OSError: if a file cannot be written.
    """
    whole = {**summary, **(parts or {})}
    judgements = judge(bounds, whole)
    write_summary(whole, folder / 'summary.json')
    write_report(folder / 'report.html', title, introduction, summary, judgements, draw,
                 warnings=warnings)
    return judgements


def write_report(path: Path, title: str, introduction: str, summary: Mapping[str, Any],
                 judgements: Sequence[Judgement],
                 draw: Callable[[], Iterable[Chapter]] | Iterable[Chapter] = (), *,
                 warnings: Sequence[str] = ()) -> None:
    """
    Write the page; without matplotlib it has no pictures, and says so.

    :param draw: the chapters, or what returns them, and imports matplotlib for it.
    :param warnings: shown at the top of the report.
    :raises OSError: if it cannot be written.
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
        '<p>The tooltip of a figure shows its key in summary.json.</p><div class="figures">',
        *_groups(summary), '</div>'])
    page = ('<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f'<title>{escape(title)}</title><style>{_STYLE}</style></head>'
            f'<body>{body}</body></html>\n')
    with whole_file(path) as file:
        file.write(page.encode())


def _shown_name(key: str, figures: Mapping[str, Any]) -> str:
    """Return a key; what is a part of the total before it is indented instead."""
    group, _, part = key.rpartition('.')
    return f'  {part}' if part != 'total' and f'{group}.total' in figures else key


def _bounds(judgements: Sequence[Judgement]) -> str:
    if not judgements:
        return ''
    rows = ''.join(
        f'<tr><td>{escape(": ".join(map(name, bound.key.split("."))))} '
        f'<code>{escape(bound.key)}</code></td>'
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


def _groups(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield a table of the figures on their own, and one for each group of them."""
    groups = {'': {key: value for key, value in summary.items()
                   if not isinstance(value, Mapping)},
              **{key: value for key, value in summary.items() if isinstance(value, Mapping)}}
    for key, figures in groups.items():
        title = f'<caption title="{escape(key)}">{escape(name(key))}</caption>' if key else ''
        rows = ''.join(_rows(figures, f'{key}.' if key else ''))
        yield f'<table>{title}{rows or "<tr><td>none</td></tr>"}</table>'


def _rows(figures: Mapping[str, Any], prefix: str, part: bool = False) -> Iterator[str]:
    """Yield rows, those of a group within indented below its name, as those of a total are."""
    for key, value in figures.items():
        if isinstance(value, Mapping):
            yield f'<tr class="head"><td>{escape(name(key))}</td><td></td></tr>'
            yield from _rows(value, f'{prefix}{key}.', True)
            continue
        indented = part or ('total' in figures and key != 'total')
        shown = '<br>'.join(filter(None, [escape(text(value)), _verdict(key, value)]))
        yield (f'<tr{" class=part" if indented else ""} title="{escape(prefix + key)}">'
               f'<td>{escape(name(key))}</td><td>{shown}</td></tr>')


def name(key: str) -> str:
    """Return the name of a figure by the last part of its key, with its unit."""
    unit = next(((suffix, unit) for suffix, unit in _UNITS if key.endswith(suffix)), None)
    if key in _NAMES:
        return _NAMES[key] if unit is None else f'{_NAMES[key]}, {unit[1]}'
    if unit is None or ' ' in key or key.startswith('at_') or '_at_' in key:
        return key.replace('_', ' ')
    return f'{key.removesuffix(unit[0]).replace("_", " ")}, {unit[1]}'


def text(value: Any) -> str:
    """Return a figure with the digits that people read."""
    if value is None:
        return 'unknown'
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    if isinstance(value, list):
        return ', '.join(map(str, value))
    if not isinstance(value, float):
        return str(value)
    return f'{value:.4g}' if abs(value) >= 1e-3 else f'{round(value, 5) + 0.0:g}'
