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


"""The command that redraws the paper's figures: simulations, and controllers compared."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text
import pytest

from flock_desk import figures
from flock_desk.closed_loop.controllers import CONTROLLERS
from flock_desk.runs import paper_plots
from flock_desk.runs.paper_plots import COLUMN_WIDTH, styled

pytestmark = pytest.mark.slow
DRAWN = ('leaderless_trajectories', 'leaderless_speeds', 'leaderless_distances',
         'leaderless_lyapunov', 'leader_trajectories', 'leader_speeds', 'leader_distances')
#: All are written by one function.
WRITTEN = 'leaderless_lyapunov'


@pytest.fixture(scope='module')
def redrawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Figure]]:
    """Return the folder of the simulations' figures, and the figures, with two larger flocks."""
    out, kept = tmp_path_factory.mktemp('redrawn') / 'figures', {}
    save = paper_plots.save

    def keep(figure: Figure, path: Path) -> str:
        kept[path.name] = figure
        return save(figure, path) if path.name == WRITTEN else path.name
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_plots, 'save', keep)
        campaign = out.parent / 'none_flown.json'
        campaign.write_text('{}')
        assert figures.main(['--output', str(out), '--campaign', str(campaign)]) == 0
        patch.setattr(figures, 'FLOCK_DURATION', 1.0)
        for dim in '23':
            assert figures.main(['--out', str(out / 'flocks'), '--agents', '9', '--dim', dim]) == 0
    return out, kept


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def assert_legible(figure: Figure, name: str) -> None:
    """Every text is on its page, large enough, and no title."""
    with styled():
        figure.draw_without_rendering()
    assert figure.get_size_inches()[0] == COLUMN_WIDTH and not figure.get_suptitle(), name
    texts = [t for t in figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
    assert min(t.get_fontsize() for t in texts) >= 7.0, name
    labels = [text for legend in figure.findobj(Legend) for text in legend.get_texts()]
    labels += [side.label for side in figure.findobj(Axis) if side.label.get_text()]
    for text in [*figure.texts, *labels, *(axis.title for axis in figure.axes)]:
        box = text.get_window_extent()
        assert box.x0 >= 0.0 and box.x1 <= figure.bbox.x1, (name, text.get_text())
        assert box.y0 >= 0.0 and box.y1 <= figure.bbox.y1, (name, text.get_text())


def test_every_figure_is_legible_one_is_written_in_every_kind(
        redrawn: tuple[Path, dict[str, Figure]]) -> None:
    out, kept = redrawn
    assert {p.name for p in out.iterdir() if p.is_file()} == {
        'results.csv', *(f'{WRITTEN}.{kind}' for kind in ('png', 'svg', 'pdf'))}
    assert (out / f'{WRITTEN}.png').read_bytes().startswith(b'\x89PNG')
    assert '</svg>' in (out / f'{WRITTEN}.svg').read_text(encoding='utf-8')
    page = (out / f'{WRITTEN}.pdf').read_bytes()
    assert page.startswith(b'%PDF') and b'/MediaBox [ 0 0 239.76 ' in page  # 3.33 in
    assert {*kept} > {*DRAWN} and len(kept) == len(DRAWN) + 2
    for name, figure in kept.items():
        assert_legible(figure, name)
    assert len(read(out / 'flocks' / 'flock_9_3d_seed1.csv')) > 15


def test_only_the_law_keeps_the_band_in_both_scenarios(
        redrawn: tuple[Path, dict[str, Figure]]) -> None:
    rows = read(redrawn[0] / 'results.csv')
    assert len(rows) == 10
    assert [(r['scenario'], r['model']) for r in rows if r['band'] == 'kept'] == [
        ('leaderless', 'Flocking law'), ('leader-follower', 'Flocking law')]
    law = rows[0]
    assert (law['min r2 [m2]'], law['min r2 at [s]']) == ('1.326202', '0.173')
    assert (law['speed [m/s]'], law['heading [deg]']) == ('0.10751301', '-74.7472')
    assert (law['W start'], law['W end'], law['order']) == ('6.0436562', '4.8031331', '1.0000')
    assert [f'{float(r["to 1 % [s]"]):.2f}' for r in rows[:2]] == ['5.64', '1.98']  # for good


def test_controllers_are_compared_by_scenarios_all_flew(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    def flown(v_max: float, jerk: float) -> dict[str, float]:
        return {'max_speed_m_s': 0.9 * v_max, 'max_speed_share': 0.9, 'in_band': 0.5,
                'horizontal_jerk_m_s3': jerk}
    path, drawn = tmp_path / 'flights.json', list[Figure]()
    path.write_text(json.dumps({
        'one': dict.fromkeys(figures.CONTROLLERS, flown(0.5, 1.0)), 'flock': {'law': {}},
        'two': dict.fromkeys(figures.CONTROLLERS, flown(0.5, 2.0)),
        'fast': dict.fromkeys(figures.CONTROLLERS, flown(2.0, 3.0))}))
    monkeypatch.setattr(paper_plots, 'save',
                        lambda figure, path: drawn.append(figure) or path.name)
    assert figures.redraw_controllers(tmp_path, path) == ['controllers']
    slow, fast = drawn[0].axes
    assert [line.get_xydata().tolist() for line in slow.lines] == [[[1.5, 50.0]]] * 5
    assert fast.get_title(loc='left') == '$v_{max}$ = 2 m/s'
    assert set(CONTROLLERS) == set(figures.CONTROLLERS)
    assert figures.redraw_controllers(tmp_path, tmp_path / 'missing.json') == []
    assert capsys.readouterr().out.endswith('does not have them: make flights\n')
