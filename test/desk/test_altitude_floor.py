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

"""A follower behind a leader that lands stays above its least altitude, in lock step."""

from dataclasses import replace

import numpy as np
import pytest

from flock_desk.closed_loop.campaign import fly
from flock_desk.scenarios.scenario import LeaderMotion, Leg
from flock_desk.scenarios.scenario_file import load

pytestmark = pytest.mark.slow
RUNS = range(5)
LEAST = 1.0  # m above the ground


@pytest.mark.parametrize(('descent', 'v_max'), [(0.3, 0.5), (1.0, 2.0)])
def test_behind_a_leader_that_lands_it_stops_at_the_least_altitude(descent, v_max):
    indoor = load('indoor')
    landing = replace(
        indoor, duration=17.0, flight=replace(indoor.flight, altitude_min=LEAST, v_max=v_max),
        leader=LeaderMotion(wait=2.0, legs=(Leg(1.0, (0.1, 0.0, 0.0)),
                                            Leg(1.6 / descent, (0.0, 0.0, -descent)),
                                            Leg(60.0, (0.0, 0.0, 0.0)))),
        # Above the ground by the odometry: what that drifts by is no matter of the planner's.
        odometry=replace(indoor.odometry, height_walk=0.0))
    flights = fly(landing, RUNS, True)
    height = flights.follower[:, :, 2]
    assert np.all(flights.leader[:, -1, 2] < 0.3)
    assert height.min() > LEAST - 0.1
    assert height[:, -20:].mean() == pytest.approx(LEAST + 0.1, abs=0.08)
