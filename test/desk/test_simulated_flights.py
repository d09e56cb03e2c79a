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

"""Whole flights in lock step: what planner, guard and gate do together, in a few runs each."""

from __future__ import annotations

import contextlib
from dataclasses import replace
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest

from flock_desk.closed_loop import campaign
from flock_desk.closed_loop.camera_views import CameraViews
from flock_desk.closed_loop.campaign import fly
from flock_desk.closed_loop.metrics import (
    band_exits,
    concatenate_measures,
    Flights,
    measure,
    STATES,
    summary,
)
from flock_desk.closed_loop.world import World
from flock_desk.flights import main
from flock_desk.runs.processes import wait_until
from flock_desk.scenarios.courses import COURSE_STEP
from flock_desk.scenarios.scenario import (
    FlightParams,
    LeaderMotion,
    Leg,
    Outage,
    Response,
    Scenario,
    Start,
    VioErrors,
)
from flock_desk.scenarios.scenario_file import load
from flock_desk.sensors.sensing import PerceptionNoise
from flock_follower.geometry import Array
from flock_follower.planner.modes import State

pytestmark = pytest.mark.slow
RUNS = range(100, 101)
HOVER = Scenario('short', 'a short one', duration=6.0, leader=LeaderMotion('legs'))


def during(flights: Flights, begin: float, end: float) -> Any:
    return (flights.times >= begin - 1e-6) & (flights.times <= end + 1e-6)


def in_state(flights: Flights, state: State) -> Any:
    return flights.state == STATES.index(state)


def sooner(name: str, seconds: float) -> Scenario:
    """Return a scenario whose first leg is shorter, and whose outages come so much earlier."""
    scenario = load(name)
    first, *others = scenario.leader.legs
    return replace(scenario, outages=tuple(
        replace(outage, at=outage.at - seconds) for outage in scenario.outages),
        leader=replace(scenario.leader, legs=(
            replace(first, duration=first.duration - seconds), *others)))


def speed(flights: Flights) -> Array:
    return np.linalg.norm(flights.velocity, axis=2)


def test_flight_by_marker_without_odometry_returns_smoothly() -> None:
    scenario = sooner('vio_lost', 10.0)
    flown = fly(replace(scenario, duration=17.0, flight=replace(
        scenario.flight, relative_flight=True)), RUNS, True)
    alone = in_state(flown, State.RELATIVE)
    assert alone[:, during(flown, 11.0, 13.9)].all() and not alone[:, flown.times < 10.0].any()
    assert in_state(flown, State.TRACK)[:, during(flown, 15.0, 17.0)].mean() > 0.95
    assert not flown.outside.any()
    steps = np.linalg.norm(np.diff(flown.command, axis=1), axis=2)
    assert np.nanmax(steps[:, during(flown, 13.0, 15.0)[1:]]) <= 0.3


def test_the_guard_keeps_a_band_that_the_law_leaves() -> None:
    scenario = replace(load('shuttle'), duration=14.0)
    law, guard = (measure(fly(scenario, RUNS, on)) for on in (False, True))
    assert law['in_band'].max() == 0.0
    assert guard['in_band'].min() == 1.0
    assert guard['guard_active'].min() > 0.05
    assert guard['max_speed'].max() < 1.1 * scenario.flight.v_max


def test_noise_behind_hovering_leader_leads_to_middle_of_band() -> None:
    scenario = load('hover_noisy')
    flights = fly(replace(scenario, duration=30.0, start=Start((2.4, 2.4))), range(1), False)
    assert measure(flights)['final_distance'] == pytest.approx(np.sqrt(4.5), abs=0.1)


def test_unseen_leader_is_coasted_then_awaited_then_followed() -> None:
    flights = fly(replace(sooner('marker_lost_5s', 10.0), duration=19.0), RUNS, True)
    assert np.all(in_state(flights, State.TRACK)[:, during(flights, 1.5, 10.0)])
    held = during(flights, 12.2, 15.0)  # 2.1 s after the last image, and a tick
    assert np.all(in_state(flights, State.HOLD)[:, held])
    # Out of the way of where the leader may be, then at rest, and no further than it may.
    assert speed(flights)[:, during(flights, 12.2, 14.0)].max() < 1.05 * 0.5
    assert speed(flights)[:, during(flights, 14.8, 15.0)].max() < 0.2
    farther = flights.farthest[:, during(flights, 15.0, 16.0)].max(axis=1)
    assert np.all(farther < flights.farthest[:, during(flights, 9.0, 10.0)].max(axis=1) + 1.0)
    assert np.all(in_state(flights, State.TRACK)[:, during(flights, 17.0, 19.0)])
    assert measure(flights)['min_separation'].min() > 1.2


def test_a_second_print_is_kept_clear_of_and_never_followed() -> None:
    scenario = sooner('duplicate_marker', 10.0)
    (wall,) = scenario.prints
    x, y, z = wall.position
    flights = fly(replace(scenario, duration=16.0, prints=(
        replace(wall, position=(x - 10.0 * 0.4, y, z)),)), RUNS, True)  # the leader comes less far
    assert in_state(flights, State.HOLD)[:, during(flights, 12.2, 13.0)].all()
    assert in_state(flights, State.TRACK)[:, during(flights, 13.5, 16.0)].all()
    (wall,) = flights.scenario.prints
    offset = flights.follower - np.array(wall.position)
    assert np.linalg.norm(offset, axis=2).min() > 0.9
    assert measure(flights)['min_separation'].min() > 0.9
    assert measure(flights)['max_separation'].max() < 3.5


def test_leader_coming_while_odometry_is_lost_is_kept_clear_of() -> None:
    """The autopilot has a velocity of its own; the follower hovered, and was met within 0.2 m."""
    coming = LeaderMotion('legs', 2.0, acceleration=1.0, heading='away', legs=(
        Leg(4.0, (1.0, 0.0, 0.0)), Leg(9.0, (-1.06, 0.0, 0.0))))
    flights = fly(Scenario(
        'gap', '', duration=12.5, flight=FlightParams(v_max=2.0), leader=coming,
        outages=(Outage('vio', 7.5, 3.0),)), RUNS, True)
    assert measure(flights)['min_separation'].min() >= 0.9


def test_lost_odometry_is_braked_on_within_300_ms() -> None:
    moving = LeaderMotion('legs', legs=load('marker_lost_1s').leader.legs)
    for lost in (7.0, 7.04):  # whatever the phase of the planner's ticks
        flights = fly(Scenario('lost', '', duration=8.5, leader=moving, outages=(
            Outage('vio', lost, 10.0),)), RUNS, True)
        before = speed(flights)[:, during(flights, lost - 0.2, lost)].mean(axis=1)
        assert before.min() > 0.25
        braking = in_state(flights, State.HOLD) & during(flights, lost, 8.5)
        first = flights.times[np.argmax(braking, axis=1)]
        # The command acts with the gate's next tick, 50 ms later at most.
        assert np.max(first - lost) <= 0.25 + 1e-9
        along = np.einsum('nki,nki->nk', flights.command, flights.velocity)
        assert np.all(along[np.arange(len(RUNS)), np.argmax(braking, axis=1)] < -0.1)
        # What is left is the drift of the autopilot's own estimate.
        assert speed(flights)[:, during(flights, lost + 1.0, lost + 1.3)].max() < 0.25


@pytest.mark.parametrize(('descent', 'v_max'), [
    (1.0, 2.0), pytest.param(0.3, 0.5, marks=pytest.mark.sweep)])
def test_behind_landing_leader_it_stops_at_altitude_min(descent: float,
                                                        v_max: float) -> None:
    indoor = load('indoor')
    landing = replace(
        indoor, duration=17.0, flight=replace(indoor.flight, altitude_min=1.0, v_max=v_max),
        leader=LeaderMotion(wait=2.0, legs=(Leg(1.0, (0.1, 0.0, 0.0)),
                                            Leg(1.6 / descent, (0.0, 0.0, -descent)),
                                            Leg(60.0, (0.0, 0.0, 0.0)))),
        # Above the ground by the odometry: its drift is not the planner's.
        odometry=replace(indoor.odometry, height_walk=0.0))
    flights = fly(landing, RUNS, True)
    height = flights.follower[:, :, 2]
    assert np.all(flights.leader[:, -1, 2] < 0.3) and height.min() > 0.9
    assert height[:, -20:].mean() == pytest.approx(1.1, abs=0.08)


def begins(flights: Flights, row: int) -> list[float]:
    """Return the times, s, at which a vehicle begins to fly setpoints."""
    return flights.times[np.diff(flights.obeying[row].astype(int), prepend=0) > 0].tolist()


def test_handover_keeps_altitude_and_sends_nothing_unasked() -> None:
    scenario = load('handover')
    # The pilot takes over 14 s earlier.
    flights = fly(replace(scenario, duration=33.0, operations=tuple(
        replace(each, at=each.at - 14.0 * (each.at >= 30.0)) for each in scenario.operations)),
        RUNS, True)
    assert not flights.unasked[:, -1].any()
    for row in range(len(RUNS)):
        first, second = begins(flights, row)  # PX4 wants a stream of 1.5 s first
        assert 10.0 < first < 12.0 and 28.0 < second < 30.0
        for begin in (first, second):
            height = flights.follower[row, during(flights, begin, begin + 1.0), 2]
            assert np.ptp(height) < 0.1
    taken_over = during(flights, 17.5, 30.0)  # until it is engaged again
    assert in_state(flights, State.IDLE)[:, during(flights, 0.0, 9.9) | taken_over].all()
    climbed = flights.follower[:, flights.times > 31.0, 2].mean(axis=1)
    np.testing.assert_allclose(climbed, 3.5, atol=0.3)  # 2 m above the first altitude


def test_restarted_bridge_sends_nothing_before_offboard() -> None:
    scenario = load('restart')
    # The leader stops, the bridge dies and comes back 10 s earlier, offboard is called at 21 s.
    leg, rest = scenario.leader.legs
    flights = fly(replace(
        scenario, duration=28.0,
        leader=replace(scenario.leader, legs=(replace(leg, duration=7.0), rest)),
        operations=tuple(replace(each, at=min(each.at, 31.0) - 10.0 * (each.at > 1.0))
                         for each in scenario.operations)), RUNS, True)
    dead, after = during(flights, 13.5, 21.0), during(flights, 25.0, 99.0)
    assert not flights.unasked[:, -1].any() and not flights.obeying[:, dead].any()
    assert in_state(flights, State.IDLE)[:, dead].all()
    assert speed(flights)[:, during(flights, 19.0, 21.0)].max() < 0.1  # the autopilot holds
    assert flights.obeying[:, after].all() and in_state(flights, State.TRACK)[:, after].all()


def test_unseen_for_5_s_the_distance_stays_known_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    errors: list[float] = []
    nearest: list[float] = []

    class EnoughError(Exception):  # what comes later is not asked about
        pass

    class Watched(CameraViews):
        def arrived(self, now: float) -> Any:
            arrived = super().arrived(now)
            nearest.append(float(self._world.distances.min()))
            if now > 24.0:
                raise EnoughError
            if 16.0 < now < 20.0:
                for row, (_, [reported]) in enumerate(arrived):
                    estimate, world = reported.estimate, self._world
                    assert reported.yaw is None and now - estimate.stamp < 0.2  # by its ranges
                    away = np.linalg.norm(estimate.position - world.vio.position[row])
                    errors.append(float(away - world.distances[row, 0]))
            return arrived

    monkeypatch.setattr(campaign, 'CameraViews', Watched)
    scenario = load('range_only_5s')
    # The course of the leader depends on how long it is.
    with pytest.raises(EnoughError):
        fly(replace(scenario, outages=scenario.outages[:1]), RUNS, True)
    assert len(errors) == 39 and np.abs(errors).max() < 0.4
    assert min(nearest) > 0.9


def test_metrics_have_the_documented_meaning() -> None:
    n, k = 2, 11
    leader, follower, command = (np.zeros((n, k, 3)) for _ in range(3))
    leader[:, :, 0] = 2.0
    follower[1, 5, 0] = 1.2
    distance = np.linalg.norm(leader - follower, axis=2)
    command[0, 3, 0] = 0.5
    seen, guarded = np.ones((n, k), dtype=bool), np.zeros((n, k), dtype=bool)
    seen[0, 2:5] = seen[1, 4:6] = False
    guarded[1, :2] = True
    flights = Flights(
        HOVER, 0.1 * np.arange(k), leader, follower, np.zeros((n, k, 3)), np.zeros((n, k, 3)),
        distance, distance, 0.1 * (distance < 1.0), command, np.ones((n, k)), guarded, seen,
        ~guarded, np.ones((n, k), dtype=bool), np.zeros((n, k)))
    m = measure(flights)
    assert band_exits(flights) == [
        (1, f'at 0.5 s too near, 0.80 m; {STATES[1].value}, leader not seen for 0.2 s')]
    for name, values in {
            'in_band': [1.0, 0.0], 'min_separation': [2.0, 0.8], 'out_of_band': [0.0, 0.1],
            'guard_active': [0.0, 2 / 11], 'time_in_band': [1.0, 10 / 11],
            'in_sight': [1.0, 9 / 11], 'speed_share': [0.0, 0.0],
            'detection_gap': [0.3, 0.2], 'jerk': [np.sqrt(2 * 5.0 ** 2 / 10), 0.0],
            'tracking_error': [np.sqrt(4.5) - 2.0, m['tracking_error'][1]]}.items():
        assert m[name].tolist() == pytest.approx(values), name
    whole = summary(concatenate_measures([m, m]))
    assert (whole['runs'], whole['in_band'], whole['min_separation_m']) == (
        4, 0.5, pytest.approx(0.8))


@pytest.mark.parametrize(('flock', 'controllers', 'different', 'figures', 'printed'), [
    ('', ['law', 'guard', 'pd', 'cucker_smale', 'cucker_dong'], 4,  # the guard does not act
     {'out_of_band_s', 'guard_active'}, 'kept band'),
    ('flock: {followers: 2}', ['law', 'guard'], 1, {
        'lost_for_good', 'rms_acceleration_m_s2', 'edges', 'neighbors_in_sight'}, 'nearest pair')])
def test_the_command_writes_the_same_file_whatever_the_jobs(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
        flock: str, controllers: list[str], different: int, figures: set[str],
        printed: str) -> None:
    monkeypatch.setattr('flock_desk.flights.CHUNK', 1)
    mine = tmp_path / 'mine.yaml'
    mine.write_text(f'summary: short\nduration: 2\nleader: {{motion: legs}}\n{flock}')

    def flown(jobs: str, *options: str) -> Any:
        assert main(['--scenario', str(mine), '--runs', '2', '--jobs', jobs,
                     '--output', str(tmp_path / jobs), *options]) == 0
        return json.loads((tmp_path / jobs / 'flights.json').read_text())['mine']
    results = flown('1')
    assert list(results) == controllers
    assert len({str(values) for values in results.values()}) == different
    for values in results.values():
        assert values['runs'] == 2 and {'in_band', 'min_separation_m', *figures} <= set(values)
    assert printed in capsys.readouterr().out
    if not flock:
        assert flown('2', '--controllers', 'law', 'pd') == {
            name: results[name] for name in ('law', 'pd')}


def test_a_wrong_scenario_is_a_message_not_a_traceback(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / 'bad.yaml'
    bad.write_text('summary: bad\nflight:\n  v_max: 99\n')
    assert main(['--scenario', str(bad), '--output', str(tmp_path)]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == (
        f'error: {bad}: flight.v_max = 99.0: must be a number in [0.1, 5] m/s')


def children(parent: int) -> list[str]:
    return Path(f'/proc/{parent}/task/{parent}/children').read_text().split()


@pytest.mark.ros
def test_ctrl_c_ends_the_flights_and_their_workers_at_once(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, '-m', 'flock_desk.flights', '--jobs', '2', '--output', str(tmp_path)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        # Two workers, and the process that tracks what they share.
        wait_until(lambda: len(children(process.pid)) >= 3, 60.0, 'the workers')
        workers = children(process.pid)
        time.sleep(1.0)  # in the middle of a task of a minute
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the workers receive it, too
        out, error = process.communicate(timeout=10.0)
        wait_until(lambda: not any(Path(f'/proc/{pid}').exists() for pid in workers), 3.0,
                   'their end')
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # the workers, too: they hold the pipes
        process.communicate()
    assert (process.returncode, out, error.splitlines()[-1]) == (130, '', 'interrupted')
    assert 'Traceback' not in error
    assert not list(tmp_path.iterdir())


def test_odometry_has_rate_and_latency_of_scenario():
    scenario = replace(load('hover'), odometry=VioErrors(rate=10.0, latency=(0.06, 0.06)),
                       # Nobody holds the altitude.
                       response=Response(thrust_error=0.0, odometry_delay=(0.0, 0.0)))
    world, ages, images = World(scenario, [0, 1]), [], []
    lookout = CameraViews(world, PerceptionNoise())
    for k in range(1, 360):
        world.advance(k)
        lookout.look(k)
        ages += [k * COURSE_STEP - own.stamp for own in world.odometry(k * COURSE_STEP) if own
                 and k > 60]
        images += [k * COURSE_STEP - seen[0].estimate.stamp for _,
                   seen in lookout.arrived(k * COURSE_STEP)
                   if seen]
    assert [min(ages), max(ages)] == pytest.approx([0.06, 0.16], abs=COURSE_STEP)
    # An image waits for the odometry after it.
    assert min(images) + 1e-9 >= 0.06 and max(images) < 0.16 + 2 / 30
