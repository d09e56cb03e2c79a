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

"""ArduCopter's BRAKE mode: it stops the vehicle quickly and holds its position."""

from embedded_flight import BLIND, Flight, odometry, setpoint
import numpy as np
from pymavlink.dialects.v20 import all as mavlink


def test_brake_stops_quickly_and_holds_the_position():
    flight = Flight('arducopter')
    assert flight.mode('GUIDED') == [0]
    flight.fly(2.0, setpoint(1.0, 0.0, 0.3))
    assert flight.vehicle.velocity[0] > 1.5
    assert flight.mode('BRAKE') == [0]
    begun = flight.vehicle.position.copy()
    flight.fly(1.0, setpoint(1.0, 0.0, 0.3))
    assert flight.last_heartbeat().custom_mode == 17
    assert np.linalg.norm(flight.vehicle.velocity) < 0.25
    assert flight.vehicle.position[0] - begun[0] < 0.9
    flight.fly(2.0, setpoint(1.0))
    held = flight.vehicle.position.copy()
    flight.fly(10.0, setpoint(1.0))
    np.testing.assert_allclose(flight.vehicle.position, held, atol=0.05)


def test_brake_is_refused_without_a_position():
    flight = Flight('arducopter', parameters=BLIND['arducopter'])
    still = odometry((0.0, 0.0, 2.0))
    flight.fly(1.5, still, rate=30.0)
    flight.fly(7.5)
    assert flight.mode('BRAKE') == [mavlink.MAV_RESULT_FAILED]
    assert flight.texts()[-1] == 'Mode change to BRAKE failed: requires position'
    assert flight.mode('LAND') == [0]
