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

"""The command that redraws the paper's simulations."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import pytest

from flock_follower.tools import figures
from flock_follower.tools.progress import Progress

pytestmark = pytest.mark.slow
DRAWN = ('leaderless_trajectories', 'leaderless_speeds', 'leaderless_distances',
         'leaderless_lyapunov', 'leader_trajectories', 'leader_speeds', 'leader_distances')


@pytest.fixture(scope='module')
def redrawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp('redrawn')
    assert figures.main(['--out', str(out / 'figures')]) == 0
    return out / 'figures'


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def test_every_figure_is_written_twice(redrawn: Path) -> None:
    assert {p.name for p in redrawn.iterdir()} == {
        'results.csv', *(f'{name}.png' for name in DRAWN), *(f'{name}.svg' for name in DRAWN)}
    for name in DRAWN:
        assert (redrawn / f'{name}.png').read_bytes().startswith(b'\x89PNG')
        assert (redrawn / f'{name}.png').stat().st_size > 20_000
        assert '</svg>' in (redrawn / f'{name}.svg').read_text(encoding='utf-8')


def test_only_the_law_keeps_the_band_in_both_scenarios(redrawn: Path) -> None:
    rows = read(redrawn / 'results.csv')
    assert len(rows) == 10
    assert [(r['scenario'], r['model']) for r in rows if r['band'] == 'kept'] == [
        ('leaderless', 'Flocking law'), ('leader-follower', 'Flocking law')]
    law = rows[0]
    assert (law['min r2 [m2]'], law['min r2 at [s]']) == ('1.326202', '0.173')
    assert (law['speed [m/s]'], law['heading [deg]']) == ('0.10751301', '-74.7472')
    assert (law['W start'], law['W end'], law['order']) == ('6.0436562', '4.8031331', '1.0000')


def test_two_runs_write_the_same_bytes(redrawn: Path, tmp_path: Path) -> None:
    assert figures.main(['--out', str(tmp_path)]) == 0
    for path in redrawn.iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes(), path.name


@pytest.mark.parametrize(('arguments', 'name', 'least_rows'), [
    (['--agents', '12', '--dim', '3', '--seed', '4'], 'flock_flocking_graph_12_3d_seed4', 20),
    (['--agents', '8', '--neighbors', 'nearest'], 'flock_flocking_nearest_8_2d_seed1', 20),
    (['--agents', '8', '--model', 'vicsek'], 'flock_vicsek_all_8_2d_seed1', 10),
    (['--agents', '8', '--model', 'cucker_dong', '--band', 'paper'],
     'flock_cucker_dong_all_8_2d_seed1', 20)])
def test_one_larger_flock_is_drawn_with_its_metrics(tmp_path: Path, arguments: list[str],
                                                    name: str, least_rows: int) -> None:
    assert figures.main(['--out', str(tmp_path), '--duration', '1', *arguments]) == 0
    assert {p.name for p in tmp_path.iterdir()} == {f'{name}.{kind}'
                                                    for kind in ('png', 'svg', 'csv')}
    assert len(read(tmp_path / f'{name}.csv')) > least_rows


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--agents', '0'], 'error: count = 0: must be an integer in [1, inf)\n'),
    (['--agents', '9', '--neighbors', 'graph', '--model', 'vicsek'], "error: neighbors = 'graph'"),
    (['--agents', '9', '--neighbors', 'all'], 'error: agents 0 and '),
    (['--agents', '9', '--dt', '-1'], 'error: dt = -1.0: must be a number in (0, inf)')])
def test_bad_options_end_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                     arguments: list[str], message: str) -> None:
    assert figures.main(['--out', str(tmp_path), *arguments]) == 1
    error = capsys.readouterr().err.splitlines(keepends=True)[-1]
    assert error.startswith(message)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def run_two_jobs(stream: Any) -> str:
    progress = Progress(2, stream)
    progress.start('first')
    progress.share(0.5)
    progress.start('second')
    progress.finish()
    return stream.getvalue()


def test_progress_is_a_bar_on_a_terminal_and_lines_elsewhere() -> None:
    assert run_two_jobs(io.StringIO()) == '[1/2] first\n[2/2] second\n'
    drawn = run_two_jobs(Terminal())
    assert '\r[#######.......................]  25 %  first' in drawn
    assert '100 %  done' in drawn and drawn.endswith('\n') and drawn.count('\n') == 1
