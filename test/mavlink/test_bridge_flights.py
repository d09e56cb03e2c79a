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

"""Whole flights by the bridge's requests, with and without GPS, over good lines and bad ones."""


from bridge_flight import BOTH, EAST, Flight, without_gps
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.gate.gate import Gate
from flock_follower.mavlink.bridge import Bridge
from flock_follower.mavlink.global_origin import NO_HEIGHT
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder
from flock_follower.mavlink.telemetry import NOISY_CHANGES
from flock_follower.planner.limits import limit_norm

pytestmark = pytest.mark.slow


def forwarding(flight):
    flight.forwards = True
    return flight


@BOTH
def test_two_whole_flights_need_only_the_services(personality):
    flight = Flight(personality, start='landed', ready_after=1.0)
    flight.fly(2.5)
    for _ in range(2):
        for what, arguments in (('arm', [True]), ('takeoff', [2.5]), ('offboard', [True])):
            outcome = flight.ask(what, *arguments, seconds=30.0)
            assert outcome.success, outcome
        assert flight.vehicle.position[2] == pytest.approx(2.5, abs=0.35)
        flight.planner = EAST
        flight.fly(2.0)
        assert flight.mode == flight.modes.offboard and 0.3 < flight.speed < 0.55
        flight.planner = None
        for what, arguments in (('offboard', [False]), ('land', [])):
            assert flight.ask(what, *arguments).success
        assert flight.mode == flight.modes.land
        # Until a HEARTBEAT shows it: asked before, the bridge would arm in LAND.
        flight.fly_until(lambda: not flight.bridge.telemetry.status.armed, 15.0)
        assert flight.vehicle.landed
        assert flight.bridge.state(flight.now).startswith('INACTIVE')


# Without GPS.


def forwarded_error(flight):
    """Return the mean error of the forwarded vertical velocity in the next second, m/s."""
    errors = []
    for _ in range(20):
        flight.fly(0.05)
        reported = [m for _, m in flight.received if m.get_type() == 'ODOMETRY'][-1]
        errors.append(-reported.vz - flight.vehicle.velocity[2])  # it is almost level
    return float(np.mean(errors))


def test_forwarded_climb_is_corrected_by_barometer():
    """The autopilot's height follows it, in the hold mode too: on real ones to the ground."""
    flight = forwarding(Flight(**without_gps('px4')))
    flight.engage()
    flight.odom_error[2] = -0.8
    flight.fly(4.0)
    assert forwarded_error(flight) == pytest.approx(0.0, abs=0.1)


@BOTH
@pytest.mark.parametrize(('step', 'seconds', 'least', 'most'), [
    (0.5, 0.0, 0.7, 2.0), (1.0, 0.0, 1.3, 2.0), (-3.0, 0.0, 1.9, 2.4), (2.0, 0.5, 0.35, 2.0),
    (1.4, 1.4, 0.4, 2.0)])
def test_diverging_climb_of_fused_odometry_ends_flight_in_time(
        personality, step, seconds, least, most):
    """The vehicle, which held the wrong velocity, was on the ground after 2 s."""
    flight = forwarding(Flight(personality, **without_gps(personality)))
    flight.odom_displacement = np.zeros(3)
    flight.engage()
    begun, heights = flight.now + 3.0, []
    while flight.now < begun + 7.0:
        part = (flight.now - begun) / max(seconds, 1e-3)
        flight.odom_error[2] = step * min(max(part, 0.0), 1.0)
        flight.planner = limit_norm(-2.0 * (flight.vehicle.velocity + flight.odom_error), 2.0)
        flight.fly(0.1)
        if flight.bridge.gate.permission.streams:
            heights.append(flight.vehicle.position[2])
    assert not flight.bridge.gate.permission.streams
    assert least < min(heights) and max(heights) < most


@BOTH
@pytest.mark.parametrize('before', [0.5, -0.5])  # s, from the odometry's error to the loss
def test_error_of_fused_climb_is_corrected_without_barometer(personality, before):
    """In the hold mode, too: both sank at 1 m/s from one second after the loss on."""
    flight = forwarding(Flight(personality, **without_gps(personality)))
    flight.engage()
    flight.fly(3.0)
    lost = Fault('drop', flight.now + max(before, 0.0), direction='sent',
                 message='SCALED_PRESSURE')
    flight.autopilot._sent._faults.append(lost)
    flight.fly(max(-before, 0.0))
    flight.odom_error[2] = 1.0
    flight.fly_until(lambda: not flight.bridge.gate.permission.streams, 6.0)
    assert not flight.bridge.gate.permission.streams and flight.vehicle.position[2] > 1.0
    assert forwarded_error(flight) == pytest.approx(0.0, abs=0.25)


@BOTH
def test_stuck_barometer_corrects_nothing_and_is_lost(personality):
    """It denied a climb, which the vehicle then flew faster."""
    flight = forwarding(Flight(personality, **without_gps(personality)))
    flight.engage()
    flight.fly(3.0)
    flight.bridge.telemetry._changes = NOISY_CHANGES  # as on the ground
    flight.autopilot.barometer.heights = lambda *_: np.array([490.0])
    for _ in range(12):
        flight.planner = np.array([0.0, 0.0, 2.0 * (0.4 - flight.vehicle.velocity[2])])
        flight.fly(0.1)
    assert flight.reason == 'height stale'
    assert forwarded_error(flight) == pytest.approx(0.0, abs=0.1)


@BOTH
@pytest.mark.parametrize('after', [-0.5, 0.1, 1.0])  # s, from the odometry to the barometer
def test_two_faults_of_the_height_do_not_end_on_the_ground(personality, after):
    flight = forwarding(Flight(personality, **without_gps(personality)))
    flight.odom_displacement = np.zeros(3)
    flight.engage()
    begun, heights, measured = flight.now + 3.0, [], flight.autopilot.barometer.heights
    flight.autopilot.barometer.heights = lambda true, now: measured(true, now) + 2.0 * (
        now > begun + after)
    while flight.now < begun + 6.0:
        flight.odom_error[2] = 2.0 * (flight.now > begun)
        flight.planner = limit_norm(-2.0 * (flight.vehicle.velocity + flight.odom_error), 2.0)
        flight.fly(0.1)
        if flight.bridge.gate.permission.streams:
            heights.append(flight.vehicle.position[2])
    assert min(heights) > 0.8 and max(heights) < 2.5


@pytest.mark.parametrize(('personality', 'action'), [
    ('px4', 'silence'), ('px4', 'land'), ('arducopter', 'land')])
def test_lost_odometry_behind_autopilot_estimate_ends_stream(personality, action):
    flight = forwarding(Flight(personality, **without_gps(personality, blind_action=action)))
    flight.follow(2.0)
    lost, flight.forwards, flight.odometry = flight.now, False, False
    flight.fly(0.4)
    # It brakes before the autopilot notices.
    assert (flight.reason, flight.kinds(1)) == ('velocity from odom stale', {'brake'})
    flight.fly(0.6)
    silent = max(t for t, m in flight.received if m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED')
    assert 0.6 < silent - lost < 0.85
    assert flight.bridge.state(flight.now) == 'INACTIVE: fell silent: velocity from odom stale'
    flight.forwards = flight.odometry = True  # it comes back: setpoints alone would end a failsafe
    flight.fly(2.0)
    assert not flight.setpoints(silent + 0.01)
    landing = flight.bridge.blind_landing
    assert (landing is not None and landing.outcome.success) == (action == 'land')
    assert action == 'land' or not flight.commands(mavlink.MAV_CMD_DO_SET_MODE, lost)


@pytest.mark.parametrize('disarms', [False, True])
def test_a_blind_landing_is_not_reported_in_the_next_flight(disarms):
    """PX4 1.18: /diagnostics showed 'the bridge requests land' through the whole flight."""
    flight = forwarding(Flight(**without_gps('px4', blind_action='land'))).follow(2.0)
    flight.forwards = flight.odometry = False
    flight.fly(1.0)
    assert flight.bridge.blind_landing.outcome.success
    flight.forwards = flight.odometry = True
    flight.fly(1.5)
    if disarms:
        flight.fly_until(lambda: not flight.bridge.telemetry.status.armed, 15.0)
    else:
        outcome = flight.ask('offboard', True)
        assert outcome.success, outcome
    flight.fly(0.1)
    assert flight.bridge.blind_landing is None


@BOTH
def test_a_handover_is_not_reported_in_the_next_flight(personality):
    """Neither if nobody calls a service: the pilot lands, and arms again."""
    flight = Flight(personality).follow(2.0)
    flight.planner = None
    flight.fly(4.0)
    assert flight.bridge.handover.outcome.success
    flight.controller.pilot_switches(flight.modes.land)
    flight.fly_until(lambda: not flight.bridge.telemetry.status.armed, 15.0)
    flight.fly(0.1)
    assert flight.bridge.handover is None


@BOTH
@pytest.mark.parametrize('ends', [False, True])
def test_a_pilot_who_took_over_on_a_dead_line_is_left_alone(personality, ends):
    """Without odometry, too, the bridge falls silent; it may not know the mode any more."""
    dead = [Fault('drop', 6.0, direction='sent')]
    flight = Flight(personality, faults=dead).follow(2.0)
    flight.fly_until(lambda: flight.now > 6.0, 10.0)
    flight.odometry = False
    flight.fly(0.5)
    flight.controller.pilot_switches(flight.modes.manual)
    flight.fly(1.0)
    if ends:
        flight.bridge.stop(flight.now)
        flight.bridge.finish(flight.now)
    flight.fly(4.0)
    assert flight.mode == flight.modes.manual


@BOTH
def test_bridge_restarted_in_a_take_off_knows_its_height(personality):
    flight = Flight(personality, start='armed', parameters={'MIS_TAKEOFF_ALT': 8.0} if (
        personality == 'px4') else {})
    flight.fly(7.0)
    flight.bridge.requests.takeoff(8.0, flight.now)
    flight.fly_until(lambda: flight.vehicle.position[2] > 4.0, 20.0)
    flight.bridge = Bridge(Link(flight.wire), Gate(), now=flight.now)
    flight.fly(8.0)
    assert flight.bridge.gate.heights.height(flight.now) == pytest.approx(
        flight.vehicle.position[2], abs=0.3)


def test_congested_line_sends_setpoints_and_no_odometry():
    flight = forwarding(Flight(**without_gps('px4')))
    flight.engage()
    flight.wire.is_congested, start = lambda: True, flight.now
    flight.fly(0.4)
    assert len(flight.setpoints(start)) == 8
    assert not [m for t, m in flight.received if m.get_type() == 'ODOMETRY' and t > start]
    assert flight.bridge.forwarder.counters['not sent'] > 5


GIVEN = (47.4, 8.5, 488.0)


def told_origins(flight):
    return [(m.latitude, m.longitude, m.altitude) for _, m in flight.received
            if m.get_type() == 'SET_GPS_GLOBAL_ORIGIN']


def forwarded(flight):
    return [time for time, m in flight.received if m.get_type() == 'ODOMETRY']


@pytest.mark.parametrize(('personality', 'options', 'told'), [
    # PX4 is told an origin without height, and any where it flies without GPS.
    ('px4', without_gps('px4'), [(473977420, 85455940, NO_HEIGHT)]),
    ('px4', without_gps('px4', origin=GIVEN), [(474000000, 85000000, NO_HEIGHT)]),
    ('px4', {'bridge': {'forwarder': OdometryForwarder(30.0)}}, []),
    # Until it shows that it has one.
    ('arducopter', {'bridge': {'origin': GIVEN}, 'faults': [
        Fault('drop', 0.0, 8.0, 'sent', message='GPS_GLOBAL_ORIGIN')]},
     2 * [(474000000, 85000000, 488000)])])
def test_an_origin_is_told_until_the_autopilot_has_one(personality, options, told):
    flight = forwarding(Flight(personality, start='landed', **options))
    # One that is lost is sent again after 5 s.
    flight.fly(8.0 if len(told) > 1 else 4.0)
    assert told_origins(flight) == told
    origin = mavlink.MAVLink_gps_global_origin_message(474000000, 85000000, 488000)
    flight.wire.arrived.append(origin.pack(mavlink.MAVLink(None, 1, 1)))
    flight.fly(5.5)
    assert told_origins(flight) == told


def test_odometry_waits_for_the_origin_on_the_ground():
    """PX4 1.18 moves its estimate by 5,000 km if the origin comes after vision."""
    flight = forwarding(Flight(start='landed', **without_gps('px4')))
    flight.fly(6.0)
    told = [time for time, m in flight.received if m.get_type() == 'SET_GPS_GLOBAL_ORIGIN']
    assert len(told) == 1 and told[0] < min(forwarded(flight)) < 4.0


def test_in_the_air_odometry_never_waits_and_no_origin_is_told():
    flight = forwarding(Flight(**without_gps('px4')))
    flight.fly(4.0)
    assert min(forwarded(flight)) < 1.0 and not told_origins(flight)


def test_an_origin_that_is_never_returned_refuses_offboard():
    flight = forwarding(Flight(start='landed', **without_gps('px4'), faults=[
        Fault('drop', 0.0, 60.0, 'sent', message='GPS_GLOBAL_ORIGIN')]))
    flight.fly(8.0)
    assert not forwarded(flight) and len(told_origins(flight)) >= 3
    assert 'GPS_GLOBAL_ORIGIN returned' in flight.bridge.refusal(flight.now)


def test_an_origin_comes_too_late_for_an_estimate_that_has_begun():
    """A restarted bridge asks for the origin; without one the autopilot needs a reboot."""
    flight = forwarding(Flight(start='landed', **without_gps('px4'), faults=[
        Fault('drop', 0.0, 60.0, 'sent', message='GPS_GLOBAL_ORIGIN')]))
    while not flight.bridge.telemetry.estimator or not (
            flight.bridge.telemetry.estimator.has_velocity):
        flight.bridge.housekeeping.origin.awaited = False
        flight.fly(0.05)
        assert flight.now < 20.0
    flight.bridge.housekeeping.origin.begin_again()  # as if the bridge were another one
    flight.fly(3.0)
    assert 'reboot it' in flight.bridge.refusal(flight.now)
