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

"""Which parameters of the autopilot forbid offboard, and how that is told."""

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.dialects import ARDUPILOT, DIALECTS, PX4
from flock_follower.mavlink.parameter_check import (
    obstacle,
    ParameterCheck,
    read_recommendations,
    RULES,
    rules,
    unread,
)
from flock_follower.resources import resource

ALLOWED = {
    'px4': {'COM_OF_LOSS_T': 0.5, 'COM_OBL_RC_ACT': 5, 'EKF2_EV_CTRL': 13},
    'ardupilot': {'GUID_TIMEOUT': 0.5, 'VISO_TYPE': 1, 'EK3_SRC1_POSXY': 6, 'EK3_SRC1_VELXY': 6}}


def read(dialect, **values):
    """Return the check of an autopilot whose parameters are these, and else what is allowed."""
    check = ParameterCheck([], bytewise=False, needed=[
        rule.name for rule in rules(dialect, forwarding=True)])
    for name, value in {**ALLOWED[dialect.name], **values}.items():
        if value is not None:
            check.take(mavlink.MAVLink_param_value_message(
                name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0))
    return check


@pytest.mark.parametrize('forwarding', [False, True])
@pytest.mark.parametrize(('dialect', 'name', 'value'), [
    (PX4, 'COM_OF_LOSS_T', 1.01), (PX4, 'COM_OBL_RC_ACT', 6), (PX4, 'COM_OBL_RC_ACT', 7),
    (ARDUPILOT, 'GUID_TIMEOUT', 3.0)])
def test_what_is_dangerous_without_the_bridge_forbids_offboard(dialect, name, value, forwarding):
    told = obstacle(dialect, read(dialect, **{name: value}), forwarding)
    assert told.startswith(f'{name} = {value:g}')
    assert 'set it to' in told and told.endswith('(or require_failsafe:=false)')


@pytest.mark.parametrize(('dialect', 'name', 'values'), [
    (PX4, 'EKF2_EV_CTRL', (0, 1, 4, 8, 10, 12)), (ARDUPILOT, 'VISO_TYPE', (0,)),
    (ARDUPILOT, 'EK3_SRC1_POSXY', (0, 3)), (ARDUPILOT, 'EK3_SRC1_VELXY', (0, 3, 5))])
def test_odometry_that_is_not_fused_forbids_offboard_where_it_is_forwarded(dialect, name, values):
    for value in values:
        check = read(dialect, **{name: value})
        assert obstacle(dialect, check, True).startswith(
            f'{name} = {value:g}: it does not fuse the odometry that is forwarded to it; ')
        assert obstacle(dialect, check, False) == ''


@pytest.mark.parametrize(('dialect', 'name', 'values'), [
    (PX4, 'COM_OF_LOSS_T', (0.0, 1.0)), (PX4, 'COM_OBL_RC_ACT', range(6)),
    (PX4, 'EKF2_EV_CTRL', (5, 7, 13, 15)), (ARDUPILOT, 'GUID_TIMEOUT', (0.1, 1.0)),
    (ARDUPILOT, 'VISO_TYPE', (1, 2, 3))])
def test_other_values_do_not(dialect, name, values):
    for value in values:
        assert obstacle(dialect, read(dialect, **{name: value}), True) == ''


@pytest.mark.parametrize('dialect', DIALECTS.values(), ids=DIALECTS)
def test_the_recommended_values_forbid_nothing(dialect):
    text = resource(f'config/{dialect.recommendations}').read_text()
    values = {entry.name: entry.value for entry in read_recommendations(text, forwarding=True)}
    assert {rule.name for rule in RULES[dialect.name]} <= set(values)
    assert obstacle(dialect, read(dialect, **values), True) == ''


@pytest.mark.parametrize('dialect', [PX4, ARDUPILOT], ids=lambda dialect: dialect.name)
@pytest.mark.parametrize('forwarding', [False, True])
def test_each_that_matters_has_to_be_read(dialect, forwarding):
    assert unread(dialect, read(dialect), forwarding) == ''
    for rule in RULES[dialect.name]:
        told = unread(dialect, read(dialect, **{rule.name: None}), forwarding)
        if forwarding or not rule.forwarding:
            assert told.startswith(f'{rule.name} could not be read: ')
        else:
            assert told == ''
    assert obstacle(dialect, None, forwarding) == ''
    names = ', '.join(rule.name for rule in rules(dialect, forwarding))
    assert unread(dialect, None, forwarding).startswith(f'{names} could not be read: ')


def test_one_that_was_given_up_is_asked_for_once_more():
    check = ParameterCheck([], bytewise=False, needed=['GUID_TIMEOUT'])
    for now in (0.0, 1.0, 2.0, 3.0):
        check.step(now)
    assert check.unanswered == ['GUID_TIMEOUT']
    unread(ARDUPILOT, check, False)
    assert check.step(4.0) == ['GUID_TIMEOUT']
