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


"""The command that redraws the paper's figures: simulations, and flights that `fly` recorded."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text
import numpy as np
import pytest

from flock_desk import figures
from flock_desk.closed_loop.controllers import CONTROLLERS
from flock_desk.runs import paper_plots
from flock_desk.runs.paper_plots import styled, WIDTH
from flock_desk.runs.record import last_flight, scenario_flown, set_aside
from flock_follower.bags.bag import open_bag
from flock_follower.bags.message_types import empty
from flock_follower.bags.writer import BagWriter
from flock_follower.messages import ODOMETRY, odometry

pytestmark = pytest.mark.slow
DRAWN = ('leaderless_trajectories', 'leaderless_speeds', 'leaderless_distances',
         'leaderless_lyapunov', 'leader_trajectories', 'leader_speeds', 'leader_distances')
SECONDS, RATE, START = 6, 20, 10**18  # of the images
DRIFT = np.array([0.1, -0.2, 0.0])  # of odom, m
NO_IMAGE, NO_ESTIMATE = (2.0, 2.8), (4.0, 4.4)  # from and to, s
SEEN_FARTHER = 0.05  # m


@pytest.fixture(scope='module')
def redrawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Figure]]:
    """Return the folder of the simulations' figures, and the figures, with two larger flocks."""
    out, kept = tmp_path_factory.mktemp('redrawn') / 'figures', {}
    save = paper_plots.save

    def keep(figure: Figure, path: Path) -> str:
        kept[path.name] = figure
        return save(figure, path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_plots, 'save', keep)
        assert figures.main(['--out', str(out), '--flights', str(out / 'none'),
                             '--campaign', str(out / 'none.json')]) == 0
        for dim in '23':
            assert figures.main(['--out', str(out / 'flocks'), '--agents', '9', '--dim', dim,
                                 '--duration', '1']) == 0
    return out, kept


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def assert_legible(figure: Figure, name: str) -> None:
    """Every text is on its page, large enough, and no title."""
    with styled():
        figure.draw_without_rendering()
    assert figure.get_size_inches()[0] == WIDTH and not figure.get_suptitle(), name
    texts = [t for t in figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
    assert min(t.get_fontsize() for t in texts) >= 7.0, name
    labels = [text for legend in figure.findobj(Legend) for text in legend.get_texts()]
    labels += [side.label for side in figure.findobj(Axis) if side.label.get_text()]
    for text in [*figure.texts, *labels, *(axis.title for axis in figure.axes)]:
        box = text.get_window_extent()
        assert box.x0 >= 0.0 and box.x1 <= figure.bbox.x1, (name, text.get_text())
        assert box.y0 >= 0.0 and box.y1 <= figure.bbox.y1, (name, text.get_text())


def test_every_figure_is_written_in_every_kind_and_legible(
        redrawn: tuple[Path, dict[str, Figure]]) -> None:
    out, kept = redrawn
    assert {p.name for p in out.iterdir() if p.is_file()} == {
        'results.csv', *(f'{name}.{kind}' for name in DRAWN for kind in ('png', 'svg', 'pdf'))}
    for name in DRAWN:
        assert (out / f'{name}.png').read_bytes().startswith(b'\x89PNG')
        assert '</svg>' in (out / f'{name}.svg').read_text(encoding='utf-8')
        page = (out / f'{name}.pdf').read_bytes()
        assert page.startswith(b'%PDF') and b'/MediaBox [ 0 0 239.76 ' in page  # 3.33 in
    assert len(kept) == len(DRAWN) + 2
    for name, figure in kept.items():
        assert_legible(figure, name)


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


def test_one_larger_flock_is_drawn_with_its_metrics(tmp_path: Path) -> None:
    assert figures.main(['--out', str(tmp_path), '--duration', '1', '--agents', '8']) == 0
    assert {p.name for p in tmp_path.iterdir()} == {
        f'flock_8_2d_seed1.{kind}' for kind in ('png', 'svg', 'pdf', 'csv')}
    assert len(read(tmp_path / 'flock_8_2d_seed1.csv')) > 20


def write_flight(folder: Path, scenario: str = 'indoor') -> None:
    """Write what `fly` leaves of a flight in which the leader goes ahead, 2 to 2.3 m away."""
    folder.mkdir(parents=True)
    times = np.arange(SECONDS * RATE) / RATE
    stamps = START + np.round(times * 1e9).astype(np.int64)
    follower = np.stack([0.3 * times, 0.1 * np.sin(times), np.full(len(times), 1.5)], axis=1)
    leader = follower + np.outer(2.0 + 0.05 * times, [1.0, 0.0, 0.0])
    velocity, level = np.full_like(leader, 0.3), np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    seen = (times < NO_IMAGE[0]) | (times >= NO_IMAGE[1])
    known = seen & ((times < NO_ESTIMATE[0]) | (times >= NO_ESTIMATE[1]))
    now = 100.0 + times
    columns = {
        'image_stamp': stamps[seen], 'image_usable': known[seen],
        **{f'{who}_{what}': values[seen] for who, place in (('follower', follower),
                                                            ('leader', leader))
           for what, values in (('position', place), ('quaternion', level),
                                ('velocity', velocity))},
        'odom_stamp': stamps, 'odom_position': follower + DRIFT, 'odom_quaternion': level,
        'odom_velocity': velocity, 'distance_time': now,
        'distance': np.linalg.norm(leader - follower, axis=1), 'state_time': now,
        'position': follower, 'velocity': velocity, 'acceleration': 0.0 * velocity,
        'mode': np.full(len(now), 'OFFBOARD'), 'setpoint_time': now,
        'setpoint_acceleration': 0.0 * velocity, 'planner_time': now[:1],
        'planner_state': np.array(['TRACK'])}
    np.savez(folder / 'flight.npz', **columns, epoch_ns=START, start=100.0, began=100.0,
             ended=100.0 + SECONDS, skipped_images=0, pose_source='', pose_source_of_leader='',
             clock=np.empty((0, 2)))
    with BagWriter(folder / 'record') as bag:
        for stamp, place in zip(stamps[known].tolist(), leader[known]):
            place = place + DRIFT + [SEEN_FARTHER, 0.0, 0.0]
            bag.write('neighbors', ODOMETRY, stamp, odometry(
                empty, stamp, 'odom', 'leader', place, [0.0, 0.0, 0.0, 1.0], [0.3, 0.0, 0.0],
                [0.0, 0.0, 0.0], 1e-4 * np.eye(6), 1e-4 * np.eye(6)))
    (folder / 'summary.json').write_text(json.dumps({'scenario': scenario}))


@pytest.fixture(scope='module')
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of `fly`: outdoor was flown last, indoor before."""
    folder = tmp_path_factory.mktemp('build') / 'fly'
    write_flight(folder, 'outdoor')
    write_flight(folder / 'earlier' / 'indoor', 'indoor')
    return folder


def test_flights_are_drawn_twice_the_same_or_how_to_fly_them_is_said(
        flights: Path, tmp_path: Path) -> None:
    only = flights / 'earlier' / 'indoor'
    for folder in (tmp_path / 'once', tmp_path / 'again'):
        folder.mkdir()
        written, notes, faults = figures.redraw_flights(folder, only)
        assert not faults
    assert written == [f'indoor_{name}.png/.svg/.pdf' for name in ('positions', 'distance')]
    assert notes == [
        f'indoor: 6 s in {only}, 2.00 to 2.30 m apart, 100.0 % of the time in the band',
        f'outdoor: not drawn, there is no flight of it in {only}: make fly SCENARIO=outdoor']
    files = sorted((tmp_path / 'once').iterdir())
    assert len(files) == 6
    for path in files:
        assert path.read_bytes() == (tmp_path / 'again' / path.name).read_bytes()
    page = (tmp_path / 'once' / 'indoor_distance.pdf').read_bytes()
    assert b'/FontFile2' in page and b'/Type3' not in page  # as publishers want them


def test_controllers_are_compared_at_each_v_max_by_the_scenarios_that_all_flew(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert figures.redraw_controllers(tmp_path, path) == (['controllers'], [])
    slow, fast = drawn[0].axes
    assert [line.get_xydata().tolist() for line in slow.lines] == [[[1.5, 50.0]]] * 5
    assert fast.get_title(loc='left') == '$v_{max}$ = 2 m/s'
    assert set(CONTROLLERS) == set(figures.CONTROLLERS)
    missing = tmp_path / 'missing.json'
    assert figures.redraw_controllers(tmp_path, missing) == (
        [], [f'controllers: not drawn, {missing} does not have them: make flights'])


def test_a_flight_that_cannot_be_read_is_an_error_after_all_else(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(figures, 'redraw', lambda out: [])
    for name, damage in (('indoor', b'no zip'), ('outdoor', b'')):
        folder = tmp_path / 'fly' / 'earlier' / name
        folder.mkdir(parents=True)
        (folder / 'summary.json').write_text(json.dumps({'scenario': name}))
        (folder / 'flight.npz').write_bytes(damage)
    assert figures.main(['--out', str(tmp_path / 'out'), '--flights', str(tmp_path / 'fly')]) == 1
    for name, error in zip(('indoor', 'outdoor'), capsys.readouterr().err.splitlines(),
                           strict=True):
        file = tmp_path / 'fly' / 'earlier' / name / 'flight.npz'
        assert error.startswith(f'error: {name}: not drawn: {file}: cannot be read: ')


def test_the_last_flight_of_every_scenario_is_kept(tmp_path: Path) -> None:
    for scenario in ('indoor', 'outdoor', 'indoor'):
        set_aside(tmp_path / 'fly')
        assert scenario_flown(tmp_path / 'fly') == ''
        write_flight(tmp_path / 'new', scenario)
        (tmp_path / 'fly').mkdir(exist_ok=True)
        for path in (tmp_path / 'new').iterdir():
            path.replace(tmp_path / 'fly' / path.name)
        (tmp_path / 'new').rmdir()
        assert last_flight(tmp_path / 'fly', scenario) == tmp_path / 'fly'
    earlier = tmp_path / 'fly' / 'earlier'
    assert last_flight(tmp_path / 'fly', 'outdoor') == earlier / 'outdoor'
    assert last_flight(tmp_path / 'fly', 'hover') is None
    # Both are complete where they have been moved; the second of indoor replaces the first.
    (earlier / 'indoor' / 'report.html').write_text('of the first')
    set_aside(tmp_path / 'fly')
    assert sorted(path.name for path in (earlier / 'indoor').iterdir()) == [
        'flight.npz', 'record', 'summary.json']
    with open_bag(earlier / 'indoor' / 'record') as bag:
        assert bag.message_count > 50


@pytest.mark.parametrize('summary', ['', '[]', '{"scenario": null}', '{"scenario": "../x"}'])
def test_files_that_fly_has_not_written_stay_where_they_are(tmp_path: Path, summary: str) -> None:
    (tmp_path / 'fly').mkdir()
    (tmp_path / 'fly' / 'summary.json').write_text(summary)
    set_aside(tmp_path / 'fly')
    assert [path.name for path in (tmp_path / 'fly').iterdir()] == ['summary.json']
    assert [path.name for path in tmp_path.iterdir()] == ['fly']
