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

from flock_follower.tools.judge import FigureBound, judge
from flock_follower.tools.report import aligned, announce, table, WIDTH, write_report

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
        'FAILED: nowhere is not known: what it needs, as the truth or an image, is not there',
        'the logs of every process are in logs']
    assert announce(SUMMARY, judgements[:1], [], Path('logs')) == 0
    assert capsys.readouterr().err == ''


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
    assert '<td>vio_at_20_s.hold_after_s</td><td>0.21</td>' in page
