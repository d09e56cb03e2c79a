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

"""Who flies, and when: take-off, handover, take-over, and a bridge that starts again."""


import numpy as np
import pytest

from flock_desk.closed_loop.campaign import fly
from flock_desk.closed_loop.metrics import measure, STATES, summary
from flock_desk.scenarios.scenario_file import load

pytestmark = pytest.mark.slow
RUNS = range(4)  # both autopilots, twice


def handovers(flights):
    """Return the times, s, at which each run's vehicle begins to fly setpoints."""
    begins = np.diff(np.concatenate([np.zeros((len(RUNS), 1)), flights.obeying], axis=1), axis=1)
    return [flights.times[run > 0.0] for run in begins]


def test_a_handover_keeps_the_altitude_and_nothing_is_sent_unasked():
    flights = fly(load('handover'), RUNS, True)
    found = summary(measure(flights))
    assert found['handover_altitude_m'] < 0.1 and found['handover_climb_m_s'] < 0.5
    assert found['altitude_change_m'] < 0.4  # of that, 0.02 m by the root of a second is drift
    assert found['unasked_setpoints'] == 0.0
    for times in handovers(flights):
        first, second = times  # PX4 wants a stream of 1.5 s before it takes the mode
        assert 10.0 < first < 12.0 and 42.0 < second < 44.0
    idle = STATES.index('IDLE')
    taken_over = (flights.times > 31.5) & (flights.times < 44.0)  # until it is engaged again
    assert np.all(flights.state[:, flights.times < 10.0] == idle)
    assert np.all(flights.state[:, taken_over] == idle)
    climbed = flights.follower[:, flights.times > 45.0, 2].mean(axis=1)
    np.testing.assert_allclose(climbed, 3.5, atol=0.3)  # 2 m above the first altitude


def test_a_bridge_that_starts_again_sends_nothing_before_offboard_is_called():
    flights = fly(load('restart'), RUNS, True)
    assert summary(measure(flights))['unasked_setpoints'] == 0.0
    dead = (flights.times > 23.5) & (flights.times < 35.0)
    assert not np.any(flights.obeying[:, dead])
    assert np.all(flights.state[:, dead] == STATES.index('IDLE'))
    speed = np.linalg.norm(flights.velocity[:, dead], axis=2)
    assert speed[:, -20:].max() < 0.1  # the autopilots hold
    after = flights.times > 40.0
    assert np.all(flights.obeying[:, after])
    assert np.all(flights.state[:, after] == STATES.index('TRACK'))
