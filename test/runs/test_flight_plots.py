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

"""The paper's figures of flights, drawn from what `fly` leaves; and where it leaves it."""

import json
from pathlib import Path

from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text
import numpy as np
import pytest

from flock_desk import figures
from flock_desk.runs.figure_style import styled, WIDTH
from flock_desk.runs.flight_folder import last_flight, scenario_flown, set_aside
from flock_desk.runs.flight_plots import distance, positions
from flock_desk.runs.fly_record import read
from flock_desk.scenarios.scenario_file import load
from flock_follower.bags.bag import open_bag
from flock_follower.bags.message_types import empty
from flock_follower.bags.writer import BagWriter
from flock_follower.messages import ODOMETRY, odometry

SECONDS, RATE, START = 6, 20, 10**18  # of the images
DRIFT = np.array([0.1, -0.2, 0.0])  # of odom, m
NO_IMAGE, NO_ESTIMATE = (2.0, 2.8), (4.0, 4.4)  # from and to, s
SEEN_FARTHER = 0.05  # m


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
def flights(tmp_path_factory):
    """Return a folder of `fly`: outdoor was flown last, indoor before."""
    folder = tmp_path_factory.mktemp('build') / 'fly'
    write_flight(folder, 'outdoor')
    write_flight(folder / 'earlier' / 'indoor', 'indoor')
    return folder


@pytest.fixture(scope='module')
def flight(flights):
    return read(load('outdoor'), flights)


def line(axis, colour, *, truth):
    """Return a line's data; that of the truth is the broad one."""
    found = [line.get_xydata() for line in axis.lines if to_hex(line.get_color()) == colour.lower()
             and (line.get_linewidth() > 3.0) == truth and len(line.get_xydata()) > 2]
    assert len(found) == 1
    return found[0].T


@pytest.mark.parametrize(('who', 'colour', 'x'), [
    ('leader', '#0072B2', lambda t: 2.0 + 0.35 * t), ('follower', '#D55E00', lambda t: 0.3 * t)])
def test_positions_are_those_the_follower_knew_above_the_true_ones(flight, who, colour, x):
    above, below = positions(flight).axes
    t, known = line(above, colour, truth=False)
    error = DRIFT[0] + (SEEN_FARTHER if who == 'leader' else 0.0)
    shown = np.isfinite(known)
    assert known[shown] == pytest.approx(x(t[shown]) + error, abs=1e-6)
    t, true = line(above, colour, truth=True)
    shown = np.isfinite(true)
    assert true[shown] == pytest.approx(x(t[shown]), abs=1e-6)
    t, y = line(below, colour, truth=True)
    assert y[np.isfinite(y)] == pytest.approx(0.1 * np.sin(t[np.isfinite(y)]), abs=1e-6)
    # No line across what nobody saw.
    assert np.isnan(true).any()
    assert not np.any((t > NO_IMAGE[0] + 1e-6) & (t < NO_IMAGE[1] - 1e-6) & np.isfinite(true))


def test_the_distance_is_drawn_in_its_band_and_where_the_leader_was_hidden(flight):
    axis, = distance(flight).axes
    t, known = line(axis, '#0072B2', truth=False)
    shown = np.isfinite(known)
    assert known[shown] == pytest.approx(2.0 + SEEN_FARTHER + 0.05 * t[shown], abs=1e-6)
    assert not np.any((t >= NO_ESTIMATE[0]) & (t < NO_ESTIMATE[1]) & shown)
    t, true = line(axis, '#333333', truth=True)
    assert np.isfinite(true[(t >= NO_ESTIMATE[0]) & (t < NO_ESTIMATE[1])]).all()
    edges = sorted({line.get_ydata()[0] for line in axis.lines if line.get_linestyle() == '--'})
    assert edges == pytest.approx([1.0, np.sqrt(8.0)])
    assert axis.get_ylim()[0] == 0.0 and axis.get_ylim()[1] > edges[1]
    hidden = [patch.get_extents().transformed(axis.transData.inverted()) for patch in axis.patches]
    assert [(box.x0, box.x1) for box in hidden] == [pytest.approx(NO_ESTIMATE)]


@pytest.mark.parametrize('draw', [positions, distance])
def test_a_figure_fits_a_column_has_no_title_and_is_legible(flight, draw):
    figure: Figure = draw(flight)
    assert figure.get_size_inches()[0] == WIDTH and 3.3 <= WIDTH <= 3.5
    assert not figure.get_suptitle() and not any(axis.get_title() for axis in figure.axes)
    with styled():
        figure.draw_without_rendering()
    texts = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
    assert len(texts) > 8 and min(text.get_fontsize() for text in texts) >= 7.0
    page = figure.bbox
    for text in texts:
        box = text.get_window_extent()
        assert page.x0 <= box.x0 and box.x1 <= page.x1, text.get_text()
        assert page.y0 <= box.y0 and box.y1 <= page.y1, text.get_text()


@pytest.mark.slow
def test_both_flights_are_drawn_in_every_kind_and_twice_the_same(flights, tmp_path):
    for folder in (tmp_path / 'once', tmp_path / 'again'):
        folder.mkdir()
        written, told, faults = figures.redraw_flights(folder, flights)
        assert not faults
    assert written == [f'{name}.png/.svg/.pdf' for name in (
        'indoor_positions', 'indoor_distance', 'outdoor_positions', 'outdoor_distance')]
    assert told == [
        f'{name}: 6 s in {folder}, 2.00 to 2.30 m apart, 100.0 % of the time in the band'
        for name, folder in (('indoor', flights / 'earlier' / 'indoor'), ('outdoor', flights))]
    files = sorted(path.name for path in (tmp_path / 'once').iterdir())
    assert len(files) == 12
    for name in files:
        data = (tmp_path / 'once' / name).read_bytes()
        assert data == (tmp_path / 'again' / name).read_bytes()
        assert data.startswith({'png': b'\x89PNG', 'svg': b'<?xml', 'pdf': b'%PDF'}[name[-3:]])
    page = (tmp_path / 'once' / 'indoor_distance.pdf').read_bytes()
    assert f'/MediaBox [ 0 0 {72.0 * WIDTH:.2f} '.encode() in page
    assert b'/FontFile2' in page and b'/Type3' not in page  # as publishers want them


def test_what_nobody_has_flown_is_told_with_how_to_and_no_failure(flights, tmp_path, monkeypatch,
                                                                 capsys):
    monkeypatch.setattr(figures, 'redraw', lambda out: [])
    only = flights / 'earlier' / 'indoor'
    assert figures.main(['--out', str(tmp_path), '--flights', str(only)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith(f'indoor: 6 s in {only}') and 'elsewhere' not in lines[1]
    assert lines[2] == (f'outdoor: not drawn, there is no flight of it in {only}: '
                        'make fly SCENARIO=outdoor')
    assert lines[3] == (f'written to {tmp_path}: indoor_positions.png/.svg/.pdf, '
                        'indoor_distance.png/.svg/.pdf')


def test_a_flight_that_cannot_be_read_is_an_error_after_all_else(flights, tmp_path, monkeypatch,
                                                                 capsys):
    monkeypatch.setattr(figures, 'redraw', lambda out: [])
    for name, damage in (('indoor', b'no zip'), ('outdoor', b'')):
        folder = tmp_path / 'fly' / 'earlier' / name
        folder.mkdir(parents=True)
        (folder / 'summary.json').write_text(json.dumps({'scenario': name}))
        (folder / 'flight.npz').write_bytes(damage)
    assert figures.main(['--out', str(tmp_path / 'out'), '--flights', str(tmp_path / 'fly')]) == 1
    out, errors = capsys.readouterr()
    assert out == f'\nwritten to {tmp_path / "out"}: \n'
    for name, error in zip(('indoor', 'outdoor'), errors.splitlines(), strict=True):
        file = tmp_path / 'fly' / 'earlier' / name / 'flight.npz'
        assert error.startswith(f'error: {name}: not drawn: {file}: cannot be read: ')


def test_the_last_flight_of_every_scenario_is_kept(tmp_path):
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
    # Both are whole where they have been moved; the second of indoor replaces the first.
    (earlier / 'indoor' / 'report.html').write_text('of the first')
    set_aside(tmp_path / 'fly')
    assert sorted(path.name for path in (earlier / 'indoor').iterdir()) == [
        'flight.npz', 'record', 'summary.json']
    with open_bag(earlier / 'indoor' / 'record') as bag:
        assert bag.message_count > 50
    assert last_flight(tmp_path / 'fly', 'indoor') == earlier / 'indoor'


@pytest.mark.parametrize('summary', ['', '[]', '{}', '{"scenario": null}', '{"scenario": "../x"}'])
def test_what_fly_has_not_written_stays_where_it_is(tmp_path, summary):
    (tmp_path / 'fly').mkdir()
    (tmp_path / 'fly' / 'summary.json').write_text(summary)
    set_aside(tmp_path / 'fly')
    assert [path.name for path in (tmp_path / 'fly').iterdir()] == ['summary.json']
    assert [path.name for path in tmp_path.iterdir()] == ['fly']
