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

"""The autopilot's parameters are read and compared, and never written."""

import struct

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.dialects import DIALECTS
from flock_follower.mavlink.parameter_check import (
    parameter_value,
    ParameterCheck,
    read_recommendations,
    Recommendation,
)
from flock_follower.parameters.mavlink_bridge_table import recommendations
from flock_follower.resources import resource

INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32
A, B, C = (Recommendation(name, value, f'why {name}') for name, value in (
    ('A', 1.0), ('B', 0.5), ('C', -3.0)))


def answer(name, value, kind=REAL32):
    return mavlink.MAVLink_param_value_message(name.encode(), value, kind, 1, 0)


def as_bytes(form, value):
    return struct.unpack('<f', struct.pack(form, value).ljust(4, b'\0'))[0]


@pytest.mark.parametrize('dialect', DIALECTS.values(), ids=DIALECTS)
def test_the_shipped_files_say_why_each_parameter_matters(dialect):
    text = resource(f'config/{dialect.recommendations}').read_text()
    always = read_recommendations(text, forwarding=False)
    more = read_recommendations(text, forwarding=True)
    assert more[:len(always)] == always and len(more) > len(always) >= 2
    assert all(len(entry.why) > 20 for entry in more)
    values = {entry.name: entry.value for entry in more}
    off = {entry.name for entry in always if entry.differs(0.0) and not entry.differs(77.0)}
    if dialect.name == 'px4':
        # Height by the barometer, yaw by the odometry and not by a compass.
        assert {name: values[f'EKF2_{name}'] for name in (
            'EV_CTRL', 'HGT_REF', 'GPS_CTRL', 'MAG_TYPE')} == {
                'EV_CTRL': 13, 'HGT_REF': 0, 'GPS_CTRL': 0, 'MAG_TYPE': 5}
        assert {entry.name: entry.value for entry in always}['COM_OBL_RC_ACT'] == 5  # Hold
        assert values['COM_OBL_RC_ACT'] == 4  # Land
        assert values['COM_OF_LOSS_T'] <= 1.0
        assert values['COM_RCL_EXCEPT'] == 0
        assert off == {'NAV_RCL_ACT', 'COM_LOW_BAT_ACT', 'GF_ACTION', 'GF_MAX_HOR_DIST',
                       'GF_MAX_VER_DIST'}
    else:
        assert values['GUID_TIMEOUT'] == 0.5 and values['VISO_TYPE'] == 1
        assert {values[f'EK3_SRC1_{name}'] for name in ('POSXY', 'VELXY', 'VELZ', 'YAW')} == {6}
        assert values['EK3_SRC1_POSZ'] == 1  # barometer
        assert off == {'FS_THR_ENABLE', 'BATT_FS_LOW_ACT', 'BATT_FS_CRT_ACT', 'FENCE_ENABLE',
                       'FENCE_ACTION', 'FENCE_RADIUS', 'FENCE_ALT_MAX'}


@pytest.mark.parametrize(('takeoff_height', 'least'), [(1.5, 1.5), (2.5, 2.5), (10.0, 2.5)])
def test_the_least_takeoff_height_recommended_is_none_that_takeoff_would_refuse(
        takeoff_height, least):
    found = recommendations(False, takeoff_height)
    values = {entry.name: entry.value for entry in found['px4']}
    assert values['MIS_TAKEOFF_ALT'] == least and values['COM_OF_LOSS_T'] == 0.5
    assert not {entry.name for entry in found['ardupilot']} & {'VISO_TYPE', 'GPS1_TYPE'}


def test_both_forms_of_file_are_read():
    text = '# A file.\n\n# why\n# it matters\n1\t1\tA\t0.5\t9\nB 3\nC,-1\n'
    assert read_recommendations(text, forwarding=True) == [
        ('A', 0.5, 'why it matters'), ('B', 3.0, ''), ('C', -1.0, '')]


def test_a_line_that_is_no_parameter_is_named():
    with pytest.raises(ValueError, match="line 2 = 'A = 3': must be NAME VALUE"):
        read_recommendations('# why\nA = 3\n', forwarding=True)


@pytest.mark.parametrize(('form', 'kind', 'value'), [
    ('<i', mavlink.MAV_PARAM_TYPE_INT32, 15), ('<i', mavlink.MAV_PARAM_TYPE_INT32, -1),
    ('<I', mavlink.MAV_PARAM_TYPE_UINT32, 70000), ('<h', mavlink.MAV_PARAM_TYPE_INT16, -5),
    ('<H', mavlink.MAV_PARAM_TYPE_UINT16, 40000), ('<b', mavlink.MAV_PARAM_TYPE_INT8, -2),
    ('<B', mavlink.MAV_PARAM_TYPE_UINT8, 200)])
def test_px4_puts_the_bytes_of_an_integer_where_the_float_belongs(form, kind, value):
    message = answer('A', as_bytes(form, value), kind)
    # As it arrives: packed, sent, and unpacked.
    data = message.pack(mavlink.MAVLink(None, 1, 1))
    message = mavlink.MAVLink(None).parse_buffer(data)[0]
    assert parameter_value(message, bytewise=True) == value


def test_floats_and_the_numbers_of_ardupilot_are_what_they_say():
    assert parameter_value(answer('A', 0.5), bytewise=True) == 0.5
    assert parameter_value(answer('A', 6.0, INT32), bytewise=False) == 6.0


def test_parameters_are_asked_for_two_at_a_time():
    check = ParameterCheck([A, B, C], bytewise=False)
    assert check.step(0.0) == ['A', 'B'] and check.step(0.1) == [] and not check.done
    check.take(answer('A', 1.0))
    assert check.step(0.2) == ['C']
    check.take(answer('B', 0.5))
    check.take(answer('C', -3.0))
    assert check.done and check.report() == [] and check.values == {'A': 1.0, 'B': 0.5, 'C': -3.0}


def test_what_differs_is_told_with_the_reason():
    check = ParameterCheck([A, B, C], bytewise=False)
    check.step(0.0)
    check.take(answer('A', 2.0))
    check.take(answer('B', 0.5 + 1e-7))
    check.take(answer('Z', 9.0))
    assert check.differences() == [(A, 2.0)]
    assert check.report() == ['A = 2, recommended 1: why A']


def test_of_some_any_value_but_0_will_do():
    fence = Recommendation('FENCE', 100.0, 'Any but 0: how far it reaches.')
    check = ParameterCheck([fence], bytewise=False)
    check.step(0.0)
    check.take(answer('FENCE', 37.0))
    assert check.report() == []
    check.take(answer('FENCE', 0.0))
    assert check.report() == ['FENCE = 0, recommended 100: Any but 0: how far it reaches.']


def test_a_silent_autopilot_is_asked_three_times_then_given_up():
    check, asked = ParameterCheck([A], bytewise=False), []
    for tenth in range(45):
        asked += [tenth / 10 for _ in check.step(tenth / 10)]
    assert asked == [0.0, 1.0, 2.0]
    assert check.done and check.unanswered == ['A']
    assert check.report() == [
        'no answer about A: compare them with the recommended values by hand']
    check.take(answer('A', 1.0))  # late, but heard
    assert check.unanswered == [] and check.report() == []


def test_what_another_thread_reads_is_whole_and_never_changes():
    check = ParameterCheck([A, B], bytewise=False, needed=['C'])
    check.step(0.0)
    check.take(answer('A', 2.0))
    check.take(answer('B', 0.5))
    assert check.result is None  # C is not done
    check.step(0.1)
    for now in (1.2, 2.3, 3.4):
        check.step(now)
    result = check.result
    lines = ('A = 2, recommended 1: why A',
             'no answer about C: compare them with the recommended values by hand')
    assert result == (2, 1, 1, lines)
    check.step(5.0)
    assert check.result is result
    check.again('C')
    check.take(answer('C', 7.0))  # late, but heard
    assert result == (2, 1, 1, lines) and check.result == (3, 1, 0, lines[:1])


def test_a_check_of_nothing_is_done_at_once():
    assert ParameterCheck([], bytewise=True).result == (0, 0, 0, ())
