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

"""Whole flights of flocks in lock step, in a few short runs each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from flights_command import flown_by_the_command
import numpy as np
import pytest

from flock_desk.closed_loop.campaign import fly
from flock_desk.closed_loop.metrics import measure, of_runs, STATES
from flock_desk.scenarios.flock import Flock, FollowerFailure
from flock_desk.scenarios.scenario import LeaderMotion, Outage, RangeErrors, Scenario
from flock_desk.scenarios.scenario_file import load
from flock_follower.planner.modes import State

pytestmark = pytest.mark.slow
HOVER = Scenario('short', 'a short one', duration=6.0, leader=LeaderMotion('legs'),
                 flock=Flock(3))


def test_a_run_is_the_same_alone_and_among_others() -> None:
    scenario = replace(load('flock_wedge'), duration=5.0)
    together, alone = fly(scenario, range(3), True), fly(scenario, range(1, 2), True)
    for name in ('follower', 'velocity', 'command', 'state', 'edges', 'shown'):
        assert np.array_equal(getattr(together, name)[4:8], getattr(alone, name), equal_nan=True)
    assert np.array_equal(together.positions[1], alone.positions[0])
    assert not np.array_equal(together.follower[0], together.follower[4])


def test_in_a_line_a_front_camera_shows_the_next_one_and_nobody_beyond() -> None:
    flights = fly(HOVER, range(2), True)
    assert flights.shown.max() == 1
    assert flights.in_sight.all()
    flying = flights.state[:, flights.times > 2.0]
    assert np.all(flying == STATES.index(State.TRACK))


def test_the_odometry_of_each_begins_where_it_stands_and_flies_no_worse_for_it() -> None:
    """In a ring they face all directions: commands in a frame of the wrong yaw would part them."""
    ring = replace(HOVER, flock=Flock(4, 'ring', faces=('back', 'front', 'left', 'right')),
                   duration=8.0)
    rows = measure(fly(ring, range(1), True))
    assert rows['in_band'].all()


@pytest.mark.parametrize('name', [
    'flock_line', 'flock_ring_all_round', *(
        pytest.param(name, marks=pytest.mark.sweep) for name in (
            'flock_wedge', 'flock_ring', 'flock_line_all_round', 'flock_wedge_all_round'))])
def test_the_formations_of_the_package_keep_apart_and_together(name: str) -> None:
    flights = fly(replace(load(name), duration=12.0), range(200, 202), True)
    runs = of_runs(measure(flights), flights)
    assert runs['min_separation'].min() >= 0.9
    assert runs['time_in_band'].min() >= 0.98
    assert not runs['lost'].any()


def test_followers_that_start_too_far_apart_gather() -> None:
    flights = fly(replace(HOVER, duration=20.0, flock=Flock(3, spacing=4.0)), [50], True)
    band = np.sqrt([flights.scenario.flight.d0, flights.scenario.flight.d1])
    assert np.all(flights.farthest[:, 0] > band[1] + 1.0)
    assert np.all(flights.farthest[:, -1] < band[1])
    assert np.nanmin(flights.nearest) > band[0]


def test_one_that_fails_hovers_and_then_is_gone_and_the_others_go_on() -> None:
    flock = replace(HOVER, duration=12.0, leader=LeaderMotion('wander', speed=(0.3, 0.3)),
                    flock=Flock(3, 'wedge', fails=FollowerFailure(2, 4.0, 4.0)))
    flights = fly(flock, [3], True)
    failed = flights.velocity[1, (flights.times > 6.0) & (flights.times < 8.0)]
    assert np.linalg.norm(failed, axis=1).max() < 0.1
    assert np.isinf(flights.nearest[1, flights.times > 8.2]).all()
    assert np.isfinite(flights.nearest[[0, 2]]).all()
    assert of_runs(measure(flights), flights)['lost'].tolist() == [0.0]
    assert of_runs(measure(flights), flights)['min_separation'][0] > 1.0


@pytest.mark.parametrize('run', [87_000, pytest.param(90_000, marks=pytest.mark.sweep)])
def test_a_line_whose_first_follower_fails_finds_its_leader(run: int) -> None:
    """In these runs the others turned to each other and drifted away, without the leader."""
    line = load('flock_line')
    assert line.flock is not None
    flights = fly(replace(line, duration=50.0, flock=replace(
        line.flock, fails=FollowerFailure(1, 12.0))), [run], True)
    runs = of_runs(measure(flights), flights)
    assert not runs['lost'].any() and runs['min_separation'].min() >= 0.9


def test_a_flock_whose_leader_was_hidden_for_5_s_finds_it_again() -> None:
    """In this run the first follower turned to the second, and both hovered until the end."""
    line = replace(load('flock_line'), outages=(Outage('marker', 20.0, 5.0),), duration=35.0)
    flights = fly(line, [51_000_001], True)
    runs = of_runs(measure(flights), flights)
    assert not runs['lost'].any() and runs['min_separation'].min() >= 0.9
    assert flights.seen[0, flights.times > 28.0].all()


def test_followers_that_talk_keep_clear_of_a_leader_that_nobody_sees() -> None:
    """In these runs it strolled on to 0.25 and 0.45 m from one of the ring around it."""
    ring = replace(load('flock_ring'), outages=(Outage('marker', 6.0, 5.0),), duration=13.0)
    flights = fly(ring, [51_000_003, 51_000_004], True)
    assert of_runs(measure(flights), flights)['min_separation'].min() >= 0.9


def test_ranges_keep_a_flock_in_its_band_while_markers_are_hidden() -> None:
    line = replace(load('flock_line'), outages=(Outage('marker', 4.0, 5.0),), duration=10.0,
                   ranges=RangeErrors(rate=20.0))
    assert line.flock is not None
    in_band = []
    for ranges in (False, True):
        flights = fly(replace(line, flock=replace(line.flock, words=False, ranges=ranges)),
                      range(1), True)
        runs = of_runs(measure(flights), flights)
        assert runs['min_separation'].min() >= 0.9
        in_band.append(runs['time_in_band'].mean())
    assert min(in_band) > 0.98


def test_a_flock_is_as_near_as_its_nearest_pair_and_in_band_along_its_edges() -> None:
    flights = fly(replace(HOVER, duration=3.0), [0], True)
    places = flights.positions[0]
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=3)
    least = (apart + 10.0 * np.eye(4)).min()
    runs = of_runs(measure(flights), flights)
    assert runs['min_separation'][0] == pytest.approx(least, abs=0.01)
    # The last of the line is out of the band of the leader, and in that of whom it follows.
    assert np.all(apart[:, 0, 3] > np.sqrt(8.0)) and runs['in_band'][0] == 1.0


def test_the_command_tells_of_flocks_beside_what_it_tells_of_all(
        tmp_path: Path, capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('flock_desk.flights.CHUNK', 4)
    results = flown_by_the_command(
        tmp_path,
        'summary: short\nduration: 3\nleader: {motion: legs}\nflock: {followers: 2}\n', ('1',))
    for values in results.values():
        assert {'in_band', 'min_separation_m', 'lost_for_good', 'rms_acceleration_m_s2',
                'edges', 'neighbors_in_sight'} <= set(values)
    out = capsys.readouterr().out
    assert 'nearest pair' in out
