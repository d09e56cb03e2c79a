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

"""The autopilot's parameters: read, compared, never written; which of them forbid offboard."""

import math
import struct

from bridge_flight import Flight
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.dialects import ARDUPILOT, DIALECTS, PX4, Version
from flock_follower.mavlink.parameter_check import (
    obstacle,
    parameter_value,
    ParameterCheck,
    read_recommendations,
    Recommendation,
)
from flock_follower.system.files import resource

INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32
A, B, C = (Recommendation(name, value, f'why {name}') for name, value in (
    ('A', 1.0), ('B', 0.5), ('C', -3.0)))
NEEDED = [rule.name for dialect in DIALECTS.values() for rule in dialect.offboard_rules]
BOTH = pytest.mark.parametrize('dialect', DIALECTS.values(), ids=DIALECTS)
ALLOWED = {
    'px4': {'COM_OF_LOSS_T': 0.5, 'COM_OBL_RC_ACT': 5, 'EKF2_EV_CTRL': 13},
    'ardupilot': {'GUID_TIMEOUT': 0.5, 'VISO_TYPE': 1, 'EK3_SRC1_POSXY': 6, 'EK3_SRC1_VELXY': 6}}
#: What the shipped files recommend where odometry is forwarded.
FORWARDING = {
    'px4': {'EKF2_EV_CTRL': 13, 'EKF2_HGT_REF': 0, 'EKF2_GPS_CTRL': 0, 'EKF2_MAG_TYPE': 5,
            'COM_OBL_RC_ACT': 4, 'COM_RCL_EXCEPT': 0, 'EKF2_EV_QMIN': 0},
    'ardupilot': {'GUID_TIMEOUT': 0.5, 'VISO_TYPE': 1, 'EK3_SRC1_POSZ': 1, 'VISO_QUAL_MIN': 0, **{
        f'EK3_SRC1_{name}': 6 for name in ('POSXY', 'VELXY', 'VELZ', 'YAW')}}}
#: Of the whole numbers from -1 to 12 those that are good for a failsafe, by newest version known:
#: PX4's 1 of GF_ACTION and 0 of COM_LOW_BAT_ACT only warn, 5 and 6 of NAV_RCL_ACT stop the motors,
#: and its 7 does nothing in offboard. 6 of ArduPilot's flies a mission's landing.
FENCE = {*range(1, 13)}
GOOD = {
    'px4': {'NAV_RCL_ACT': {1, 2, 3}, 'COM_LOW_BAT_ACT': {2, 3}, 'GF_ACTION': {2, 3, 5},
            'GF_MAX_HOR_DIST': FENCE, 'GF_MAX_VER_DIST': FENCE},
    'ardupilot': {'FS_THR_ENABLE': {1, 3, 4, 5, 7}, 'BATT_FS_LOW_ACT': {1, 2, 3, 4, 7},
                  'BATT_FS_CRT_ACT': {1, 2, 3, 4, 7}, 'FENCE_ACTION': {1, 2, 3, 4, 5},
                  'FENCE_RADIUS': FENCE, 'FENCE_ALT_MAX': FENCE}}


def answer(name, value, kind=REAL32):
    return mavlink.MAVLink_param_value_message(name.encode(), value, kind, 1, 0)


def version(major, minor, patch=0):
    return mavlink.MAVLink_autopilot_version_message(
        0, major << 24 | minor << 16 | patch << 8 | 255, 0, 0, 0, bytes(8), bytes(8), bytes(8),
        0, 0, 0)


def missing(name, error=mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST):
    return mavlink.MAVLink_param_error_message(1, 191, name.encode(), -1, error)


def check_of(*wanted, needed=(), dialect=ARDUPILOT, firmware=(4, 7)):
    """Return a check of a firmware of this version, None if it is not answered."""
    check = ParameterCheck(wanted, dialect, needed=needed)
    if firmware:
        check.take_version(version(*firmware))
    return check


def checked(*wanted, needed=(), dialect=ARDUPILOT, **values):
    """Return a check that has asked, and received these values."""
    check = check_of(*wanted, needed=needed, dialect=dialect)
    check.step(0.0)
    for name, value in values.items():
        if value is not None:
            check.take(answer(name, value))
    return check


def shipped(dialect, forwarding=False):
    text = resource(f'config/{dialect.recommendations}').read_text()
    return read_recommendations(text, forwarding=forwarding)


@BOTH
def test_the_shipped_files_say_why_each_parameter_matters(dialect):
    always, more = shipped(dialect), shipped(dialect, forwarding=True)
    assert more[:len(always)] == always and len(more) > len(always) >= 2
    assert all(len(entry.why) > 20 for entry in more)
    values = {entry.name: entry.value for entry in more}
    assert values == values | FORWARDING[dialect.name]
    # An unknown value is no failsafe.
    assert {entry.name: {n for n in range(-1, 13) if not entry.differs(n)}
            for entry in always if entry.name in GOOD[dialect.name]} == GOOD[dialect.name]
    assert all(not entry.differs(entry.value) for entry in more)
    # Without forwarded odometry PX4 holds, with it it lands; nothing recommended forbids offboard.
    assert {entry.name: entry.value for entry in always}.get('COM_OBL_RC_ACT', 5) == 5
    assert {rule.name for rule in dialect.offboard_rules} <= set(values)
    assert obstacle(dialect, checked(needed=NEEDED, **values), True) == ''


def test_both_file_forms_are_read_bad_line_is_named():
    text = '# A file.\n\n# why\n# it matters\n1\t1\tA\t0.5\t9\nB 3\nC,-1\n'
    assert [entry[:3] for entry in read_recommendations(text, forwarding=True)] == [
        ('A', 0.5, 'why it matters'), ('B', 3.0, ''), ('C', -1.0, '')]
    with pytest.raises(ValueError, match="line 2 = 'A = 3': must be NAME VALUE"):
        read_recommendations('# why\nA = 3\n', forwarding=True)


@pytest.mark.parametrize(('form', 'kind', 'value'), [
    ('<i', INT32, 15), ('<i', INT32, -1), ('<I', mavlink.MAV_PARAM_TYPE_UINT32, 70000),
    ('<h', mavlink.MAV_PARAM_TYPE_INT16, -5), ('<H', mavlink.MAV_PARAM_TYPE_UINT16, 40000),
    ('<b', mavlink.MAV_PARAM_TYPE_INT8, -2), ('<B', mavlink.MAV_PARAM_TYPE_UINT8, 200)])
def test_px4_puts_integer_bytes_into_the_float_field(form, kind, value):
    as_float = struct.unpack('<f', struct.pack(form, value).ljust(4, b'\0'))[0]
    # As it arrives: packed, sent, and unpacked.
    data = answer('A', as_float, kind).pack(mavlink.MAVLink(None, 1, 1))
    message = mavlink.MAVLink(None).parse_buffer(data)[0]
    assert parameter_value(message, bytewise=True) == value
    # Floats, and the numbers of ArduPilot, are what they say.
    assert parameter_value(answer('A', 0.5), bytewise=True) == 0.5
    assert parameter_value(answer('A', float(value), kind), bytewise=False) == value


def test_good_values_and_versions_are_read_and_are_no_reason():
    entry, = read_recommendations(
        '# why\n# Good: 1, 3 to 4.5\n# Versions: 1.15 to 1.17\nA 3\n', forwarding=True)
    assert entry.why == 'why'
    assert [value for value in (0, 1, 2, 3, 4.5, 5, math.nan) if not entry.differs(value)] == [
        1, 3, 4.5]
    known = {series: entry.applies(Version(*series)) for series in (
        (1, 14), (1, 15), (1, 17, 9), (1, 18), (2, 16))}
    assert [*known.values()] == [False, True, True, False, False]
    assert not entry.applies(None) and A.applies(None)


@pytest.mark.parametrize('line', [
    'Good: all', 'Good: 1,', 'Versions: 1.18', 'Versions: up to 2', 'Versions: 1.17 to 1.16'])
def test_good_values_and_versions_that_are_malformed_are_named(line):
    with pytest.raises(ValueError, match=f'line 2 = {line!r}: must be '):
        read_recommendations(f'# why\n# {line}\nA 3\n', forwarding=True)


@pytest.mark.parametrize(('series', 'sticks', 'estimates_thrust'), [
    ((1, 14), 'COM_RC_OVERRIDE', True), ((1, 17), 'COM_RC_OVERRIDE', True),
    ((1, 18), 'MAN_OVERRIDE_SPD', False), ((1, 19), 'MAN_OVERRIDE_SPD', False)])
def test_the_parameters_of_px4_are_those_of_its_version(series, sticks, estimates_thrust):
    names = {entry.name for entry in shipped(PX4) if entry.applies(Version(*series))}
    assert names & {'COM_RC_OVERRIDE', 'MAN_OVERRIDE_SPD'} == {sticks}
    assert ('MPC_USE_HTE' in names) == estimates_thrust
    speed, = (entry for entry in shipped(PX4) if entry.name == 'MAN_OVERRIDE_SPD')
    # Off below 0; the stick must be moved fast above 1.
    assert [value for value in (-1.0, 0.0, 0.5, 1.0, 1.5, 10.0) if not speed.differs(value)] == [
        0.5, 1.0]


def test_parameters_are_asked_singly_and_compared_once_complete():
    check = check_of(A, B, C)
    assert [check.step(now) for now in (0.0, 0.1, 0.2, 0.3)] == ['A', 'B', 'C', '']
    check.take(answer('A', 2.0))
    check.take(answer('B', 0.5 + 1e-7))
    assert check.result() is None
    assert check.step(2.3) == 'C'  # again, until it is answered
    check.take(answer('C', -3.0))
    check.take(answer('Z', 9.0))  # was not asked for
    assert check.result()[:4] == (3, 1, 0, ('A = 2, recommended 1: why A',))
    fence = Recommendation('FENCE', 100.0, 'how far it reaches.', good=((1.0, 1e4),))
    assert [checked(fence, FENCE=value).result().differing for value in (37.0, 0.0)] == [0, 1]


def test_unanswered_parameter_does_not_hide_those_that_differ():
    check, asked = check_of(A, needed=['GUID_TIMEOUT']), []
    for tenth in range(51):
        asked += filter(None, [check.step(tenth / 10)])
        check.take(answer('A', 7.0))
        assert (check.result() is None) == (tenth < 50)
    assert asked == ['GUID_TIMEOUT'] * 3 and check.result()[:3] == (1, 1, 1)
    assert obstacle(ARDUPILOT, check, False).startswith('GUID_TIMEOUT could not be read')
    check.take(answer('GUID_TIMEOUT', 1.0))  # late, but received
    assert check.result()[:3] == (2, 1, 0) and obstacle(ARDUPILOT, check, False) == ''


# The firmware.

NEW = Recommendation('NEW', 1.0, 'why NEW', since=(4, 7))


def test_version_is_asked_until_answered_and_decides_questions():
    check = check_of(A, NEW, firmware=None)
    assert [check.version_due(now) for now in (0.0, 0.1, 1.9, 2.0)] == [True, False, False, True]
    assert [check.step(now) for now in (0.0, 0.1)] == ['A', '']
    check.take(answer('A', 1.0))
    assert check.result() is None
    check.step(5.1)
    assert check.result()[:3] == (1, 0, 1) and check.result().unread == ('AUTOPILOT_VERSION',)
    check.take_version(version(0, 0))  # a build without a version
    assert check.version is None
    check.take_version(version(4, 7, 2))
    assert check.version == (4, 7, 2) and not check.version_due(9.0)
    assert check.step(9.0) == 'NEW' and check.result() is None
    check.take(answer('NEW', 1.0))
    assert check.result()[:3] == (2, 0, 0)


@pytest.mark.parametrize(('firmware', 'known'), [
    ((1, 13, 3), False), ((1, 14), True), ((1, 18, 3), True), ((1, 19), False), ((2, 0), False)])
def test_a_version_for_which_no_values_are_known_is_reported(firmware, known):
    check = check_of(dialect=PX4, firmware=firmware)
    check.step(0.0)
    assert check.firmware == f'PX4 {Version(*firmware)}'
    assert check.result().unproven == ('' if known else (
        f'{check.firmware}: the recommended values are known for PX4 1.14 to 1.18'))


def test_missing_autopilot_parameter_is_an_answer_with_version():
    check = check_of(
        A, needed=['COM_OF_LOSS_T', 'COM_OBL_RC_ACT'], dialect=PX4, firmware=(1, 18, 2))
    for name in (check.step(0.0), check.step(0.1), check.step(0.2)):
        check.take_error(missing(name))
    check.take_error(missing('Z'))  # was not asked for
    assert [check.step(now) for now in (3.0, 9.0)] == ['', '']
    result = check.result()
    assert result[:4] == (0, 0, 0, ())
    assert result.missing == ('COM_OF_LOSS_T does not exist in PX4 1.18.2',
                              'COM_OBL_RC_ACT does not exist in PX4 1.18.2',
                              'A does not exist in PX4 1.18.2, recommended 1: why A')
    assert obstacle(PX4, check, False) == (
        'COM_OF_LOSS_T, COM_OBL_RC_ACT do not exist in PX4 1.18.2: PX4 might not be safe without '
        'the bridge, or not fuse forwarded odometry; its rules are known for PX4 1.14 to 1.18')
    # Another error is no answer, and a value is one, whatever was answered before.
    check.take(answer('COM_OF_LOSS_T', 0.5))
    check.take_error(missing('COM_OF_LOSS_T', mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED))
    assert obstacle(PX4, check, False).startswith('COM_OBL_RC_ACT does not exist in')
    late = check_of(A)
    assert late.step(0.0) == 'A'
    late.take_error(missing('A', mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED))
    assert late.step(2.1) == 'A'


@pytest.mark.parametrize(('firmware', 'asked', 'not_asked'), [
    ('1.16', 'COM_RC_OVERRIDE', 'MAN_OVERRIDE_SPD'),
    ('1.18', 'MAN_OVERRIDE_SPD', 'COM_RC_OVERRIDE')])
def test_a_flight_asks_each_version_for_its_own_parameters(firmware, asked, not_asked):
    flight = Flight(version=firmware, bridge={'recommendations': {'px4': shipped(PX4)}})
    flight.fly(6.0)
    names = [m.param_id for _, m in flight.received if m.get_type() == 'PARAM_REQUEST_READ']
    assert names.count(asked) == 1 and not_asked not in names
    check = flight.bridge.housekeeping.parameters
    assert check.firmware == f'PX4 {firmware}.0'
    assert check.result().unanswered == 0 and check.result().missing == ()
    assert [m.param1 for m in flight.commands(mavlink.MAV_CMD_REQUEST_MESSAGE)] == [148.0]


# What forbids offboard.

@pytest.mark.parametrize(('dialect', 'name', 'allowed', 'dangerous', 'not_fused'), [
    (PX4, 'COM_OF_LOSS_T', (0.0, 1.0), (1.01,), ()),
    (PX4, 'COM_OBL_RC_ACT', range(6), (6, 7), ()),
    (PX4, 'EKF2_EV_CTRL', (5, 7, 13, 15), (), (0, 1, 4, 8, 10, 12)),
    (ARDUPILOT, 'GUID_TIMEOUT', (0.1, 1.0), (3.0,), ()),
    (ARDUPILOT, 'VISO_TYPE', (1, 2, 3), (), (0,)),
    (ARDUPILOT, 'EK3_SRC1_POSXY', (6,), (), (0, 3)),
    (ARDUPILOT, 'EK3_SRC1_VELXY', (6,), (), (0, 3, 5))])
def test_dangerous_or_unfused_settings_forbid_offboard(
        dialect, name, allowed, dangerous, not_fused):
    for value in (*allowed, *dangerous, *not_fused):
        check = checked(needed=NEEDED, **ALLOWED[dialect.name] | {name: value})
        without, forwarding = (obstacle(dialect, check, f) for f in (False, True))
        assert bool(without) == (value in dangerous)
        assert bool(forwarding) == (value not in allowed)
        assert not forwarding or forwarding.startswith(f'{name} = {value:g}')
        assert ('require_failsafe' in forwarding) == (value not in allowed)
