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

"""On the ground no setpoint leaves, whatever the noise: upward ones start PX4's take-off."""

from bridge_flight import Flight
import numpy as np
import pytest

from flock_follower.gate.gate import Gate
from flock_follower.gate.permission import Cause, Permission
from flock_follower.gate.setpoint_rules import NONE
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.gate.velocity_check import MotionReport

pytestmark = pytest.mark.slow
OURS = VehicleStatus(True, 'OFFBOARD', True)


def test_a_false_landed_report_in_flight_removes_no_thrust(monkeypatch):
    flight = Flight().follow(1.0)
    monkeypatch.setattr(flight.bridge.telemetry, 'is_flying', lambda now: False)
    flight.fly(2.5)
    assert flight.bridge.state(flight.now) == 'ACTIVE' and flight.kinds(40) == {'command'}


@pytest.mark.parametrize('height', [0.2, None])
def test_landed_report_near_ground_ends_permission_after_1_s(height):
    control = Gate(velocity_source='odom')
    control.permit(Permission().request(0.0))
    ended = []
    for k in range(60):
        now = 1.0 + 0.05 * k
        control.take_motion('odom', MotionReport(np.zeros(3)), 0.0, now)
        if height is not None:
            control.take_height(50.0, now)
            if k == 0:
                control.heights.refer(height, now)
        control.take_status(OURS, now, airborne=k < 20)
        ended.append(control.decide(now)[0].kind == NONE)
    assert ended.index(True) == 40 and all(ended[40:])
    assert control.permission == Permission(
        reason='on the ground', received=control.permission.received, cause=Cause.LANDED)
