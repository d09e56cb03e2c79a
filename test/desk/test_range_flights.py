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

"""Ranges in simulated flights: their errors, and what a follower makes of them out of sight."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flock_desk.closed_loop import campaign
from flock_desk.closed_loop.lookout import Lookout
from flock_desk.closed_loop.metrics import measure
from flock_desk.scenarios.scenario import (
    LeaderMotion,
    RangeErrors,
    Scenario,
    Sensing,
)
from flock_desk.scenarios.scenario_file import load
from flock_desk.sensors.sensing import Radios


def generators(count: int) -> list[np.random.Generator]:
    return [np.random.default_rng([run, 7]) for run in range(count)]


def test_radios_err_as_the_scenario_says() -> None:
    errors = RangeErrors(20.0, noise=0.05, bias=0.1, bias_walk=0.0, outliers=0.1, outlier=1.0)
    radios, true = Radios(errors, generators(400)), np.full(400, 3.0)
    measured = np.array([radios.measure(true) for _ in range(200)]) - 3.0
    bias = np.median(measured, axis=0)
    assert np.std(bias) == pytest.approx(0.1, rel=0.15)
    left = measured - bias
    assert np.std(left[np.abs(left) < 0.15]) == pytest.approx(0.05, rel=0.1)
    assert np.mean(left > 0.3) == pytest.approx(0.1 * 0.7, rel=0.1)
    assert np.mean(left < -0.3) < 1e-3


def test_where_the_leader_is_in_sight_a_flight_is_the_same_with_ranges() -> None:
    scenario = Scenario('seen', '', duration=6.0, leader=LeaderMotion('legs'),
                        sensing=Sensing(recall=1.0))
    without, with_them = (campaign.fly(each, range(2), True) for each in (
        scenario, replace(scenario, ranges=RangeErrors(20.0))))
    for name in ('follower', 'velocity', 'command'):
        assert np.array_equal(getattr(without, name), getattr(with_them, name), equal_nan=True)


@pytest.mark.slow
def test_unseen_for_5_s_the_distance_stays_known_and_kept(
        monkeypatch: pytest.MonkeyPatch) -> None:
    errors: list[float] = []

    class Watched(Lookout):
        def arrived(self, now: float) -> Any:
            arrived = super().arrived(now)
            if 16.0 < now < 20.0:
                for row, (_, [reported]) in enumerate(arrived):
                    estimate, world = reported.estimate, self._world
                    assert reported.yaw is None and now - estimate.stamp < 0.2  # by its ranges
                    away = np.linalg.norm(estimate.position - world.vio.position[row])
                    errors.append(float(away - world.distances[row, 0]))
            return arrived

    monkeypatch.setattr(campaign, 'Lookout', Watched)
    scenario = load('range_only_5s')
    # The course of the leader depends on how long it is.
    flights = campaign.fly(replace(scenario, outages=scenario.outages[:1]), range(100, 102), True)
    assert len(errors) == 2 * 39
    assert np.abs(errors).max() < 0.4
    assert measure(flights)['min_separation'].min() > 0.9
