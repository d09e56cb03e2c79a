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

"""A bridge and an embedded autopilot in one process and in simulated time."""

from typing import NamedTuple

from embedded_flight import SteppedAutopilot
from memory_line import MemoryLine
import numpy as np
import pytest

from flock_desk.vehicles.embedded import STEP_TIME
from flock_follower.gate.gate import Gate
from flock_follower.gate.velocity_check import MotionReport
from flock_follower.mavlink.bridge import Bridge
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder
from flock_follower.messages import OdometryState
from flock_follower.messages.commands import Command

PERIOD = 5  # steps of a cycle: 20 Hz
BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])
EAST = np.array([0.5, 0.0, 0.0])
NO_GPS = {
    'px4': {'EKF2_GPS_CTRL': 0, 'EKF2_EV_CTRL': 13, 'EKF2_HGT_REF': 0},
    'arducopter': {'GPS1_TYPE': 0, 'VISO_TYPE': 1, 'EK3_SRC1_POSXY': 6, 'EK3_SRC1_VELXY': 6,
                   'EK3_SRC1_VELZ': 6, 'EK3_SRC1_YAW': 6}}


def without_gps(personality, **bridge):
    """Return the options of a flight on the odometry that is forwarded to the autopilot."""
    return {'parameters': NO_GPS[personality],
            'bridge': {'forwarder': OdometryForwarder(30.0), **bridge}}


class Modes(NamedTuple):
    """The modes of an autopilot: what the bridge asks for, and what a pilot switches to."""

    offboard: str
    hold: str
    land: str
    manual: str
    loiter: str


MODES = {'px4': Modes('OFFBOARD', 'AUTO.LOITER', 'AUTO.LAND', 'POSCTL', 'AUTO.LOITER'),
         'arducopter': Modes('GUIDED', 'BRAKE', 'LAND', 'STABILIZE', 'LOITER')}


class Flight(SteppedAutopilot):
    """A bridge and a vehicle, hovering or landed; ``planner`` is asked each 0.1 s."""

    def __init__(self, personality='px4', *, source='odom', limits=None, odom_yaw=0.0,
                 bridge=None, wire=None, announce_as_gcs=False, **options):
        # As a user sets it: with the default of 3 s offboard is refused.
        short = {'GUID_TIMEOUT': 0.5} if personality == 'arducopter' else {}
        super().__init__(personality, **{
            **options, 'parameters': {**short, **options.get('parameters', {})}})
        self.wire = wire or MemoryLine()
        self.bridge = Bridge(Link(self.wire, announce_as_gcs=announce_as_gcs),
                             Gate(limits, source), now=0.0, **(bridge or {}))
        self.planner = None
        self.odometry = True
        self.forwards = False
        """Whether the odometry is handed on at 50 Hz too."""
        self.odom_yaw = odom_yaw
        self.odom_error = np.zeros(3)
        """By how much the velocity of the odometry is wrong, m/s."""
        self.odom_displacement = None
        """By how much its position is wrong, m: it follows the velocity. None: not reported."""
        self.modes = MODES[personality]
        self.received = []
        self.cycles = []

    def fly(self, seconds):
        for _ in range(round(seconds / STEP_TIME)):
            now = self.now
            answers = self.autopilot.step(now)
            for data in self.wire.written:
                self.received += [(now, m) for m in self.codec.parse_buffer(data) or []]
                answers += self.autopilot.receive(data, now)
            self.wire.written = []
            self.wire.arrived += answers
            self.bridge.receive(now)
            velocity = self.vehicle.velocity + self.odom_error
            position = None
            if self.odom_displacement is not None:
                self.odom_displacement = self.odom_displacement + STEP_TIME * self.odom_error
                position = self.vehicle.position + self.odom_displacement
            if self.odometry:
                self.bridge.gate.take_motion('odom', MotionReport(
                    velocity, self.vehicle.yaw + self.odom_yaw, position), 0.0, now)
            if self.forwards and self.steps % 2 == 0:
                self.bridge.forward(OdometryState(
                    0, 'odom', 'base_link', (
                        self.vehicle.position.copy() if position is None else position),
                    self.vehicle.quaternion,
                    velocity, self.vehicle.angular_velocity, 0.01 * np.eye(6), 0.01 * np.eye(6),
                    np.eye(3)), now, now)
                self.bridge.send_odometry(now)
            if self.planner is not None and self.steps % 10 == 0:
                refused = self.bridge.gate.take_command(
                    Command(self.planner, 0.0), 0.0, now, source_age=0.04)
                assert not refused or refused.startswith('while ')
            if self.steps % PERIOD == 0:
                self.cycles.append(self.bridge.cycle(now))
            self.steps += 1

    @property
    def mode(self):
        return self.controller.mode

    @property
    def speed(self):
        return float(np.linalg.norm(self.vehicle.velocity))

    def fly_until(self, condition, seconds):
        """Fly until a condition holds; return how long that took, s."""
        begun = self.now
        while not condition() and self.now < begun + seconds:
            self.fly(0.05)
        return self.now - begun

    def follow(self, seconds, acceleration=EAST):
        """Take over, and follow commands for a while; return self."""
        self.engage()
        self.planner = np.asarray(acceleration)
        self.fly(seconds)
        return self

    def ask(self, what, *arguments, seconds=6.0):
        request = getattr(self.bridge.requests, what)(*arguments, self.now)
        while request.outcome is None and seconds > 0.0:
            self.fly(STEP_TIME)
            seconds -= STEP_TIME
        return request.outcome

    def setpoints(self, since=0.0):
        return [m for t, m in self.received
                if m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED' and t >= since]

    def commands(self, command=None, since=0.0):
        """Return the COMMAND_LONGs that the vehicle received, of one command or all."""
        return [m for t, m in self.received if m.get_type() == 'COMMAND_LONG' and t >= since
                and command in (None, m.command)]

    def kinds(self, cycles):
        """Return the kinds of the setpoints of the last cycles."""
        return {cycle.setpoint.kind for cycle in self.cycles[-cycles:]}

    @property
    def reason(self):
        """Why the last setpoint was no command."""
        return self.cycles[-1].setpoint.reason

    def engage(self):
        self.fly(1.5)
        # As if the bridge had seen the arming.
        self.bridge.gate.heights.refer(float(self.vehicle.position[2]), self.now)
        outcome = self.ask('offboard', True)
        assert outcome.success, outcome
