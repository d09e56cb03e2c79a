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

"""Scripted faults of the embedded autopilot: what each does, and how a bad script is refused."""

import math
import subprocess
import sys

from embedded_flight import Flight, odometry, setpoint
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk import autopilot
from flock_desk.vehicles.embedded import EmbeddedAutopilot
from flock_desk.vehicles.fault_script import Fault, load_faults

pytestmark = pytest.mark.slow
SCRIPT = """
faults:
  - {at: 2.0, fault: drop, for: 3.0, direction: sent, share: 0.3}
  - {at: 5.0, fault: drop, message: HEARTBEAT}
  - {at: 6, fault: delay, for: 1, by: 0.25}
  - {at: 8.0, fault: duplicate, for: 1.0}
  - {at: 9.0, fault: garbage, for: 1.0, bytes: 40, share: 0.5, direction: received}
  - {at: 12.0, fault: refuse, command: NAV_TAKEOFF, result: denied, reason: Not today}
  - {at: 15.0, fault: pilot, mode: POSCTL}
  - {at: 16.0, fault: pilot, mode: POSCTL, climb: 2, after: setpoint}
  - {at: 20.0, fault: vision, for: 4.0}
  - {at: 30.0, fault: reboot}
  - {at: 32.0, fault: barometer, for: 5.0, offset: -1.5}
  - {at: 35.0, fault: battery, remaining: 0.15}
"""


def times(flight, kind):
    """Return when messages with time_boot_ms came, s."""
    return [m.time_boot_ms * 1e-3 for m in flight.messages if m.get_type() == kind]


def test_a_script_is_read(tmp_path):
    path = tmp_path / 'faults.yaml'
    path.write_text(SCRIPT)
    faults = load_faults(path)
    assert [fault.kind for fault in faults] == [
        'drop', 'drop', 'delay', 'duplicate', 'garbage', 'refuse', 'pilot', 'pilot', 'vision',
        'reboot', 'barometer', 'battery']
    assert faults[0] == Fault('drop', 2.0, duration=3.0, direction='sent', share=0.3)
    assert faults[1].end == math.inf and faults[9].end == 33.0
    assert (faults[10].offset, faults[11].remaining) == (-1.5, 0.15)
    assert (faults[7].climb, faults[7].after) == (2, 'setpoint')
    assert faults[5].refusal() == (mavlink.MAV_CMD_NAV_TAKEOFF, (2, 'Not today'))


@pytest.mark.parametrize(('text', 'complaint'), [
    ('faults: [{at: 1, fault: explode}]', "fault 1: fault = 'explode': must be one of drop, "),
    ('faults: [{fault: drop}]', "fault 1: drop needs 'at'"),
    ('faults: [{at: 1, fault: delay}]', "fault 1: delay needs 'by'"),
    ('faults: [{at: 1, fault: pilot}]', "fault 1: pilot needs 'mode'"),
    ('faults: [{at: 1, fault: pilot, mode: POSCTL, after: lunch}]',
     "fault 1: after = 'lunch': must be one of start, setpoint"),
    ('faults: [{at: 1, fault: drop, after: setpoint}]', "fault 1: 'after' means nothing to drop"),
    ('faults: [{at: 1, fault: pilot, mode: ALTCTL, climb: 101}]',
     'fault 1: climb = 101: must be a number in [-100, 100] m'),
    ('faults: [{at: 1, fault: barometer}]', "fault 1: barometer needs 'offset'"),
    ('faults: [{at: 1, fault: battery, remaining: 2}]',
     'fault 1: remaining = 2: must be a number in [-1, 1]'),
    ('faults: [{at: 1, fault: drop, until: 2}]', "fault 1: 'until' means nothing to drop: must"),
    ('faults: [{at: 1, fault: drop, mode: X}]', "fault 1: 'mode' means nothing to drop: must be"),
    ('faults: [{at: 1, fault: drop}, {at: -1, fault: drop}]',
     'fault 2: at = -1: must be a number in [0, '),
    ('faults: [{at: .nan, fault: drop}]', 'fault 1: at = nan: must be a number in [0, '),
    ('faults: [{at: soon, fault: drop}]', "fault 1: at = 'soon': must be a number"),
    ('faults: [{at: true, fault: drop}]', 'fault 1: at = True: must be a number'),
    ('faults: [{at: 1, fault: drop, for: -2}]', 'fault 1: for = -2: must be a number in [0, '),
    ('faults: [{at: 1, fault: drop, share: 2}]', 'fault 1: share = 2: must be a number in [0, 1]'),
    ('faults: [{at: 1, fault: drop, direction: up}]', "fault 1: direction = 'up': must be one of"),
    ('faults: [{at: 1, fault: drop, message: PING_PONG}]', "fault 1: message = 'PING_PONG': must"),
    ('faults: [{at: 1, fault: garbage, bytes: 0}]',
     'fault 1: bytes = 0: must be an integer in [1, 10000]'),
    ('faults: [{at: 1, fault: refuse, command: FLY}]', "fault 1: command = 'FLY': must be a MAV_"),
    ('faults: [{at: 1, fault: refuse, command: NAV_LAND, result: no}]', 'fault 1: result = False'),
    ('faults: [drop]', "fault 1: 'drop': must be a mapping with at and fault"),
    ('faults: {}', "must hold one key, 'faults', with a list"),
    ('', "must hold one key, 'faults'"),
    ('faults: [}', 'not YAML: ')])
def test_a_bad_script_is_refused_with_the_place(tmp_path, text, complaint, capsys):
    path = tmp_path / 'faults.yaml'
    path.write_text(text)
    assert autopilot.main(['--faults', str(path)]) == 1
    error = capsys.readouterr().err
    assert complaint in error and error.count('\n') == 1 and 'faults.yaml' in error


def test_a_missing_script_is_one_line(tmp_path, capsys):
    assert autopilot.main(['--faults', str(tmp_path / 'none.yaml')]) == 1
    assert 'No such file or directory' in capsys.readouterr().err


def test_a_mode_that_the_personality_has_not_is_refused():
    with pytest.raises(ValueError, match="mode = 'POSCTL': must be one of STABILIZE"):
        EmbeddedAutopilot('arducopter', now=0.0, faults=[Fault('pilot', 1.0, mode='POSCTL')])


@pytest.mark.parametrize(('personality', 'modes'), [
    ('px4', ['POSCTL']), ('arducopter', ['LOITER', 'POSHOLD'])])
def test_a_climb_in_a_mode_that_keeps_no_place_is_refused(personality, modes):
    other = 'ALTCTL' if personality == 'px4' else 'ALT_HOLD'
    for mode in modes:
        EmbeddedAutopilot(personality, now=0.0, faults=[Fault('pilot', 1.0, mode=mode, climb=2.0)])
    with pytest.raises(ValueError, match=f"mode = '{other}': must be one of {', '.join(modes)}, "
                                         'where climb = 2'):
        EmbeddedAutopilot(personality, now=0.0,
                          faults=[Fault('pilot', 1.0, mode=other, climb=2.0)])


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


def test_drop_silences_one_direction_for_a_time():
    flight = Flight(faults=[Fault('drop', 1.0, duration=1.0, direction='sent')])
    flight.fly(3.0)
    gaps = np.diff(times(flight, 'LOCAL_POSITION_NED'))
    assert gaps.max() == pytest.approx(1.0, abs=0.05) and np.median(gaps) < 0.03


def test_drop_may_lose_one_message_type_only():
    flight = Flight(faults=[Fault('drop', 1.5, message='HEARTBEAT')])
    flight.fly(5.0)
    assert flight.kinds().count('HEARTBEAT') == 2
    assert flight.kinds().count('SYS_STATUS') == 5


def test_drop_by_lot_loses_a_share_and_is_repeatable():
    flights = [Flight(faults=[Fault('drop', 0.0, direction='sent', share=0.3)]) for _ in range(2)]
    for flight in flights:
        flight.fly(10.0)
    assert flights[0].kinds().count('LOCAL_POSITION_NED') == pytest.approx(350, abs=30)
    assert flights[0].kinds() == flights[1].kinds()


def test_dropped_setpoints_are_lost_setpoints():
    flight = Flight(faults=[Fault('drop', 2.0, direction='received')])
    flight.fly(1.2, setpoint())
    flight.mode('OFFBOARD')
    flight.fly(2.0, setpoint())
    assert flight.controller.mode == 'POSCTL'


def test_delay_makes_messages_late_but_keeps_their_order():
    flight = Flight(faults=[Fault('delay', 1.0, by=0.5, direction='sent')])
    flight.fly(1.4)
    assert times(flight, 'LOCAL_POSITION_NED')[-1] < 1.0
    flight.fly(2.0)
    came = times(flight, 'LOCAL_POSITION_NED')
    assert came == sorted(came) and came[-1] == pytest.approx(flight.now - 0.5, abs=0.04)


def test_delayed_setpoints_arrive_later():
    flight = Flight('arducopter', faults=[Fault('delay', 0.5, by=1.0, direction='received')])
    flight.mode('GUIDED')
    flight.fly(0.6)
    flight.fly(0.8, setpoint(1.0))
    assert not flight.vehicle.velocity[0] > 0.05
    flight.fly(1.0, setpoint(1.0))
    assert flight.vehicle.velocity[0] > 0.5


def test_duplicate_sends_everything_twice():
    flight = Flight(faults=[Fault('duplicate', 0.0, direction='sent')])
    flight.fly(2.0)
    assert flight.kinds().count('HEARTBEAT') == 4
    assert np.count_nonzero(np.diff(times(flight, 'LOCAL_POSITION_NED')) == 0.0) > 90


@pytest.mark.parametrize('direction', ['sent', 'received'])
def test_garbage_costs_messages_but_stops_neither_side(direction):
    flight = Flight(faults=[
        Fault('garbage', 0.0, duration=3.0, direction=direction, share=0.5, size=60)])
    flight.fly(3.0, setpoint())
    good = flight.kinds().count('LOCAL_POSITION_NED')
    assert good < 140 if direction == 'sent' else good >= 149
    assert ('BAD_DATA' in flight.kinds()) == (direction == 'sent')
    flight.messages.clear()
    flight.fly(2.0, setpoint())
    assert flight.kinds().count('LOCAL_POSITION_NED') >= 98
    assert flight.mode('OFFBOARD') == [0, 0]


def test_a_refused_command_is_refused_with_its_reason_and_later_not():
    flight = Flight(start='landed', gcs=True, faults=[
        Fault('refuse', 1.0, duration=1.0, command='COMPONENT_ARM_DISARM', result='denied',
              reason='Arming denied: Not today')])
    flight.fly(1.1)
    assert flight.arm() == [2] and flight.texts() == ['Arming denied: Not today']
    assert not flight.controller.armed
    flight.fly(1.0)
    assert flight.arm() == [0]


def test_the_pilot_switches_on_time():
    flight = Flight('arducopter', faults=[Fault('pilot', 2.0, mode='LOITER')])
    flight.mode('GUIDED')
    flight.fly(1.9, setpoint(1.0))
    assert flight.controller.mode == 'GUIDED'
    flight.fly(4.0, setpoint(1.0))
    assert flight.controller.mode == 'LOITER'
    assert np.linalg.norm(flight.vehicle.velocity) < 0.1


def test_vision_stops_and_comes_back():
    flight = Flight(parameters={'EKF2_GPS_CTRL': 0},
                    faults=[Fault('vision', 1.0, duration=2.0)])
    still = odometry((0.0, 0.0, 2.0))
    flight.fly(1.0, still, rate=30.0)
    assert flight.controller.estimator.vision_age(flight.now) < 0.1
    flight.fly(1.9, still, rate=30.0)
    assert flight.controller.estimator.vision_age(flight.now) > 1.8
    flight.fly(0.3, still, rate=30.0)
    assert flight.controller.estimator.vision_age(flight.now) < 0.1


@pytest.mark.parametrize(('personality', 'mode'), [
    ('px4', 'AUTO.LOITER'), ('arducopter', 'STABILIZE')])
def test_a_reboot_is_silent_forgets_and_starts_its_clock_anew(personality, mode):
    flight = Flight(personality, start='landed', parameters={
        'px4': {'COM_OF_LOSS_T': 0.5}, 'arducopter': {'GUID_TIMEOUT': 0.5}}[personality],
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
    name = 'COM_OF_LOSS_T' if personality == 'px4' else 'GUID_TIMEOUT'
    assert flight.controller.parameters[name] == 0.5


def test_a_reboot_in_the_air_brings_it_down():
    flight = Flight(altitude=30.0, faults=[Fault('reboot', 0.5)])
    flight.fly(2.5)
    assert flight.vehicle.velocity[2] < -8.0


@pytest.mark.ros
def test_the_process_takes_personality_parameters_and_faults(tmp_path):
    script, log = tmp_path / 'faults.yaml', tmp_path / 'flight.npz'
    script.write_text('faults: [{at: 0.3, fault: pilot, mode: BRAKE}]')
    with subprocess.Popen(
            [sys.executable, '-m', 'flock_desk.autopilot', '--connect',
             '127.0.0.1:9', '--personality', 'arducopter', '--param', 'GUID_TIMEOUT=0.5',
             '--faults', str(script), '--duration', '0.8', '--log', str(log)],
            stderr=subprocess.PIPE, text=True) as process:
        assert process.wait(timeout=10.0) == 0
        assert process.stderr.read() == ''
    with np.load(log) as logged:
        modes = logged['mode'].tolist()
    assert (modes[0], modes[-1]) == ('LOITER', 'BRAKE')


@pytest.mark.parametrize(('arguments', 'complaint'), [
    (['--param', 'GUID_TIMEOUT'], "param = 'GUID_TIMEOUT': must be NAME=NUMBER"),
    (['--param', 'NO=1'], 'NO: must be one of COM_'),
    (['--personality', 'arducopter', '--failsafe', 'hold'], "failsafe = 'hold': only PX4"),
    (['--signing-key-file', '/nowhere'], "signing_key_file = '/nowhere': No such file")])
def test_bad_arguments_are_one_line(arguments, complaint, capsys):
    assert autopilot.main(arguments) == 1
    error = capsys.readouterr().err
    assert complaint in error and error.count('\n') == 1
