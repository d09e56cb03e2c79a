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

"""A flight of the embedded autopilot in simulated time, for tests."""

import math

from faulty_autopilot import FaultyAutopilot
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.embedded import STEP_TIME

MASK_YAW, MASK = 0x83F, 0xC3F
#: DO_SET_MODE's param2 and param3.
PX4_MODES = {'POSCTL': (3, 0), 'AUTO.TAKEOFF': (4, 2), 'AUTO.LOITER': (4, 3), 'AUTO.LAND': (4, 6),
             'OFFBOARD': (6, 0)}
ARDUCOPTER_MODES = {'STABILIZE': (0, 0), 'GUIDED': (4, 0), 'LOITER': (5, 0),
                    'LAND': (9, 0), 'BRAKE': (17, 0)}
#: Parameters of flight by external vision, without GPS.
BLIND = {
    'px4': {'EKF2_GPS_CTRL': 0, 'EKF2_EV_CTRL': 15, 'EKF2_HGT_REF': 3},
    'arducopter': {'VISO_TYPE': 1, 'GPS1_TYPE': 0, **{
        f'EK3_SRC1_{what}': 6 for what in ('POSXY', 'POSZ', 'VELXY', 'VELZ', 'YAW')}}}


def setpoint(east=0.0, north=0.0, up=0.0, *, mask=MASK_YAW, yaw=0.0, frame=1, target=1):
    """Return a SET_POSITION_TARGET_LOCAL_NED; yaw is ENU."""
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, target, 1, frame, mask, *[0.0] * 6, north, east, -up, math.pi / 2 - yaw, 0.0)


def odometry(position, velocity=(0.0, 0.0, 0.0), *, yaw=0.0, frame=mavlink.MAV_FRAME_LOCAL_FRD,
             child=mavlink.MAV_FRAME_BODY_FRD, variance=0.01, reset_counter=0,
             time=0.0):
    """Return an ODOMETRY of an ENU pose and an FLU velocity."""
    half = (math.pi / 2 - yaw) / 2
    covariance = [variance] * 21
    x, y, z = position
    forward, left, up = velocity
    return mavlink.MAVLink_odometry_message(
        round(time * 1e6), frame, child, y, x, -z,
        (math.cos(half), 0.0, 0.0, math.sin(half)), forward, -left, -up, 0.0, 0.0, 0.0,
        covariance, covariance, reset_counter, mavlink.MAV_ESTIMATOR_TYPE_VIO, 100)


def seen(flight, error=(0.0, 0.0, 0.0), yaw_error=0.0, **options):
    """Return a function for ODOMETRY of the flight's truth, and an error."""
    def message():
        velocity = flight.vehicle.rotation.T @ flight.vehicle.velocity
        return odometry(flight.vehicle.position + error, velocity,
                        yaw=flight.vehicle.yaw + yaw_error, **options)
    return message


class SteppedAutopilot:
    """An embedded autopilot on a clock of steps, and what decodes its bytes."""

    def __init__(self, personality, **options):
        self.autopilot = FaultyAutopilot(personality, now=0.0, **options)
        self.codec = mavlink.MAVLink(None, 1, 191)
        self.codec.robust_parsing = True
        self.steps = 0

    @property
    def now(self):
        return self.steps * STEP_TIME

    @property
    def controller(self):
        return self.autopilot.controller

    @property
    def vehicle(self):
        return self.autopilot.vehicle


class Flight(SteppedAutopilot):
    """An embedded autopilot and what it said, flown in simulated time."""

    def __init__(self, personality='px4', **options):
        super().__init__(personality, **options)
        self.modes = PX4_MODES if personality == 'px4' else ARDUCOPTER_MODES
        self.ours = mavlink.MAVLink(None, 1, 191)
        self.messages = []

    def fly(self, seconds, *messages, rate=20.0):
        """Fly on, sending messages at a rate; a function among them is called for its message."""
        every = round(1 / rate / STEP_TIME)
        for _ in range(round(seconds / STEP_TIME)):
            if self.steps % every == 0:
                for message in messages:
                    self.send(message() if callable(message) else message)
            self.take(self.autopilot.step(self.now))
            self.steps += 1

    def take(self, datagrams):
        answers = [m for data in datagrams for m in self.codec.parse_buffer(data) or []]
        self.messages += answers
        return answers

    def send(self, message):
        data = message.pack(self.ours)
        self.ours.seq = (self.ours.seq + 1) % 256
        return self.take(self.autopilot.receive(bytes(data), self.now))

    def command(self, command, *params):
        """Send COMMAND_LONG and return the results of its COMMAND_ACKs."""
        answers = self.send(mavlink.MAVLink_command_long_message(
            1, 1, command, 0, *params, *(0.0,) * (7 - len(params))))
        return [m.result for m in answers
                if m.get_type() == 'COMMAND_ACK' and m.command == command]

    def mode(self, name):
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, *map(float, self.modes[name]))

    def arm(self, value=True):
        return self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, float(value))

    def take_off(self, altitude):
        return self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, math.nan, 0, 0, altitude)

    def kinds(self):
        return [m.get_type() for m in self.messages]

    def last(self, kind):
        return self.all(kind)[-1]

    def ask(self, message, rate=20.0):
        """Ask for a message by name at a rate, Hz, and return the results."""
        number = getattr(mavlink, f'MAVLINK_MSG_ID_{message}')
        return self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 1e6 / rate)

    def all(self, kind):
        return [m for m in self.messages if m.get_type() == kind]

    def texts(self):
        return [m.text.strip('\x00\t') for m in self.all('STATUSTEXT')]
