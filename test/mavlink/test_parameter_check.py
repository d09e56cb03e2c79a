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

import struct

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.files import resource
from flock_follower.mavlink.dialects import ARDUPILOT, DIALECTS, PX4
from flock_follower.mavlink.parameter_check import (
    obstacle,
    parameter_value,
    ParameterCheck,
    read_recommendations,
    Recommendation,
)

INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32
A, B, C = (Recommendation(name, value, f'why {name}') for name, value in (
    ('A', 1.0), ('B', 0.5), ('C', -3.0)))
NEEDED = [rule.name for dialect in DIALECTS.values() for rule in dialect.rules]
BOTH = pytest.mark.parametrize('dialect', DIALECTS.values(), ids=DIALECTS)
ALLOWED = {
    'px4': {'COM_OF_LOSS_T': 0.5, 'COM_OBL_RC_ACT': 5, 'EKF2_EV_CTRL': 13},
    'ardupilot': {'GUID_TIMEOUT': 0.5, 'VISO_TYPE': 1, 'EK3_SRC1_POSXY': 6, 'EK3_SRC1_VELXY': 6}}
#: What the shipped files recommend where odometry is forwarded; of OFF any value but 0 will do.
FORWARDING = {
    'px4': {'EKF2_EV_CTRL': 13, 'EKF2_HGT_REF': 0, 'EKF2_GPS_CTRL': 0, 'EKF2_MAG_TYPE': 5,
            'COM_OBL_RC_ACT': 4, 'COM_RCL_EXCEPT': 0},
    'ardupilot': {'GUID_TIMEOUT': 0.5, 'VISO_TYPE': 1, 'EK3_SRC1_POSZ': 1, **{
        f'EK3_SRC1_{name}': 6 for name in ('POSXY', 'VELXY', 'VELZ', 'YAW')}}}
OFF = {'px4': {'NAV_RCL_ACT', 'COM_LOW_BAT_ACT', 'GF_ACTION', 'GF_MAX_HOR_DIST',
               'GF_MAX_VER_DIST'},
       'ardupilot': {'FS_THR_ENABLE', 'BATT_FS_LOW_ACT', 'BATT_FS_CRT_ACT', 'FENCE_ENABLE',
                     'FENCE_ACTION', 'FENCE_RADIUS', 'FENCE_ALT_MAX'}}


def answer(name, value, kind=REAL32):
    return mavlink.MAVLink_param_value_message(name.encode(), value, kind, 1, 0)


def checked(*wanted, needed=(), **values):
    """Return a check that has asked, and received these values."""
    check = ParameterCheck(wanted, bytewise=False, needed=needed)
    check.step(0.0)
    for name, value in values.items():
        if value is not None:
            check.take(answer(name, value))
    return check


@BOTH
def test_the_shipped_files_say_why_each_parameter_matters(dialect):
    text = resource(f'config/{dialect.recommendations}').read_text()
    always = read_recommendations(text, forwarding=False)
    more = read_recommendations(text, forwarding=True)
    assert more[:len(always)] == always and len(more) > len(always) >= 2
    assert all(len(entry.why) > 20 for entry in more)
    values = {entry.name: entry.value for entry in more}
    assert values == values | FORWARDING[dialect.name]
    assert {entry.name for entry in always if entry.differs(0.0) and not entry.differs(77.0)} == (
        OFF[dialect.name])
    # Without forwarded odometry PX4 holds, with it it lands; nothing recommended forbids offboard.
    assert {entry.name: entry.value for entry in always}.get('COM_OBL_RC_ACT', 5) == 5
    assert {rule.name for rule in dialect.rules} <= set(values)
    assert obstacle(dialect, checked(needed=NEEDED, **values), True) == ''


def test_both_forms_of_file_are_read_and_a_line_that_is_no_parameter_is_named():
    text = '# A file.\n\n# why\n# it matters\n1\t1\tA\t0.5\t9\nB 3\nC,-1\n'
    assert read_recommendations(text, forwarding=True) == [
        ('A', 0.5, 'why it matters'), ('B', 3.0, ''), ('C', -1.0, '')]
    with pytest.raises(ValueError, match="line 2 = 'A = 3': must be NAME VALUE"):
        read_recommendations('# why\nA = 3\n', forwarding=True)


@pytest.mark.parametrize(('form', 'kind', 'value'), [
    ('<i', INT32, 15), ('<i', INT32, -1), ('<I', mavlink.MAV_PARAM_TYPE_UINT32, 70000),
    ('<h', mavlink.MAV_PARAM_TYPE_INT16, -5), ('<H', mavlink.MAV_PARAM_TYPE_UINT16, 40000),
    ('<b', mavlink.MAV_PARAM_TYPE_INT8, -2), ('<B', mavlink.MAV_PARAM_TYPE_UINT8, 200)])
def test_px4_puts_the_bytes_of_an_integer_where_the_float_belongs(form, kind, value):
    as_float = struct.unpack('<f', struct.pack(form, value).ljust(4, b'\0'))[0]
    # As it arrives: packed, sent, and unpacked.
    data = answer('A', as_float, kind).pack(mavlink.MAVLink(None, 1, 1))
    message = mavlink.MAVLink(None).parse_buffer(data)[0]
    assert parameter_value(message, bytewise=True) == value
    # Floats, and the numbers of ArduPilot, are what they say.
    assert parameter_value(answer('A', 0.5), bytewise=True) == 0.5
    assert parameter_value(answer('A', float(value), kind), bytewise=False) == value


def test_parameters_are_asked_for_one_at_a_time_and_compared_once_all_are_answered():
    check = ParameterCheck([A, B, C], bytewise=False)
    assert [check.step(now) for now in (0.0, 0.1, 0.2, 0.3)] == ['A', 'B', 'C', '']
    check.take(answer('A', 2.0))
    check.take(answer('B', 0.5 + 1e-7))
    assert check.result() is None
    assert check.step(2.3) == 'C'  # again, until it is answered
    check.take(answer('C', -3.0))
    check.take(answer('Z', 9.0))  # was not asked for
    assert check.result() == (3, 1, 0, ('A = 2, recommended 1: why A',))
    fence = Recommendation('FENCE', 100.0, 'Any but 0: how far it reaches.')
    assert [checked(fence, FENCE=value).result().differing for value in (37.0, 0.0)] == [0, 1]


def test_a_parameter_without_answer_does_not_hide_those_that_differ():
    check, asked = ParameterCheck([A], bytewise=False, needed=['GUID_TIMEOUT']), []
    for tenth in range(51):
        asked += filter(None, [check.step(tenth / 10)])
        check.take(answer('A', 7.0))
        assert (check.result() is None) == (tenth < 50)
    assert asked == ['GUID_TIMEOUT'] * 3 and check.result()[:3] == (1, 1, 1)
    assert obstacle(ARDUPILOT, check, False).startswith('GUID_TIMEOUT could not be read')
    check.take(answer('GUID_TIMEOUT', 1.0))  # late, but received
    assert check.result()[:3] == (2, 1, 0) and obstacle(ARDUPILOT, check, False) == ''


# What forbids offboard.

@pytest.mark.parametrize(('dialect', 'name', 'allowed', 'dangerous', 'not_fused'), [
    (PX4, 'COM_OF_LOSS_T', (0.0, 1.0), (1.01,), ()),
    (PX4, 'COM_OBL_RC_ACT', range(6), (6, 7), ()),
    (PX4, 'EKF2_EV_CTRL', (5, 7, 13, 15), (), (0, 1, 4, 8, 10, 12)),
    (ARDUPILOT, 'GUID_TIMEOUT', (0.1, 1.0), (3.0,), ()),
    (ARDUPILOT, 'VISO_TYPE', (1, 2, 3), (), (0,)),
    (ARDUPILOT, 'EK3_SRC1_POSXY', (6,), (), (0, 3)),
    (ARDUPILOT, 'EK3_SRC1_VELXY', (6,), (), (0, 3, 5))])
def test_what_is_dangerous_or_does_not_fuse_what_is_forwarded_forbids_offboard(
        dialect, name, allowed, dangerous, not_fused):
    for value in (*allowed, *dangerous, *not_fused):
        check = checked(needed=NEEDED, **ALLOWED[dialect.name] | {name: value})
        without, forwarding = (obstacle(dialect, check, f) for f in (False, True))
        assert bool(without) == (value in dangerous)
        assert bool(forwarding) == (value not in allowed)
        assert not forwarding or forwarding.startswith(f'{name} = {value:g}')
        assert ('require_failsafe' in forwarding) == (value not in allowed)
