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

"""The command that redraws the paper's figures: its simulations."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.quiver import Quiver
from matplotlib.text import Text
import numpy as np
import pytest

from flock_desk import figures
from flock_desk.runs.figure_style import styled, WIDTH
from flock_desk.runs.progress import Progress

pytestmark = pytest.mark.slow
DRAWN = ('leaderless_trajectories', 'leaderless_speeds', 'leaderless_distances',
         'leaderless_lyapunov', 'leader_trajectories', 'leader_speeds', 'leader_distances')


@pytest.fixture(scope='module')
def redrawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp('redrawn')
    assert figures.main(['--out', str(out / 'figures'), '--flights', str(out / 'none')]) == 0
    return out / 'figures'


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def test_every_figure_is_written_in_every_kind(redrawn: Path) -> None:
    assert {p.name for p in redrawn.iterdir()} == {
        'results.csv', *(f'{name}.{kind}' for name in DRAWN for kind in ('png', 'svg', 'pdf'))}
    for name in DRAWN:
        assert (redrawn / f'{name}.png').read_bytes().startswith(b'\x89PNG')
        assert (redrawn / f'{name}.png').stat().st_size > 20_000
        assert '</svg>' in (redrawn / f'{name}.svg').read_text(encoding='utf-8')
        page = (redrawn / f'{name}.pdf').read_bytes()
        assert page.startswith(b'%PDF') and b'/MediaBox [ 0 0 239.76 ' in page  # 3.33 in


def test_only_the_law_keeps_the_band_in_both_scenarios(redrawn: Path) -> None:
    rows = read(redrawn / 'results.csv')
    assert len(rows) == 10
    assert [(r['scenario'], r['model']) for r in rows if r['band'] == 'kept'] == [
        ('leaderless', 'Flocking law'), ('leader-follower', 'Flocking law')]
    law = rows[0]
    assert (law['min r2 [m2]'], law['min r2 at [s]']) == ('1.326202', '0.173')
    assert (law['speed [m/s]'], law['heading [deg]']) == ('0.10751301', '-74.7472')
    assert (law['W start'], law['W end'], law['order']) == ('6.0436562', '4.8031331', '1.0000')
    assert [f'{float(r["to 1 % [s]"]):.2f}' for r in rows[:2]] == ['5.64', '1.98']  # for good


def test_two_runs_write_the_same_bytes(redrawn: Path, tmp_path: Path) -> None:
    assert figures.main(['--out', str(tmp_path), '--flights', str(tmp_path / 'none')]) == 0
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
                                                    for kind in ('png', 'svg', 'pdf', 'csv')}
    assert len(read(tmp_path / f'{name}.csv')) > least_rows


def test_every_text_is_on_its_page_and_legible(monkeypatch: pytest.MonkeyPatch,
                                               tmp_path: Path) -> None:
    drawn: dict[str, Figure] = {}

    def keep(figure: Figure, path: Path) -> str:
        drawn[path.name] = figure
        with styled():
            figure.draw_without_rendering()
        return ''
    monkeypatch.setattr('flock_desk.runs.figure_style.save', keep)
    figures.redraw(tmp_path)
    for dim in '23':
        figures.main(['--out', str(tmp_path), '--agents', '9', '--dim', dim, '--duration', '1'])
    assert len(drawn) == len(DRAWN) + 2
    for name, figure in drawn.items():
        assert figure.get_size_inches()[0] == WIDTH and not figure.get_suptitle(), name
        texts = [t for t in figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
        assert min(t.get_fontsize() for t in texts) >= 7.0, name
        told = [text for legend in figure.findobj(Legend) for text in legend.get_texts()]
        told += [side.label for side in figure.findobj(Axis) if side.label.get_text()]
        told += [axis.title for axis in figure.axes]
        for text in figure.texts + told:
            box = text.get_window_extent()
            assert box.x0 >= 0.0 and box.x1 <= figure.bbox.x1, (name, text.get_text())
            assert box.y0 >= 0.0 and box.y1 <= figure.bbox.y1, (name, text.get_text())


def test_arrows_at_the_start_are_seen_whole(monkeypatch: pytest.MonkeyPatch,
                                            tmp_path: Path) -> None:
    arrows: list[Any] = []

    def keep(figure: Figure, path: Path) -> str:
        figure.draw_without_rendering()
        arrows.extend((axis, *axis.findobj(Quiver)) for axis in figure.axes if axis.axison
                      if 'trajectories' in path.name)
        return ''
    monkeypatch.setattr('flock_desk.runs.figure_style.save', keep)
    figures.redraw(tmp_path)
    assert len(arrows) == 10
    for axis, quiver in arrows:
        inches = np.hypot(quiver.U, quiver.V) / quiver.scale
        assert np.all((inches >= 0.15) & (inches <= 0.45))
        tips = axis.transData.transform(quiver.XY) + axis.figure.dpi * np.stack(
            [quiver.U, quiver.V], axis=1) / quiver.scale
        assert np.all((tips > axis.bbox.min) & (tips < axis.bbox.max))


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


def run_two_jobs(stream: Any, monkeypatch: pytest.MonkeyPatch) -> str:
    clock = iter(range(0, 100, 2))  # s
    monkeypatch.setattr('time.monotonic', lambda: float(next(clock)))
    progress = Progress(2, stream)
    progress.start('first')
    for share in (0.2, 0.4, 0.6):
        progress.share(share)
    progress.start('second')
    progress.finish()
    return stream.getvalue()


def test_progress_is_a_bar_on_a_terminal_and_lines_elsewhere(
        monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_two_jobs(io.StringIO(), monkeypatch) == (
        '[1/2] first\n[1/2] first: 30 %\n[2/2] second\ndone\n')
    drawn = run_two_jobs(Terminal(), monkeypatch)
    assert '\r[######........................]  20 %  first' in drawn
    assert '100 %  done' in drawn and drawn.endswith('\n') and drawn.count('\n') == 1
