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

"""The faults that tests let happen to the embedded autopilot, and the refusals of its command."""


from embedded_flight import Flight, setpoint
from faulty_autopilot import Fault
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk import autopilot

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(('personality', 'mode'), [('px4', 'POSCTL'), ('arducopter', 'LOITER')])
def test_the_pilot_climbs_so_long_after_the_first_setpoint(personality, mode):
    flight = Flight(personality, altitude=1.5, faults=[
        Fault('pilot', 2.0, mode=mode, climb=2.0, after='setpoint')])
    flight.mode('GUIDED' if personality == 'arducopter' else 'AUTO.LOITER')
    flight.fly(5.0)
    flight.fly(1.9, setpoint())
    assert flight.controller.mode != mode
    flight.fly(8.0, setpoint())
    assert flight.controller.mode == mode
    assert flight.vehicle.position[2] == pytest.approx(3.5, abs=0.05)


@pytest.mark.parametrize(('personality', 'mode'), [
    ('px4', 'AUTO.LOITER'), ('arducopter', 'STABILIZE')])
def test_a_reboot_is_silent_forgets_and_starts_its_clock_anew(personality, mode):
    name = 'COM_OF_LOSS_T' if personality == 'px4' else 'GUID_TIMEOUT'
    flight = Flight(personality, start='landed', parameters={name: 0.5},
                    faults=[Fault('reboot', 3.0, duration=2.0)])
    flight.fly(1.0)
    flight.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 32.0, 1e6)
    assert flight.arm() == [0]
    flight.fly(2.0)
    flight.messages.clear()
    flight.fly(1.98, setpoint())
    assert flight.messages == [] and flight.arm() == []
    flight.fly(1.1)
    assert (flight.controller.mode, flight.controller.armed) == (mode, False)
    assert flight.last('ATTITUDE_QUATERNION').time_boot_ms < 1200
    assert flight.kinds().count('LOCAL_POSITION_NED') > 50
    assert flight.controller.parameters[name] == 0.5


def test_a_reboot_in_the_air_brings_it_down():
    flight = Flight(altitude=30.0, faults=[Fault('reboot', 0.5, duration=3.0)])
    flight.fly(2.5)
    assert flight.vehicle.velocity[2] < -8.0


@pytest.mark.parametrize(('arguments', 'complaint'), [
    (['--connect', '0.0.0.0:14540'], 'must be a loopback address'),
    (['--connect', '8.8.8.8:1'], 'must be a loopback address'),
    (['--connect', '14540'], 'must be HOST:PORT'),
    (['--connect', '127.0.0.1:99999'], 'must be HOST:PORT'),
    (['--param', 'GUID_TIMEOUT'], "param = 'GUID_TIMEOUT': must be NAME=NUMBER"),
    (['--param', 'NO=1'], 'NO: must be one of COM_'),
    (['--signing-key-file', '/nowhere'], "signing_key_file = '/nowhere': No such file")])
def test_bad_arguments_are_one_line(arguments, complaint, capsys):
    assert autopilot.main(arguments) == 1
    error = capsys.readouterr().err
    assert complaint in error and error.count('\n') == 1
