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


"""Bounds on figures, and what is shown of them: the console's table and the page."""

from __future__ import annotations

import math
from pathlib import Path
import re
from types import SimpleNamespace
from typing import Any

from matplotlib.figure import Figure
import numpy as np
import pytest

from flock_desk.runs.console import guarded, logs_in, progress
from flock_desk.runs.figure_table import bounds, FIGURES, parts_of, words
from flock_desk.runs.judge import check_names, FigureBound, judge, load_bounds, parse_bounds
from flock_desk.runs.plots import draw_above, MAX_PAIRS
from flock_desk.runs.processes import TooBusyError
from flock_desk.runs.report import announce, LINE_WIDTH, report, table, text, write_report
from flock_follower.checks.processor import Load

SUMMARY: dict[str, Any] = {
    'frames': 360, 'recall': 0.97, 'nees_position': None, 'bag': 'sample',
    'distance_m': {'min': 1.3, 'max': 2.5}, 'rejections': {'outside the gate': 4},
    'setpoints': {'sent': 236, 'rate_hz': 20.0},
    'outages': {'vio_at_20_s': {'hold_after_s': 0.21, 'reason': 'odometry comes late'}},
    'planner': {'missed_ticks': 0, 'warning': 'leader too fast: ' + 99 * '!'}}
BOUNDS = (FigureBound('recall', least=0.98), FigureBound('setpoints.rate_hz', 19.5, 20.5),
          FigureBound('planner.missed_ticks', most=3), FigureBound('nees_position', 1.0, 6.0))


def faults(document: Any) -> list[str]:
    found = parse_bounds(document)
    check_names(found, SUMMARY)
    return [judgment.fault for judgment in judge(found, SUMMARY) if judgment.fault]


def test_bounds_hold_at_both_ends_and_each_broken_one_is_named() -> None:
    assert faults({'recall': {'min': 0.97, 'max': 0.97}, 'frames': {'min': 1},
                   'distance_m.max': {'max': 2.83}}) == []
    assert faults({'recall': {'min': 0.98}, 'distance_m.min': {'max': 1.0},
                   'rejections.outside the gate': {'max': 3}}) == [
        'recall = 0.97: must be at least 0.98', 'distance_m.min = 1.3: must be at most 1',
        'rejections.outside the gate = 4: must be at most 3']
    # What is not known fails, what was never counted is zero.
    assert faults({'nees_position': {'max': 6.0}, 'rejections.invalid image': {'max': 0}}) == [
        'nees_position is not known: it was not measured, or is not finite']
    for figure in (float('nan'), float('inf'), -float('inf')):
        for bound in (FigureBound('x', least=1.0), FigureBound('x', most=1.0)):
            assert judge([bound], {'x': figure})[0].fault == f'x = {figure:g}: must be finite'


@pytest.mark.parametrize(('document', 'message'), [
    ({'recal': {'min': 1}}, 'recal is no figure of the summary: must be one of recall'),
    ({'bag': {'min': 1}}, 'bag is no figure'), ({'distance_m': {'min': 1}}, 'distance_m is no'),
    ({'recall': 0.9}, 'recall = 0.9: must have min, max or both, finite numbers'),
    ({'recall': {'least': 0.9}}, 'must have min'), ({'recall': {}}, 'must have min'),
    ({'recall': {'min': 'high'}}, 'finite numbers'), ({'recall': {'min': True}}, 'finite numbers'),
    ({'recall': {'min': float('nan')}}, 'finite numbers'),
    ([], 'must map figures'), (None, 'must map figures')])
def test_a_wrong_bound_is_named(document: Any, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        faults(document)


def test_a_wrong_file_of_bounds_is_named(tmp_path: Path) -> None:
    path = tmp_path / 'bounds.yaml'
    for content in ('recall: {min: 0.9', 'recall: 1'):
        path.write_text(content)
        with pytest.raises(ValueError, match=f'^{path}: '):
            load_bounds(path)


@pytest.mark.parametrize(('figure', 'load', 'verdict'), [
    (150.0, 0.0, 'ok'), (250.0, math.inf, 'not judged'), (250.0, 60.0, 'not judged'),
    (250.0, 40.0, 'FAILED'), (250.0, 0.0, 'FAILED'), (None, 0.0, 'not judged')])
def test_a_busy_machine_excuses_what_load_can_do_and_no_more(
        figure: float | None, load: float, verdict: str) -> None:
    bound = FigureBound('x', most=200.0, load=load)
    assert judge([bound], {'x': figure}, busy=True)[0].verdict == verdict
    assert judge([bound], {'x': figure})[0].verdict == (
        'ok' if figure is not None and figure <= 200.0 else 'FAILED')


def test_verdict_of_busy_machine_is_code_and_last_line(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load, summary = Load(0.4, 1.2, 2), {'late': 300.0, 'far': 9.0}
    late, far = FigureBound('late', most=200.0, load=math.inf), FigureBound('far', most=2.0)
    judgments = report(tmp_path, 'title', '', summary, [late], (), load=load)
    assert announce(summary, judgments, [], tmp_path, load) == 3
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith('too busy: for 40% of the worst 2 s') and last.endswith(
        'not judged: late')
    page = (tmp_path / 'report.html').read_text()
    assert 'Too busy: for 40% of the worst 2 s' in page and '>not judged</td>' in page
    # A fault that no load explains is the verdict.
    judgments = report(tmp_path, 'title', '', summary, [late, far], (), load=load)
    assert announce(summary, judgments, [], tmp_path, load) == 1
    assert 'FAILED: far' in capsys.readouterr().err
    judgments = report(tmp_path, 'title', '', summary, [late], (), load=Load(0.01, 0.1, 2))
    assert announce(summary, judgments, [], tmp_path, None) == 1


def test_each_command_has_the_bounds_of_the_table() -> None:
    limits = {'near': 0.9, 'far': 2.83, 'a_max': 2.5, 'speed': 0.55, 'planned': 59.9}
    fly, external = bounds('fly', limits), bounds('external', limits)
    assert fly['true_distance_m.max'] == (
        'true_distance_m.max', None, 2.83, math.inf)
    assert fly['speed_max_m_s'].load == 2.5 and fly['failed_processes'].load == 0.0
    assert 'true_distance_m.max' not in external and 'external.pace' not in fly
    assert external['duration_s'].least == 59.9 and external['time_in_band_share'].least == 0.99
    assert all(key in FIGURES for key in {**fly, **external, **bounds('demo', limits)})


def test_bounds_stand_beside_their_figures_in_a_hundred_columns(
        capsys: pytest.CaptureFixture[str]) -> None:
    lines = table(SUMMARY, judge(BOUNDS, SUMMARY))
    assert max(map(len, lines)) <= LINE_WIDTH
    assert [line.split() for line in lines[:3]] == [
        ['frames', '360'], ['recall', '0.97', '≥', '0.98', 'FAILED'],
        ['nees_position', 'unknown', '≥', '1,', '≤', '6', 'FAILED']]
    shown = '\n'.join(lines)
    assert 'bag' not in shown and 'odometry comes late' in shown  # the bag is no figure
    assert re.search(r'planner.missed_ticks +0 +≤ 3 +ok', shown)
    judgments = judge([FigureBound('setpoints.reasons.no command', most=2),
                       FigureBound('nowhere', most=2)], SUMMARY)
    assert announce(SUMMARY, judgments, [Path('out/report.html')], Path('logs')) == 1
    out, errors = capsys.readouterr()
    assert 'setpoints.reasons.no command' in out and 'nowhere' in out
    assert out.splitlines()[-1] == 'report: out/report.html'
    assert errors.splitlines() == [
        'FAILED: nowhere is not known: it was not measured, or is not finite',
        'the logs of every process are in logs']
    assert announce(SUMMARY, judgments[:1], [], Path('logs')) == 0


def test_page_names_figures_with_keys_and_warnings_first(
        tmp_path: Path) -> None:
    write_report(tmp_path / 'report.html', 'A & B', '<p>', SUMMARY, judge(BOUNDS, SUMMARY),
                 warnings=['too fast & furious'])
    page = (tmp_path / 'report.html').read_text()
    assert '<p class="warning">Too fast &amp; furious.</p><h2>Bounds</h2>' in page
    assert '<h1>A &amp; B</h1><p>&lt;p&gt;</p>' in page and page.count('>FAILED<') == 2
    assert ('<tr title="outages.vio_at_20_s.hold_after_s"><td>vio at 20 s: it held after, s</td>'
            '<td>0.21</td>') in page


@pytest.mark.parametrize(('error', 'code', 'line'), [
    (ValueError('a\nb'), 2, 'error: a b'), (RuntimeError('c'), 2, 'error: c; see logs'),
    (OSError(28, 'No space', 'x.json'), 2, 'error: x.json: No space; see logs'),
    (TooBusyError('d'), 3, 'too busy: d'), (KeyboardInterrupt(), 130, 'interrupted')])
def test_a_command_ends_in_one_line_and_its_exit_code(
        error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> int:
        raise error
    assert guarded(command, refused=2, hint=lambda: '; see logs') == code
    assert capsys.readouterr().err.strip() == line


def test_progress_is_shown_in_a_pipe_too(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(2) as bar:
        for name in ('first', 'second'):
            bar.set_description_str(name)
            bar.update()
    assert 'second: 100 %' in capsys.readouterr().err


@pytest.mark.parametrize(('value', 'shown'), [
    (None, 'unknown'), (True, 'yes'), (12, '12'), (0.0, '0'), (-1.9e-6, '0'),
    (8.694e-4, '0.00087'), (0.037821, '0.03782'), (1330.04, '1330'), (['a', 'b'], 'a, b')])
def test_figures_have_as_many_digits_as_people_read(value: Any, shown: str) -> None:
    assert text(value) == shown


def test_a_figure_that_is_not_in_the_table_is_named_by_its_key() -> None:
    assert words('some_group.new_thing') == 'new thing' and words('latency_ms.p50') == 'median'


def test_a_dot_of_a_number_divides_no_key(tmp_path: Path) -> None:
    assert parts_of('holds.at_1.0_s') == ['holds', 'at_1.0_s']
    assert parts_of('stages.nees_x') == ['stages', 'nees_x'] and parts_of('recall') == ['recall']
    write_report(tmp_path / 'r.html', 'one', '', {
        'holds': {'at_1.0_s': '0.5 s: none'}, 'check': {'errors': [], 'warnings': []}}, [])
    page = (tmp_path / 'r.html').read_text()
    assert '<td>at 1.0 s</td><td>0.5 s: none</td>' in page
    assert all(f'<td>{name}</td><td>none</td>' in page for name in ('errors', 'warnings'))
    assert '@media (max-width: 700px)' in page


def test_logs_are_named_only_if_there_are_some(tmp_path: Path) -> None:
    assert logs_in(tmp_path) == logs_in(tmp_path / 'none') == ''
    (tmp_path / 'bridge.log').touch()
    assert str(tmp_path) in logs_in(tmp_path)


def test_stamps_of_another_clock_cost_no_lines_in_a_map() -> None:
    axis = Figure().subplots()
    draw_above(axis, SimpleNamespace(  # type: ignore[arg-type]
        table={'time': np.array([0.0, 1.0, 20_000.0])}, duration=12.0,
        paths={name: np.zeros((3, 3)) for name in ('leader', 'follower')}))
    assert len(axis.lines) <= MAX_PAIRS + 6
