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

import json
from pathlib import Path
import subprocess
import sys

from embedded_flight import Flight, setpoint
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk import autopilot

pytestmark = pytest.mark.slow


def times(flight, kind):
    """Return when messages with time_boot_ms came, s."""
    return [m.time_boot_ms * 1e-3 for m in flight.messages if m.get_type() == kind]


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


def test_drop_loses_one_message_type_or_a_share_for_a_time():
    flight = Flight(faults=[
        Fault('drop', 1.5, message='HEARTBEAT'),
        Fault('drop', 0.0, 4.0, 'sent', share=0.3, message='LOCAL_POSITION_NED')])
    flight.fly(4.0)
    assert flight.kinds().count('HEARTBEAT') == 2
    assert flight.kinds().count('LOCAL_POSITION_NED') == pytest.approx(140, abs=20)
    flight.messages.clear()
    flight.fly(2.0)
    assert flight.kinds().count('LOCAL_POSITION_NED') == 100


def test_delay_makes_messages_late_but_keeps_their_order():
    flight = Flight(faults=[Fault('delay', 1.0, by=0.5, direction='sent')])
    flight.fly(3.4)
    came = times(flight, 'LOCAL_POSITION_NED')
    assert came == sorted(came) and came[-1] == pytest.approx(flight.now - 0.5, abs=0.04)
    flight = Flight('arducopter', faults=[Fault('delay', 0.5, by=1.0, direction='received')])
    flight.mode('GUIDED')
    flight.fly(0.6)
    flight.fly(0.8, setpoint(1.0))
    assert not flight.vehicle.velocity[0] > 0.05
    flight.fly(1.0, setpoint(1.0))
    assert flight.vehicle.velocity[0] > 0.5


@pytest.mark.parametrize('direction', ['sent', 'received'])
def test_garbage_and_duplicates_stop_neither_side(direction):
    flight = Flight(faults=[Fault('garbage', 0.0, 3.0, direction, share=0.5, size=60),
                            Fault('duplicate', 3.0, direction='sent')])
    flight.fly(3.0, setpoint())
    good = flight.kinds().count('LOCAL_POSITION_NED')
    assert good < 140 if direction == 'sent' else good >= 149
    assert ('BAD_DATA' in flight.kinds()) == (direction == 'sent')
    flight.messages.clear()
    flight.fly(2.0, setpoint())
    assert flight.kinds().count('LOCAL_POSITION_NED') >= 196
    assert flight.mode('OFFBOARD') == [0, 0, 0, 0]


def test_a_refused_command_is_refused_with_its_reason_and_later_not():
    flight = Flight(start='landed', faults=[
        Fault('refuse', 1.0, 1.0, command='COMPONENT_ARM_DISARM', reason='Not today')])
    flight.fly(1.1)
    assert flight.arm() == [2] and flight.texts() == ['Not today']
    assert not flight.controller.armed
    flight.fly(1.0)
    assert flight.arm() == [0]


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


@pytest.mark.ros
def test_the_process_takes_personality_parameters_and_faults(tmp_path):
    log, switch = tmp_path / 'flight.npz', {'kind': 'pilot', 'at': 0.3, 'mode': 'BRAKE'}
    with subprocess.Popen(
            [sys.executable, Path(__file__).parents[1] / 'faulty_autopilot.py', '--connect',
             '127.0.0.1:9', '--personality', 'arducopter', '--param', 'GUID_TIMEOUT=0.5',
             '--fault', json.dumps(switch), '--duration', '0.8', '--log', str(log)],
            stderr=subprocess.PIPE, text=True) as process:
        assert process.wait(timeout=10.0) == 0
        assert process.stderr.read() == ''
    with np.load(log) as logged:
        modes = logged['mode'].tolist()
    assert (modes[0], modes[-1]) == ('LOITER', 'BRAKE')


@pytest.mark.parametrize(('arguments', 'complaint'), [
    (['--param', 'GUID_TIMEOUT'], "param = 'GUID_TIMEOUT': must be NAME=NUMBER"),
    (['--param', 'NO=1'], 'NO: must be one of COM_'),
    (['--signing-key-file', '/nowhere'], "signing_key_file = '/nowhere': No such file")])
def test_bad_arguments_are_one_line(arguments, complaint, capsys):
    assert autopilot.main(arguments) == 1
    error = capsys.readouterr().err
    assert complaint in error and error.count('\n') == 1
