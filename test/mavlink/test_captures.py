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

"""What the bridge makes of bytes that the real autopilots sent, and whether ours send the like."""

import math

from captured import captured, decoded, link
from embedded_flight import BLIND, Flight, odometry, setpoint
import pytest

from flock_follower.gate.gate import Gate
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.mavlink.bridge import Bridge
from flock_follower.mavlink.commands import arm, hold, offboard, Request, Vehicle
from flock_follower.mavlink.dialects import PX4
from flock_follower.mavlink.status_texts import StatusTexts


def received(name, until=math.inf, **options):
    """Return a bridge that has heard a capture up to a time, s."""
    bridge = Bridge(link(**options), Gate(), now=0.0)
    for time, data in captured(name):
        if time <= until:
            bridge.link.transport.arrived.append(data)
            bridge.receive(time)
    return bridge


@pytest.mark.parametrize('name', [
    'px4_refusals', 'px4_vision_lost', 'px4_1.18_refusals', 'px4_1.18_vision_lost',
    'px4_1.18_fence', 'px4_1.18_stick'])
def test_every_message_of_px4_is_understood(name):
    assert not {*received(name).link.ignored} - {
        'before HEARTBEAT', 'LOCAL_POSITION_NED is invalid according to its estimator'}


UNPLACED = ['no valid position estimate', 'no global position (neither GPS nor an origin)']


@pytest.mark.parametrize(('name', 'time', 'mode', 'reasons'), [
    ('px4_refusals', 3.0, 'AUTO.LOITER', UNPLACED),
    ('px4_refusals', 5.0, 'AUTO.LOITER', []),
    ('px4_refusals', 5.0, 'OFFBOARD', ['no setpoint stream']),
    ('px4_refusals', 36.0, 'AUTO.LAND', ['it does not arm in this mode']),
    ('px4_refusals', 58.4, 'OFFBOARD', []),
    ('px4_refusals', 60.7, 'OFFBOARD', ['no setpoint stream']),
    ('px4_1.18_refusals', 5.0, 'AUTO.LOITER', ['estimator heading no source', *UNPLACED]),
    ('px4_1.18_refusals', 20.0, 'AUTO.LOITER', []),
    ('px4_1.18_refusals', 37.9, 'OFFBOARD', ['no setpoint stream']),
    ('px4_1.18_refusals', 26.0, 'AUTO.LAND', ['it does not arm in this mode']),
    ('px4_1.18_refusals', 44.0, 'OFFBOARD', []),
    ('px4_1.18_refusals', 50.0, 'OFFBOARD', ['no setpoint stream'])])
def test_px4_reports_refusals_without_ground_station(name, time, mode, reasons):
    assert received(name, time).texts.against(mode) == reasons


def test_px4s_failsafe_is_told_and_ended_by_setpoints_alone():
    bridge = received('px4_refusals', 60.8)
    assert bridge.texts.since(60.0) == ['failsafe: Position']
    modes = [bridge.telemetry.dialect.mode_name(m.custom_mode) for t, m in decoded('px4_refusals')
             if m.get_type() == 'CURRENT_MODE' and 58.0 < t < 64.2]
    assert [b for a, b in zip(['', *modes], modes) if a != b] == [
        'AUTO.LOITER', 'OFFBOARD', 'POSCTL', 'OFFBOARD']


def flags(name, kind, end):
    """Return the changes of an estimator's flags, and s since the vision ended."""
    changes, known = [], None
    for time, message in decoded(name):
        if message.get_type() == kind and message.flags != known:
            known = message.flags
            changes.append((time - end, known))
    return changes


def lost(personality, seconds):
    """Return a flight that was flown by vision, in the air, and s after it ended."""
    flight = Flight(personality, parameters=BLIND[personality])
    flight.fly(1.5, lambda: odometry(
        flight.vehicle.position, flight.vehicle.rotation.T @ flight.vehicle.velocity), setpoint(),
        rate=30.0)
    flight.mode('OFFBOARD' if personality == 'px4' else 'GUIDED')
    flight.messages.clear()
    flight.fly(seconds, setpoint())
    return flight


@pytest.mark.parametrize(('personality', 'name', 'kind', 'end', 'seconds'), [
    ('px4', 'px4_vision_lost', 'ESTIMATOR_STATUS', 63.63, 7.0),
    ('arducopter', 'ardupilot_vision_lost', 'EKF_STATUS_REPORT', 41.06, 16.0)])
def test_embedded_estimator_gives_up_when_real_one_does(
        personality, name, kind, end, seconds):
    real = flags(name, kind, end)
    flight, states, known = lost(personality, 0.01), [], None
    for step in range(round(seconds / 0.1)):
        now = flight.autopilot.estimator_flags(flight.now)
        if now != known:
            states.append((step * 0.1, now))
            known = now
        flight.fly(0.1, setpoint())
    assert [value for _, value in states] == [value for _, value in real]
    for (ours, _), (theirs, _) in zip(states[1:], real[1:]):
        assert ours == pytest.approx(theirs, abs=0.6)


def test_ardupilots_words_say_why():
    bridge = received('ardupilot_refusals')
    assert {'Arm: VisOdom: not healthy', 'PreArm: VisOdom: not healthy',
            'Arm: Need Position Estimate'} <= set(bridge.texts.since(0.0))


@pytest.mark.parametrize(('goal', 'mode', 'since', 'message'), [
    (arm(PX4, True), 'AUTO.LOITER', 2.0,
     'arm refused: temporarily rejected: no valid position estimate; no global position (neither '
     'GPS nor an origin)'),
    (offboard(PX4), 'AUTO.LOITER', 60.6,
     'offboard refused: temporarily rejected: failsafe: Position; no setpoint stream'),
    (hold(PX4), 'OFFBOARD', 58.0,
     'hold refused: temporarily rejected; POSCTL refused: temporarily rejected: no transmitter; '
     'AUTO.LAND refused: temporarily rejected: PX4 sends the cause only to a ground station: look '
     'there, or set announce_as_gcs')])
def test_a_refusal_tells_its_cause(goal, mode, since, message):
    status = VehicleStatus(goal.name != 'arm', mode, mode == 'OFFBOARD')
    request, texts = Request(PX4, goal, since), StatusTexts()
    vehicle = Vehicle(status, None, since)
    now = since
    while request.outcome is None:
        assert now < since + 60.0, f'no outcome of {goal.name}'
        for time, event in decoded('px4_refusals'):
            if event.get_type() == 'EVENT' and now - 0.1 < time <= now and time < since + 0.5:
                texts.add_event(event, time)
        if request.step(vehicle, streaming_for=9.0, texts=texts, now=now) is not None:
            assert request.acknowledge(request.current.command, 1, now)
            assert not request.acknowledge(request.current.command, 1, now)  # ask once
        now += 0.1
    assert request.outcome == (False, message)
