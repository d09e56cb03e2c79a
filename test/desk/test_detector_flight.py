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

"""Flights in lock step on the poses of a simulated detector that is not ours."""

from __future__ import annotations

from dataclasses import replace

from flock_desk.closed_loop.detector_flight import DetectorFlight, DETECTORS, Figures
from flock_desk.scenarios.scenario_file import load
from flock_follower.bags.message_types import empty
from flock_follower.perception.neighbor_filter import UpdateOutcome

INDOOR = load('indoor')


def flown(duration: float, **changes: float) -> Figures:
    detector = replace(DETECTORS['degraded'], **changes)
    return DetectorFlight(INDOOR, 0, detector, empty).fly(duration)


def test_late_slow_poses_with_gaps_and_outliers_hold_the_band() -> None:
    figures = flown(8.0)
    assert figures.in_band == 1.0 and figures.nearest > 1.4
    assert figures.track > 0.9  # no brake for a single missing pose
    assert figures.acceleration <= INDOOR.flight.a_max + 1e-9
    assert figures.reasons[UpdateOutcome.OUTLIER.value] > 0


def test_a_detector_without_poses_is_not_followed() -> None:
    figures = flown(2.0, missing=1.0)
    assert figures.track == 0.0 and figures.speed < 0.1


def test_the_same_run_is_the_same_flight() -> None:
    assert flown(1.0) == flown(1.0)
