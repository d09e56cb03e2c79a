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

"""Who has taken over: a pilot, a failsafe and which, or nobody knows."""

from bridge_flight import BOTH, Flight
from captured import decoded
from faulty_autopilot import Fault
from fuzz_mavlink import frame
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.gate.permission import Phase, UNKNOWN
from flock_follower.mavlink.dialects import ARDUPILOT, PX4
from flock_follower.mavlink.status_texts import event_number, EventMessage, MESSAGE_ID
from flock_follower.mavlink.takeover import (
    BATTERY,
    BEFORE,
    ESTIMATE,
    EVIDENCE_AFTER,
    failsafe,
    FENCE,
    PILOT,
    STATION,
    STREAM,
    STREAM_AFTER,
    TakeoverWatch,
    TRANSMITTER,
    UNNAMED,
)

LEFT = 10.0  # s, when the mode was left
SET_POSITION = 'SET_POSITION_TARGET_LOCAL_NED'


def event(name, *arguments):
    data = bytes(arguments)
    return EventMessage(event_number(name), 0, 0, 0, 0, 0, list(data.ljust(40, b'\0')))


def entered(cause):
    """Return the event of a failsafe with a ``failsafe_cause_t``: action 6 (RTL)."""
    return event('commander_failsafe_enter', 0, 0, 6, 0, 6, cause)


def text(words):
    return mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_CRITICAL, words.encode())


def mode(dialect, flown, chosen=None):
    """Return a CURRENT_MODE, or a HEARTBEAT if no chosen mode is given."""
    if chosen is not None:
        return mavlink.MAVLink_current_mode_message(
            0, dialect.modes[flown], dialect.modes.get(chosen, 0))
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, dialect.firmware, mavlink.MAV_MODE_FLAG_SAFETY_ARMED,
        dialect.modes[flown], mavlink.MAV_STATE_ACTIVE, 3)


def judged(dialect, *messages):
    """Return the cause after messages, each with its time after the mode was left, s."""
    watch = TakeoverWatch()
    for after, message in messages:
        watch.take(message, dialect, LEFT + after)
    return watch.taker(dialect, LEFT)


FAILSAFE = 0.0, mode(PX4, 'AUTO.RTL', 'OFFBOARD')


@pytest.mark.parametrize(('messages', 'cause'), [
    # PX4: the chosen mode decides, whatever else is reported.
    ([(0.0, mode(PX4, 'POSCTL', 'POSCTL'))], PILOT),
    ([(-1.0, entered(3)), (0.0, mode(PX4, 'POSCTL', 'POSCTL'))], PILOT),
    ([FAILSAFE], failsafe(UNNAMED)),
    ([FAILSAFE, (6.0, mode(PX4, 'POSCTL', 'POSCTL'))], PILOT),
    # Seen away and back, in messages that arrive together.
    ([(0.0, mode(PX4, 'POSCTL', 'POSCTL')), (0.0, mode(PX4, 'OFFBOARD', 'OFFBOARD'))], PILOT),
    # HEARTBEAT alone, or a chosen mode from before, shows neither.
    ([(-1.0, mode(PX4, 'AUTO.LOITER', 'AUTO.LOITER')), (0.0, mode(PX4, 'POSCTL'))], UNKNOWN),
    ([(0.0, mode(PX4, 'POSCTL', 'none'))], UNKNOWN),
    # PX4 1.14 reports no chosen mode.
    ([(0.0, mode(PX4, 'AUTO.RTL')), (0.1, entered(1))], failsafe(TRANSMITTER)),
    *(([FAILSAFE, (0.1, entered(number))], failsafe(cause)) for number, cause in (
        (0, UNNAMED), (1, TRANSMITTER), (2, STATION), (3, BATTERY), (4, BATTERY), (5, BATTERY),
        (99, UNNAMED))),
    ([(-0.1, event('commander_failsafe_enter_hold', 0, 0, 6, 0, 6, 5, 0, 1)), FAILSAFE],
     failsafe(TRANSMITTER)),
    ([FAILSAFE, (0.5, event('check_gf_violation_max_alt'))], failsafe(FENCE)),
    ([(-0.1, event('check_modes_offboard_signal')), FAILSAFE], failsafe(STREAM)),
    # A missing stream later is the effect of the takeover.
    ([FAILSAFE, (STREAM_AFTER + 0.1, event('check_modes_offboard_signal'))], failsafe(UNNAMED)),
    ([FAILSAFE, (EVIDENCE_AFTER + 0.1, entered(3))], failsafe(UNNAMED)),
    ([(-BEFORE - 0.1, entered(3)), FAILSAFE], failsafe(UNNAMED))])
def test_px4_mode_shows_pilot_and_events_name_failsafe(messages, cause):
    assert judged(PX4, *messages) == cause


@pytest.mark.parametrize(('words', 'flown', 'cause'), [
    ('', 'LOITER', PILOT), ('', 'STABILIZE', PILOT), ('', 'RTL', UNKNOWN), ('', 'LAND', UNKNOWN),
    ('Battery Failsafe', 'RTL', failsafe(BATTERY)), ('Battery Failsafe', 'LOITER', PILOT),
    ('Radio Failsafe', 'LAND', failsafe(TRANSMITTER)),
    ('Radio Failsafe - Continuing Guided Mode', 'LAND', UNKNOWN),
    ('Radio Failsafe Cleared', 'RTL', UNKNOWN), ('GCS Failsafe', 'RTL', failsafe(STATION)),
    ('Max Alt fence breached', 'BRAKE', failsafe(FENCE)),
    ('EKF Failsafe: changed to LAND Mode', 'LAND', failsafe(ESTIMATE)),
    ('Glitch cleared', 'LAND', UNKNOWN)])
def test_ardupilot_text_names_failsafe_some_modes_show_pilot(words, flown, cause):
    shown = 0.0, mode(ARDUPILOT, flown)
    for messages in ([(-0.2, text(words)), shown], [shown, (0.5, text(words))]):
        assert judged(ARDUPILOT, *messages) == cause


def test_failsafe_of_real_ardupilot_without_vision_is_named():
    watch, left = TakeoverWatch(), None
    for time, message in decoded('ardupilot_vision_lost'):
        if (message.get_srcSystem(), message.get_srcComponent()) != (1, 1):
            continue
        watch.take(message, ARDUPILOT, time)
        if left is None and message.get_type() == 'HEARTBEAT' and (
                ARDUPILOT.mode_name(message.custom_mode) == 'LAND'):
            left = time
    assert watch.taker(ARDUPILOT, left) == failsafe(ESTIMATE)


@pytest.mark.parametrize(('name', 'cause'), [
    ('px4_1.18_fence', failsafe(FENCE)), ('px4_1.18_stick', PILOT)])
def test_who_took_over_on_the_real_px4_is_named(name, cause):
    watch, flown, left = TakeoverWatch(), '', None
    for time, message in decoded(name):
        if left is not None and time > left + EVIDENCE_AFTER:
            break
        watch.take(message, PX4, time)
        if message.get_type() == 'CURRENT_MODE':
            before, flown = flown, PX4.mode_name(message.custom_mode)
            if before == PX4.offboard != flown:
                left = time
    assert watch.taker(PX4, left) == cause


# Through the bridge.


@pytest.mark.slow
@BOTH
def test_a_pilots_switch_is_named_and_bars_offboard(personality):
    flight = Flight(personality, bridge={'report_to_gcs': True}).follow(1.0)
    flight.controller.pilot_switches(flight.modes.loiter)
    flight.fly(3.0)
    state = flight.bridge.state(flight.now)
    assert state == f'TAKEN_OVER: offboard was left for {flight.modes.loiter}: {PILOT.text}'
    assert f'flock: hands over: {PILOT.text}' in texts(flight)
    assert 'the pilot took over' in flight.ask('offboard', True).message


def texts(flight):
    return [m.text for _, m in flight.received if m.get_type() == 'STATUSTEXT']


def arrive(flight, message):
    """Have an EVENT arrive at the bridge."""
    flight.wire.arrived.append(frame(MESSAGE_ID, message.unpacker.pack(
        message.number, 0, 0, 0, 0, 0, *message.arguments), crc_extra=message.crc_extra))


@pytest.mark.slow
def test_px4s_own_failsafe_is_no_pilot_and_bars_nothing():
    lost = Fault('drop', 5.0, 2.5, 'received', message=SET_POSITION)
    flight = Flight(faults=[lost], parameters={'COM_OBL_RC_ACT': 5},
                    bridge={'report_to_gcs': True}).follow(1.0)
    flight.fly_until(lambda: flight.mode == 'AUTO.LOITER', 5.0)
    flight.fly(0.1)
    assert flight.bridge.gate.permission.phase is Phase.TAKEN_OVER
    assert flight.bridge.state(flight.now).endswith(f'AUTO.LOITER: failsafe: {UNNAMED}')
    # The name comes a little later.
    arrive(flight, entered(3))
    flight.fly(2.5)
    assert flight.bridge.state(flight.now).endswith(f'AUTO.LOITER: failsafe: {BATTERY}')
    assert f'flock: hands over: failsafe: {BATTERY}' in texts(flight)
    assert not flight.setpoints(flight.now - 1.0)
    # The autopilot names the cause again as it lands.
    arrive(flight, entered(3))
    flight.fly(3.0)
    assert flight.bridge.state(flight.now).endswith(f'AUTO.LOITER: failsafe: {BATTERY}')
    assert sum('hands over' in each for each in texts(flight)) == 1
    flight.fly_until(lambda: False, max(0.0, 7.6 - flight.now))
    assert flight.ask('offboard', True).success
    # A pilot after a failsafe bars offboard from then on.
    flight.controller.pilot_switches('POSCTL')
    flight.fly(1.0)
    assert flight.bridge.gate.permission.taker == PILOT
