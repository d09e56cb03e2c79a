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

"""Parameters of the autopilot that change in flight: reported, and offboard refused next time."""

from bridge_flight import Flight
from faulty_autopilot import Fault
from hypothesis import given
from hypothesis import strategies as st
import pytest

from flock_follower.mavlink.parameter_check import ASK
from flock_follower.mavlink.parameter_watch import CHANGED, ParameterWatch

VALUES = st.dictionaries(st.sampled_from('ABC'), st.sampled_from([0.0, 1.0, 2.0]))


@given(st.lists(st.tuples(VALUES, st.booleans())))
def test_values_of_flight_are_those_at_arming_or_first_read(steps):
    watch, flown = ParameterWatch(), {}
    for values, armed in steps:
        flown = {**values, **flown} if armed else dict(values)
        changed = {name for name in 'AB' if name in values and values[name] != flown[name]}
        new = watch.step(values, 'AB', armed)
        if not armed:
            assert not new and watch.obstacle() == ''
        for name in changed:
            assert f'{name} {CHANGED} from {flown[name]:g} to {values[name]:g}' in watch.obstacle()
        assert {text[0] for text in new} <= changed


@pytest.mark.parametrize(('personality', 'name', 'value', 'before'), [
    ('px4', 'COM_OF_LOSS_T', 0.5, 1.0), ('arducopter', 'GUID_TIMEOUT', 3.0, 0.5)])
def test_change_in_flight_is_reported_and_refuses_next_offboard(
        personality, name, value, before):
    flight = Flight(personality, bridge={'report_to_gcs': True})
    flight.follow(1.5)
    change = flight.now
    flight.autopilot._parameters.set(name, value)
    flight.fly(5.0)
    texts = [str(m.text) for t, m in flight.received
             if m.get_type() == 'STATUSTEXT' and t > change]
    assert any(text.startswith(f'flock: {name} {CHANGED}') for text in texts)
    # It stops no flight.
    assert flight.bridge.state(flight.now) == 'ACTIVE' and flight.kinds(40) == {'command'}
    assert flight.ask('offboard', False).success
    assert f'{name} {CHANGED} from {before:g} to {value:g}' in flight.ask('offboard', True).message
    flight.autopilot._parameters.set(name, before)
    flight.fly(2.5)
    assert flight.ask('offboard', True).success


def test_a_value_that_is_not_answered_any_more_is_unknown():
    flight = Flight(start='landed', faults=[
        Fault('drop', 2.0, direction='sent', message='PARAM_VALUE')])
    for seconds, unread in ((2.0, False), (12.0, True)):
        flight.fly(seconds)
        refusal = flight.bridge.requests.offboard_obstacle(flight.now, in_air=False)
        assert refusal.endswith(ASK) == unread
