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

"""Who sends: devices by their names, two vehicles with one system id, and what is no twin."""

import random

from bridge_flight import Flight
from faulty_autopilot import Fault, FaultyAutopilot
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink
import pytest
from test_link import Bench

from flock_follower.mavlink.identity import (
    FORWARD_FLIGHT,
    Identity,
    not_hovering,
    SECOND_BRIDGE,
    TWO_VEHICLES,
)

VTOL, QUADROTOR = mavlink.MAV_TYPE_VTOL_TILTROTOR, mavlink.MAV_TYPE_QUADROTOR
HOVERS, FORWARD = mavlink.MAV_VTOL_STATE_MC, mavlink.MAV_VTOL_STATE_FW


def heartbeat(kind=QUADROTOR, autopilot=mavlink.MAV_AUTOPILOT_PX4):
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 1, 6 << 16, 4, 3)


def attitude(boot_ms):
    return mavlink.MAVLink_attitude_quaternion_message(boot_ms, 1.0, 0, 0, 0, 0, 0, 0)


def position(x, y=0.0, speed=0.0):
    return mavlink.MAVLink_local_position_ned_message(0, x, y, -2.0, speed, 0, 0)


@pytest.mark.parametrize(('target', 'given', 'own'), [(1, 0, 1), (2, 0, 2), (7, 0, 7), (2, 9, 9)])
def test_all_messages_bear_vehicle_system_id_unless_set(target, given, own):
    bench = Bench(target_system=target, source_system=given)
    bench.beats('vehicle', system=target)
    for send in (bench.link.send_heartbeat, lambda: bench.link.request_parameter('A'),
                 lambda: bench.link.send_command(mavlink.MAV_CMD_DO_SET_MODE, (1.0,))):
        assert send() and bench.written().get_srcSystem() == own
    ours = mavlink.MAVLink_command_ack_message(1, 0, 0, 0, own, 191)
    assert bench.link.questions.is_addressed(ours) == bench.link.questions.is_addressed(
        mavlink.MAVLink_command_ack_message(1, 0)) is True


@pytest.mark.parametrize(('message', 'system', 'component', 'named'), [
    # A SiK radio: its ids are the letters 3 and D.
    (mavlink.MAVLink_radio_status_message(90, 90, 99, 20, 20, 0, 0), 51, 68,
     'of a telemetry radio (system id 51, component 68)'),
    (heartbeat(), 1, 100, 'of a camera (system id 1, component 100)'),
    (heartbeat(mavlink.MAV_TYPE_CAMERA), 1, 1,
     'of a camera that sends as an autopilot (component 1)'),
    (heartbeat(mavlink.MAV_TYPE_GCS, 8), 255, 190,
     'of a ground station (system id 255, component 190)'),
    (heartbeat(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8), 1, 191,
     'of a companion computer (system id 1, component 191)'),
    (heartbeat(mavlink.MAV_TYPE_GROUND_ROVER), 1, 1,
     "of PX4 GROUND_ROVER, which autopilot = 'auto' does not send")])
def test_sender_that_is_no_vehicle_is_named_as_what_it_is(
        message, system, component, named):
    bench = Bench()
    bench.sends('line', message, system=system, component=component)
    assert bench.link.receive(1.0) == [] and dict(bench.link.ignored) == {named: 1}
    assert bench.link.telemetry.dialect is None and bench.link.transport.peer is None


@pytest.mark.parametrize(('kind', 'state', 'flies'), [
    (QUADROTOR, None, True), (QUADROTOR, 0, True), (QUADROTOR, FORWARD, False),
    (VTOL, HOVERS, True), (VTOL, None, False), (VTOL, 0, False), (VTOL, FORWARD, False),
    (VTOL, mavlink.MAV_VTOL_STATE_TRANSITION_TO_FW, False),
    (VTOL, mavlink.MAV_VTOL_STATE_TRANSITION_TO_MC, False)])
def test_vtol_flies_our_setpoints_only_while_it_hovers(kind, state, flies):
    assert not_hovering(kind, state).startswith(FORWARD_FLIGHT) != flies


def test_offboard_is_refused_in_forward_flight():
    flight = Flight()
    report = flight.autopilot._status
    flight.autopilot._status = lambda name, now: (
        (FORWARD, flight.controller.landed_state) if name == 'EXTENDED_SYS_STATE'
        else report(name, now))
    flight.fly(2.0)
    assert flight.ask('offboard', True).message.startswith(f'offboard refused: {FORWARD_FLIGHT}')


class Twin:
    """A second vehicle on the line of a flight, booted earlier, at another place, or neither."""

    def __init__(self, flight, boot=0.0, east=0.0, share=1.0):
        self.flight, self.boot, self.random = flight, boot, random.Random(1)
        self.autopilot, self.share = FaultyAutopilot(now=0.0), share
        self.autopilot.vehicle.position[0] = east
        self.autopilot._codec.seq = 100
        line, step = flight.wire, flight.autopilot.step

        def both(now):
            line.arrived += [data for data in self.autopilot.step(now + boot)
                             if self.random.random() < share]
            return step(now)
        flight.autopilot.step = both


@pytest.mark.parametrize(('twin', 'evidence'), [
    ({'boot': 100.0}, 'times of boot'), ({'east': 12.0}, 'positions'), ({}, 'sequence numbers'),
    ({'boot': 100.0, 'east': 12.0, 'share': 0.7}, 'times of boot')])
def test_two_vehicles_with_one_id_are_named_offboard_refused(
        twin, evidence):
    flight = Flight(source='autopilot')
    Twin(flight, **twin)
    flight.fly(3.0)
    refusal = flight.bridge.refusal(flight.now)
    assert refusal.startswith(TWO_VEHICLES) and evidence in refusal
    assert flight.ask('offboard', True).message == f'offboard refused: {refusal}'


def test_two_vehicles_at_two_addresses_are_named():
    for stamped in (False, True):
        bench, now = Bench(), 0.0
        while now < 8.0:
            now += 0.5
            for peer, boot in (('first', 1000), ('second', 90_000)):
                bench.beats(peer, now=now)
                if stamped:
                    bench.sends(peer, attitude(boot + round(now * 1e3)))
        assert bench.link.transport.peer == 'first'
        assert ('times of boot' if stamped else 'addresses') in bench.link.identity.conflict(now)
        assert bench.link.identity.conflict(now + 6.0) == ''  # the second one was switched off


@pytest.mark.parametrize('echo', [False, True])
def test_second_bridge_on_vehicle_is_named_our_echo_is_not(echo):
    bench, other = Bench(), mavlink.MAVLink(None, 1, 191)
    ours = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3)
    for second in range(1, 6):
        bench.beats('vehicle', now=float(second))
        assert bench.link.send_heartbeat()
        other.seq = 100 + second
        data = bench.link.transport.written[-1] if echo else bytes(ours.pack(other))
        bench.link.transport.arrived.append((data, 'vehicle'))
        bench.link.receive(second + 0.5)
    assert bench.link.identity.conflict(6.0).startswith(SECOND_BRIDGE) != echo
    assert bench.link.identity.conflict(12.0) == ''  # the other one has ended


def test_one_vehicle_by_two_addresses_is_no_second_one():
    bench, now = Bench(), 0.0
    while now < 8.0:
        now += 0.1
        for peer in ('first', 'second'):
            bench.sends(peer, attitude(1000 + round(now * 1e3)), position(1.0))
            bench.beats(peer, now=now)
    assert bench.link.identity.conflict(now) == ''


@pytest.mark.parametrize(('boot', 'x', 'changes'), [
    (1000, 0.3, 0), (90_000, 0.3, 1), (1000, 60.0, 1), (None, 0.3, 1), (1000, None, 1)])
def test_a_restarted_router_is_not_another_vehicle(boot, x, changes):
    bench = Bench()
    for now in (1.0, 1.1, 1.2):
        bench.sends('before', attitude(1000 + round(now * 1e3)), position(0.0))
        bench.beats('before', now=now)
    for now in (3.3, 3.4, 3.5):
        messages = [*([attitude(boot + round(now * 1e3))] if boot else []),
                    *([position(x)] if x is not None else [])]
        bench.sends('after', *messages)
        bench.beats('after', now=now)
    assert bench.link.transport.peer == 'after' and bench.link.peer_changes == changes


def test_a_flight_goes_on_after_a_restart_of_the_router():
    flight = Flight(faults=[Fault('drop', 5.0, 2.1)]).follow(1.0)
    flight.fly_until(lambda: flight.now >= 6.0, 5.0)
    flight.wire.source = 'another port'
    flight.fly_until(lambda: flight.now >= 9.0, 5.0)
    assert flight.wire.peer == 'another port' and flight.bridge.link.peer_changes == 0
    assert flight.bridge.state(flight.now) == 'ACTIVE' and flight.kinds(5) == {'command'}


@settings(max_examples=40)
@given(st.integers(0, 2**32), st.floats(0.0, 0.3), st.floats(0.0, 0.9))
def test_one_vehicle_on_a_bad_line_is_never_two(seed, lost, delay):
    chance, identity, number, x = random.Random(seed), Identity(), 0, 0.0
    codec, arrived = mavlink.MAVLink(None, 1, 1), []
    start, last = 50.0, 0.0
    for step in range(400):  # 8 s
        now = 0.02 * step
        x += 0.02 * 12.0
        if step == 150:
            x += 300.0  # its estimate is reset
        if step == 250:
            start, number = now, 0  # a reboot
        for message in (attitude(round((now + start if start == 50.0 else now - start) * 1e3)),
                        position(x, speed=12.0), *([heartbeat()] if step % 50 == 0 else [])):
            codec.seq, number = number, (number + 1) % 256
            message.pack(codec)
            # The line delays, and it reorders a little.
            last = max(last + 1e-3, now + chance.random() * delay)
            if chance.random() >= lost and not 100 <= step < 110:
                arrived.append((last + 3e-3 * chance.random(), len(arrived), message))
    for time, _, message in sorted(arrived):
        identity.take(message, 'line', True, time)
        assert identity.conflict(time) == ''
