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
"""Whether setpoints point along what they rest on."""

import numpy as np
import pytest

from flock_desk.runs.directions import opposed
from flock_follower.bags.message_types import empty
from flock_follower.messages.command_writer import trajectory
from flock_follower.messages.commands import Command

EAST = np.array([1.0, 0.0, 0.0])


def command(acceleration):
    return trajectory(empty, Command(acceleration, 0.0, frame='odom'))


def log(setpoint, velocity):
    """Return a log of 100 setpoints at 20 Hz, of a vehicle of constant velocity."""
    times = 0.05 * np.arange(100)
    return {'setpoint_time': times, 'state_time': times,
            'setpoint_acceleration': np.tile(setpoint, (100, 1)),
            'velocity': np.tile(velocity, (100, 1))}


@pytest.mark.parametrize(('setpoint', 'velocity', 'commanded', 'share'), [
    # The offset of the thrust does not count, and a gate that brakes is no turned sign.
    ([1.0, 0.0, -1.2], -EAST, True, 0.0), (-EAST, EAST, True, 0.0), (-EAST, -EAST, True, 1.0),
    (-EAST, EAST, False, 0.0), (EAST, EAST, False, 1.0),
    ([0.0, 0.0, 1.0], [0.0, 0.0, 1.0], False, 1.0)])
def test_turned_sign_is_against_command_or_along_velocity(
        setpoint, velocity, commanded, share):
    commands = [(0.1 * k - 0.01, command(EAST)) for k in range(50)] if commanded else []
    judged = opposed(log(np.array(setpoint), np.array(velocity)), commands)
    assert len(judged) > 80 and np.mean(judged) == share


def test_what_rests_on_nothing_clear_is_not_judged():
    still = log(EAST, 0.1 * EAST)
    assert len(opposed(still, [])) == 0
    short = [(0.1 * k, command(0.1 * EAST)) for k in range(-1, 60)]
    assert len(opposed(log(EAST, EAST), short)) == 0
    nothing = {name: values[:0] for name, values in still.items()}
    assert len(opposed(nothing, [])) == 0
