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

"""PX4's take-off states and land detector, and what they make of setpoints on the ground."""

import random

from embedded_flight import Flight, setpoint
from pymavlink.dialects.v20 import all as mavlink

NEVER_DISARM = {'COM_DISARM_PRFLT': -1.0}
BRAKE_TIME = 0.3  # s
ON_GROUND, IN_AIR = mavlink.MAV_LANDED_STATE_ON_GROUND, mavlink.MAV_LANDED_STATE_IN_AIR


def armed_on_the_ground(personality='px4', thrust_error=0.3):
    """Return a vehicle that is armed on the ground in the mode that takes setpoints."""
    px4 = personality == 'px4'
    flight = Flight(personality, start='armed',
                    parameters=NEVER_DISARM if px4 else {'DISARM_DELAY': 0})
    flight.vehicle.thrust_error = thrust_error
    flight.fly(1.5, setpoint())
    assert flight.mode('OFFBOARD' if px4 else 'GUIDED')[-1] == mavlink.MAV_RESULT_ACCEPTED
    return flight


def braking(deviation, seed=1):
    """Return a function for setpoints that brake a vehicle at rest, of noisy odometry, m/s."""
    noise = random.Random(seed)
    return lambda: setpoint(*(noise.gauss(0.0, deviation) / BRAKE_TIME for _ in range(3)))


def test_braking_by_noisy_odometry_on_the_ground_takes_px4_off():
    flight = armed_on_the_ground()
    flight.fly(1.0, braking(0.005))
    assert flight.controller.landed_state == IN_AIR
    flight.fly(20.0, braking(0.005))
    assert flight.vehicle.position[2] > 1.0


def test_without_an_upward_setpoint_px4_idles_on_the_ground():
    flight = armed_on_the_ground()
    flight.fly(15.0, setpoint(0.1, -0.1, 0.0))
    assert flight.vehicle.position[2] == 0.0 and flight.vehicle.thrust < 2.0
    assert flight.controller.landed_state == ON_GROUND and flight.controller.armed


def test_one_upward_setpoint_takes_px4_off():
    flight = armed_on_the_ground(thrust_error=0.35)  # 0.3 is lost on the ground
    flight.fly(0.2, setpoint(0.0, 0.0, 0.001))
    flight.fly(3.0, setpoint())
    assert flight.vehicle.position[2] > 0.3


def test_a_take_off_climbs_along_a_ramp():
    flight = Flight(start='armed')
    flight.take_off(float('nan'))
    flight.fly(1.5)
    assert flight.vehicle.position[2] == 0.0  # the ramp begins without thrust
    flight.fly(1.0)
    assert 0.0 < flight.controller._ramp < 1.0
    flight.fly(5.0)
    assert flight.vehicle.position[2] > 2.0


def test_px4_touching_ground_in_offboard_is_not_landed():
    flight = armed_on_the_ground()
    flight.fly(3.0, setpoint(0.0, 0.0, 0.5))
    assert flight.vehicle.position[2] > 1.0
    flight.fly(8.0, setpoint(0.0, 0.0, -1.0))
    assert flight.vehicle.position[2] == 0.0 and flight.controller.landed_state == IN_AIR
    assert flight.arm(False) == [mavlink.MAV_RESULT_TEMPORARILY_REJECTED]
    assert flight.mode('AUTO.LAND') == [0, 0]
    flight.fly(0.9)
    assert flight.controller.landed_state != ON_GROUND
    flight.fly(0.2)
    assert flight.controller.landed_state == ON_GROUND


def test_braking_by_noise_on_ground_does_not_move_arducopter():
    flight = armed_on_the_ground('arducopter')
    flight.fly(15.0, braking(0.02))
    assert flight.vehicle.position[2] == 0.0 and flight.vehicle.thrust < 2.0
    assert flight.controller.landed_state == ON_GROUND and flight.controller.armed
