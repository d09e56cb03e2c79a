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

"""Control on the marker alone: relative motion, its bounds, and the change of the odometry."""

from dataclasses import replace
import math

from flown import step
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.messages import OdometryState, RELATIVE
from flock_follower.messages.commands import RELATIVE_ACCELERATION_MAX
from flock_follower.odometry.choice import OdometryChoice
from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.relative import (
    limit_relative,
    STEP_MAX,
)

PARAMS = PlannerParams()
SURE = 1e-4 * np.eye(3)


def leader(now, position=(2.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), name='leader', age=0.05):
    velocity = np.array(velocity)
    return Neighbor(name, now - age, np.array(position) - age * velocity, velocity, SURE, SURE)


def tick(memory, now, neighbors, velocity=(0.0, 0.0, 0.0), relative=True, position=(0.0,) * 3,
         **options):
    own = OwnState(now, np.array(position), np.array(velocity), 0.0, relative=relative)
    return step(memory, now, True, own, neighbors, PARAMS, **options)


def flown(duration, start=2.0, drift=0.0, stops_at=math.inf, tilted=0.0):
    """Return the distances behind a leader at 0.4 m/s; all velocities err by a drift, m/s."""
    memory, x, v, lead, distances = Memory(), -start, 0.4, 0.0, []
    a = 0.0
    for k in range(round(duration / 0.1)):
        now = 0.1 * k
        speed = 0.4 if now < stops_at else max(0.4 - (now - stops_at), 0.0)
        lead += 0.1 * speed
        v += 0.1 * (a + tilted)
        x += 0.1 * v
        moved = drift * now
        memory, decision = tick(
            memory, now, [leader(now, (lead + moved, 0.0, 1.0), (speed + drift, 0.0, 0.0))],
            (v + drift, 0.0, 0.0), position=(x + moved, 0.0, 1.0))
        assert decision.state is State.RELATIVE
        a += 0.3 * (decision.acceleration[0] - a)
        distances.append(lead - x)
    return np.array(distances)


@pytest.mark.parametrize('drift', [0.0, 3.0, -3.0])
def test_it_reaches_middle_of_band_at_any_common_velocity(drift):
    for start in (1.1, 2.7):
        distances = flown(20.0, start, drift)
        assert distances.min() > 1.0 and distances.max() < 2.83
        assert distances[-1] == pytest.approx(math.sqrt(4.5), abs=0.05)


@pytest.mark.parametrize('tilted', [0.6, -0.6])
def test_an_error_of_the_tilt_is_offset(tilted):
    distances = flown(30.0, tilted=tilted)
    assert distances.min() > 1.0 and distances.max() < 2.83
    assert distances[-1] == pytest.approx(math.sqrt(4.5), abs=0.1)


@pytest.mark.parametrize('error', [0.6, -0.6])
def test_thrust_error_growing_without_odometry_is_offset(error):
    memory, z, v, a, offs = Memory(), 0.0, 0.0, 0.0, []
    for k in range(150):
        now = 0.1 * k
        v += 0.1 * (a + error * min(now / 5.0, 1.0))
        z += 0.1 * v
        memory, decision = tick(memory, now, [leader(now, (2.1, 0.0, 0.0))], (0.0, 0.0, v),
                                position=(0.0, 0.0, z))
        a += 0.3 * (decision.acceleration[2] - a)
        offs.append(abs(z))
    assert max(offs) < 0.5 and offs[-1] < 0.1


def test_the_altitude_leaves_acceleration_for_the_distance():
    memory = Memory()
    for k in range(4):
        memory, decision = tick(memory, 0.1 * k, [leader(0.1 * k, (2.1, 0.0, 4.0))])
    assert decision.acceleration[2] == pytest.approx(0.6, abs=0.05)


def test_a_leader_that_stops_is_not_run_into():
    assert flown(20.0, stops_at=5.0).min() > 1.5


@settings(max_examples=300)
@given(st.tuples(*[st.floats(-100.0, 100.0)] * 2), st.floats(-100.0, 100.0),
       st.none() | st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_the_command_is_short_and_changes_slowly(level, vertical, last):
    before = np.zeros(3) if last is None else np.array(last)
    command = limit_relative(np.array(level), vertical, last if last is None else before)
    assert np.linalg.norm(command) <= RELATIVE_ACCELERATION_MAX + 1e-9
    assert np.linalg.norm(command - before) <= STEP_MAX + 1e-9


@pytest.mark.parametrize(('seen', 'own_age', 'reason'), [
    ([leader(5.0, age=0.51)], 0.0, 'no neighbor in sight'), ([], 0.0, 'no neighbor in sight'),
    ([leader(5.0)._replace(received=True)], 0.0, 'no neighbor in sight'),
    ([leader(5.0, name='leader/duplicate')], 0.0, 'no neighbor in sight'),
    ([leader(5.0, (4.0, 0.0, 0.0))], 0.0, 'leader is 4.0 m away'),
    ([leader(5.0)], 0.31, '0.31 s old')])
def test_nothing_is_commanded_without_marker_or_attitude(seen, own_age, reason):
    memory, _ = tick(Memory(), 5.0 - own_age, [])
    _, decision = step(memory, 5.0, True, None, seen, replace(PARAMS, predict_timeout=1.0))
    assert (decision.state, decision.acceleration) == (State.HOLD, None)
    assert reason in decision.reason


def test_the_relative_speed_is_bounded():
    far = leader(5.0, (3.7, 0.0, 0.0))
    for speed, acceleration in ((0.3, 0.1 / 0.6), (0.4, 0.0), (0.5, -0.1 / 0.6)):
        decision = tick(Memory(), 5.0, [far], (speed, 0.0, 0.0))[1]
        assert decision.acceleration[0] == pytest.approx(acceleration)


def test_another_neighbor_in_the_way_is_not_approached():
    far, near = leader(5.0, (2.8, 0.0, 0.0)), leader(5.0, (1.25, 0.0, 0.0), name='other')
    assert tick(Memory(), 5.0, [far])[1].acceleration[0] > 0.2
    memory = tick(Memory(), 4.9, [far._replace(stamp=4.85)])[0]
    assert tick(memory, 5.0, [far, near])[1].acceleration[0] <= 0.0


def test_odometry_change_forgets_places_and_ramps_command():
    memory, last = Memory(), None
    changes = []
    for k in range(60):
        now, without = 0.1 * k, 20 <= k < 40
        place = (100.0, 50.0, 7.0) if without else (0.0, 0.0, 1.0)
        seen = np.add(place, (1.2, 0.0, 0.0))
        memory, decision = tick(
            memory, now, [] if k in (20, 21, 40, 41, 42) else [leader(now, seen)],
            (0.0, 0.2, 0.0), without, place)
        if k in (20, 21):
            assert decision.acceleration is None and not memory.neighbors
            last = np.zeros(3)
            continue
        if k >= 22:
            assert decision.state is (State.RELATIVE if without else (
                State.COAST if k < 43 else State.TRACK))
            changes.append(np.linalg.norm(decision.acceleration - last))
        last = decision.acceleration
    assert max(changes[:-12]) <= 0.3  # settled a second after the return


def test_the_motion_without_odometry_is_used_as_long_as_it_comes():
    def state(stamp, frame):
        return OdometryState(round(stamp * 1e9), frame, '', *[np.zeros(3)] * 4, *[SURE] * 3)
    choice = OdometryChoice()
    taken = [choice.takes(state(*each)) for each in (
        (1.0, 'odom'), (1.1, RELATIVE), (1.05, 'odom'), (1.2, 'odom'), (1.24, RELATIVE),
        (1.38, 'odom'), (1.4, 'odom'), (1.41, 'odom'), (0.1, 'odom'))]
    assert taken == [True, True, False, False, True, False, True, True, True]
