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

"""The bridge without ROS, flying the embedded autopilot in simulated time: cycle and end."""

from bridge_flight import BOTH, EAST, Flight
from faulty_autopilot import Fault
import pytest

pytestmark = pytest.mark.slow


def test_offboard_begins_from_hold_and_flies_steady_stream():
    flight = Flight()
    flight.fly(2.1)
    asked = flight.now
    assert flight.ask('offboard', True).success
    # PX4 wants setpoints for 1.5 s first; the mode shows without waiting for a HEARTBEAT.
    assert flight.now - asked < 1.6 and flight.bridge.state(flight.now) == 'ACTIVE'
    flight.planner, start = EAST, flight.now
    flight.cycles.clear()
    flight.fly(2.0)
    assert flight.vehicle.velocity[0] > 0.4 and abs(flight.vehicle.velocity[1]) < 1e-3
    assert len(flight.setpoints(start)) == 40
    # Each of 20 commands shows its latency once.
    first = [cycle.first for cycle in flight.cycles if cycle.first]
    assert [c.time - c.source_time for c in first] == pytest.approx([0.04] * 20)


# The way out.

def test_the_way_out_brakes_and_leaves_the_vehicle_in_hold():
    flight = Flight().follow(2.0)
    start = flight.now
    flight.bridge.stop(start)
    # Nothing lets it follow again.
    assert not flight.bridge.requests.offboard(True, start).outcome.success
    while not flight.bridge.has_stopped(flight.now):
        assert flight.now < start + 5.0, 'the bridge has not stopped'
        flight.fly(0.05)
        assert flight.kinds(1) == {'brake'}
    assert 0.2 < flight.now - start <= 1.0
    flight.bridge.finish(flight.now)
    last = flight.codec.parse_buffer(flight.wire.written[-1])[0]
    assert last.get_type() == 'SET_POSITION_TARGET_LOCAL_NED'
    assert (last.afx, last.afy, last.afz) == (0.0, 0.0, 0.0)
    flight.planner, flight.bridge.cycle = None, lambda now: None  # the bridge is gone
    flight.fly(3.0)
    assert flight.mode == flight.modes.hold and flight.speed < 0.05


@BOTH
def test_pilot_in_control_is_left_alone_at_end_of_bridge(personality):
    flight = Flight(personality).follow(1.0)
    flight.controller.pilot_switches(flight.modes.manual)
    flight.fly(1.2)  # HEARTBEAT comes at 1 Hz
    flight.bridge.stop(flight.now)
    flight.wire.written = []
    flight.bridge.finish(flight.now)
    assert flight.bridge.has_stopped(flight.now) and flight.wire.written == []


@BOTH
@pytest.mark.parametrize(('silence', 'requests'), [(0.8, True), (1.2, False)])
def test_end_of_bridge_requests_hold_while_the_mode_is_known(personality, silence, requests):
    flight = Flight(personality, faults=[Fault('drop', 5.0, 30.0, 'sent')]).follow(1.0)
    assert flight.now < 5.0
    flight.fly(5.0 + silence - flight.now)
    assert flight.bridge.gate.flies
    flight.wire.written = []
    flight.bridge.finish(flight.now)
    kinds = [flight.codec.parse_buffer(written)[0].get_type() for written in flight.wire.written]
    assert ('COMMAND_LONG' in kinds or 'SET_MODE' in kinds) == requests


@BOTH
def test_end_of_bridge_does_not_end_unreported_landing(personality):
    flight = Flight(personality)
    flight.engage()
    flight.bridge.requests.land(flight.now)
    deadline = flight.now + 5.0
    while flight.mode != flight.modes.land:
        assert flight.now < deadline, f'not {flight.modes.land}, but {flight.mode}'
        flight.fly(0.01)
    flight.bridge.stop(flight.now)
    assert flight.bridge.gate.flies and flight.bridge.has_stopped(flight.now)
    flight.bridge.finish(flight.now)
    flight.bridge.cycle = lambda now: None  # the bridge is gone
    flight.fly(1.0)
    assert flight.mode == flight.modes.land
