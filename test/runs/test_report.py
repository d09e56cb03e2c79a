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

"""The table on the console: what it shows, how wide it gets, and what it returns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flock_desk.runs.console import aligned, guarded, Progress
from flock_desk.runs.judge import FigureBound, judge
from flock_desk.runs.processes import TooBusyError
from flock_desk.runs.report import announce, name, table, text, WIDTH, write_report

SUMMARY: dict[str, Any] = {
    'frames': 360, 'recall': 0.97, 'nees_position': None, 'bag': 'sample',
    'setpoints': {'sent': 236, 'rate_hz': 20.0},
    'outages': {'vio_at_20_s': {'hold_after_s': 0.21, 'reason': 'odometry comes late'}},
    'planner': {'missed_ticks': 0, 'warning': 'leader too fast: ' + 99 * '!'}}
BOUNDS = (FigureBound('recall', least=0.98), FigureBound('setpoints.rate_hz', 19.5, 20.5),
          FigureBound('planner.missed_ticks', most=3), FigureBound('nees_position', 1.0, 6.0))


def test_bounds_stand_beside_their_figures_in_a_hundred_columns() -> None:
    lines = table(SUMMARY, judge(BOUNDS, SUMMARY))
    assert max(map(len, lines)) <= WIDTH
    assert [line.split() for line in lines[:4]] == [
        ['frames', '360'], ['recall', '0.97', '≥', '0.98', 'FAILED'],
        ['nees_position', 'unknown', '≥', '1,', '≤', '6', 'FAILED'], ['setpoints.sent', '236']]
    assert '  planner.missed_ticks                    0  ≤ 3               ok' in lines
    assert not any('bag' in line for line in lines)  # is no figure worth a line
    assert any(line.endswith('odometry comes late') for line in lines)


def test_a_bound_on_what_is_not_in_the_summary_is_shown(
        capsys: pytest.CaptureFixture[str]) -> None:
    judgements = judge([FigureBound('setpoints.reasons.no command', most=2),
                        FigureBound('nowhere', most=2)], SUMMARY)
    assert announce(SUMMARY, judgements, [Path('out/report.html'), Path('out/report.png')],
                    Path('logs')) == 1
    out, errors = capsys.readouterr()
    assert 'setpoints.reasons.no command' in out and 'nowhere' in out
    assert out.splitlines()[-2:] == ['report: out/report.html', 'picture: out/report.png']
    assert errors.splitlines() == [
        'FAILED: nowhere is not known: it was not measured (no truth, no image, no /proc), or a '
        'value that it rests on is not finite',
        'the logs of every process are in logs']
    assert announce(SUMMARY, judgements[:1], [], Path('logs')) == 0
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize(('error', 'code', 'line'), [
    (ValueError('a\nb'), 2, 'error: a b'), (RuntimeError('c'), 2, 'error: c; see logs'),
    (OSError(28, 'No space', 'x.json'), 2, 'error: x.json: No space; see logs'),
    (TooBusyError('d'), 3, 'too busy: d'), (KeyboardInterrupt(), 130, 'interrupted')])
def test_a_command_ends_in_one_line_and_its_exit_code(
        error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> int:
        raise error
    assert guarded(command, refused=2, hint='; see logs') == code
    assert capsys.readouterr().err.strip() == line


def test_progress_is_shown_in_a_pipe_too(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(2) as progress:
        progress.start('first')
        for share in (0.2, 0.4, 0.6):
            progress.share(share)
        progress.start('second')
    shown = capsys.readouterr().err
    assert shown.startswith('\rbegin:   0 %') and 'second: 100 %' in shown
    assert len(shown.splitlines()) <= 3


def test_columns_are_aligned() -> None:
    assert aligned([['a', 'model', '1'], ['long', 'b', '22.5']]) == [
        'a     model     1', 'long  b      22.5']


def test_without_matplotlib_the_page_says_so(tmp_path: Path) -> None:
    def draw() -> list[Any]:
        raise ImportError

    write_report(tmp_path / 'report.html', 'A & B', '<p>', SUMMARY, judge(BOUNDS, SUMMARY), draw)
    page = (tmp_path / 'report.html').read_text()
    assert 'They need matplotlib, which is not installed.' in page
    assert '<h1>A &amp; B</h1><p>&lt;p&gt;</p>' in page and page.count('>FAILED<') == 2
    # In words, a group within indented; the key is told where the pointer rests.
    assert '<tr class="head"><td>vio at 20 s</td><td></td></tr>' in page
    assert ('<tr class=part title="outages.vio_at_20_s.hold_after_s">'
            '<td>it held after, s</td><td>0.21</td>') in page
    assert 'class="warning">' not in page


def test_what_has_to_be_known_first_stands_at_the_top(tmp_path: Path) -> None:
    write_report(tmp_path / 'report.html', 'A', 'b', SUMMARY, judge(BOUNDS, SUMMARY),
                 warnings=['too fast & furious'])
    page = (tmp_path / 'report.html').read_text()
    assert '<p class="warning">Too fast &amp; furious.</p><h2>Bounds</h2>' in page


def test_what_is_part_of_a_total_is_indented_below_it() -> None:
    cores = {'total': 1.25, 'simulator': 0.5, 'planner': 0.75}
    assert table({'cpu_cores': cores}, []) == [
        '  cpu_cores.total  1.25', '    simulator       0.5', '    planner        0.75']


def test_a_long_text_goes_on_below() -> None:
    lines = table({'holds': {'at_2.0_s': '1.0 s: ' + 30 * 'why ', 'at_9.0_s': '2.0 s: x'}}, [])
    assert len(lines) == 3 and max(map(len, lines)) <= WIDTH
    assert ' '.join(' '.join(lines[:2]).split()) == f'holds.at_2.0_s 1.0 s: {(30 * "why ")[:-1]}'


@pytest.mark.parametrize('key, words', [
    ('velocity_rms_m_s', 'error of the relative velocity, RMS of the vector, m/s'),
    ('rate_hz', 'rate, Hz'), ('time_in_band_share', 'share of time in the band'),
    ('some_new_thing_ms', 'some new thing, ms'), ('at_20.2_s', 'at 20.2 s'),
    ('no command', 'no command')])
def test_figures_are_named_in_words_with_their_units(key: str, words: str) -> None:
    assert name(key) == words


@pytest.mark.parametrize('value, shown', [
    (None, 'unknown'), (True, 'yes'), (12, '12'), (0.0, '0'), (-1.9e-6, '0'),
    (8.694e-4, '0.00087'),
    (0.037821, '0.03782'), (1330.04, '1330'), (['a', 'b'], 'a, b')])
def test_figures_have_as_many_digits_as_people_read(value: Any, shown: str) -> None:
    assert text(value) == shown
