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

"""The embedded autopilot with ArduCopter's personality, as measured on ArduCopter 4.7."""

import math

from embedded_flight import Flight, MASK, MASK_YAW, setpoint
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

pytestmark = pytest.mark.slow
ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4


def guided(**options):
    flight = Flight('arducopter', **options)
    assert flight.mode('GUIDED') == [ACCEPTED]
    return flight


def speed(flight):
    return float(np.linalg.norm(flight.vehicle.velocity))


@pytest.mark.parametrize(('command', 'params', 'result', 'mode'), [
    (mavlink.MAV_CMD_DO_SET_MODE, (1.0, 99.0), FAILED, 'GUIDED'),
    (mavlink.MAV_CMD_DO_SET_MODE, (0.0, 5.0), DENIED, 'GUIDED'),
    (mavlink.MAV_CMD_DO_SET_MODE, (math.nan, math.nan), DENIED, 'GUIDED'),
    (mavlink.MAV_CMD_DO_SET_MODE, (1.0, 9.0), ACCEPTED, 'LAND'),
    (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (0.0,), FAILED, 'GUIDED'),  # in the air
    (mavlink.MAV_CMD_DO_PARACHUTE, (), UNSUPPORTED, 'GUIDED')])
def test_commands_have_one_answer(command, params, result, mode):
    flight = guided()
    assert flight.command(command, *params) == [result] and flight.controller.mode == mode


@pytest.mark.parametrize(('sent', 'seconds', 'reached'), [
    # No speed limit applies to accelerations, and zero ones keep the height.
    ({'east': 1.0}, 10.0, lambda v: v.velocity[0] > 8.0),
    ({'mask': MASK}, 8.0, lambda v: abs(v.position[2] - 2.0) < 0.05),
    ({'yaw': 1.5}, 4.0, lambda v: abs(v.yaw - 1.5) < 0.02)])
def test_setpoints_are_flown(sent, seconds, reached):
    flight = guided()
    flight.fly(seconds, setpoint(**sent))
    assert reached(flight.vehicle)


@pytest.mark.parametrize('refused', [
    {'mask': 0x93B}, {'mask': MASK_YAW | 512}, {'mask': 0xFFF},
    {'frame': 12}], ids=['mixed', 'force', 'nothing', 'frame'])
def test_setpoints_it_cannot_fly_stop_it_without_a_word(refused):
    flight = guided()
    flight.fly(2.0, setpoint(1.0))
    assert speed(flight) > 1.0
    flight.fly(4.0, setpoint(**{'east': 1.0, **refused}))
    assert speed(flight) < 0.1 and flight.controller.mode == 'GUIDED' and flight.texts() == []
    assert flight.vehicle.position[2] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(('parameters', 'timeout'), [({}, 3.0), ({'GUID_TIMEOUT': 0.5}, 0.5)])
def test_it_accelerates_for_guid_timeout_then_stops_in_guided(
        parameters, timeout):
    flight = guided(parameters=parameters)
    flight.fly(1.0, setpoint(1.0))
    before = flight.vehicle.velocity[0]
    flight.fly(timeout - 0.05)
    assert flight.vehicle.velocity[0] == pytest.approx(before + timeout, abs=0.4)
    flight.fly(4.0)
    assert speed(flight) < 0.2 and flight.controller.mode == 'GUIDED'
