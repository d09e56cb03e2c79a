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

"""
The embedded autopilot with faults at given times, and its second link, which tells the truth.

As a process: ``faulty_autopilot.py --fault '{"kind": "pilot", "at": 8, "mode": "POSCTL"}'``, once
for each fault, and all that ``flock_desk.autopilot`` takes; ``--truth HOST:PORT`` serves a
listener who asks for the true pose, as the real simulators send it.
"""

from dataclasses import dataclass
import heapq
import itertools
import json
import math
import random
import sys
import time

from pymavlink.dialects.v20 import all as mavlink

from flock_desk import autopilot
from flock_desk.vehicles.embedded import EmbeddedAutopilot, global_position, STEP_TIME
from flock_follower.mavlink.ned import enu_to_ned, flu_to_frd, quaternion_enu_flu_to_ned_frd


@dataclass(frozen=True)
class Fault:
    """
    One fault; times in s.

    On the line: 'drop', 'delay'. Of the vehicle: 'pilot', 'battery', 'reboot'.
    """

    kind: str
    at: float
    """Since the start."""
    duration: float = math.inf
    direction: str = 'both'  # or sent, received: as the autopilot sees it
    share: float = 1.0
    """Share of the messages that it affects, by chance."""
    message: str = ''
    """The only message type that it affects; '' for all."""
    by: float = 0.0
    """The delay."""
    mode: str = ''
    """The mode that the pilot switches to."""
    remaining: float = 1.0
    """Remaining charge of the battery, a share."""

    def active(self, now):
        return self.at <= now < self.at + self.duration


class FaultyLine:
    """One direction of the line; faultless, it lets messages through at once, and in order."""

    def __init__(self, faults, direction, seed):
        self._faults = [fault for fault in faults if fault.direction in (direction, 'both')
                        and fault.kind in ('drop', 'delay')]
        self._random = random.Random(f'{seed} {direction}')
        self._queue, self._numbers = [], itertools.count()

    def carry(self, datagrams, now):
        """Return what arrives now, after these were sent."""
        for data in datagrams:
            self._send(data, now)
        arrived = []
        while self._queue and self._queue[0][0] <= now:
            arrived.append(heapq.heappop(self._queue)[2])
        return arrived

    def _send(self, data, now):
        arrival, number = now, message_id(data)
        for fault in self._faults:
            concerned = not fault.message or number == getattr(
                mavlink, f'MAVLINK_MSG_ID_{fault.message}')
            if not fault.active(now) or not concerned or self._random.random() >= fault.share:
                continue
            if fault.kind == 'drop':
                return
            arrival += fault.by
        heapq.heappush(self._queue, (arrival, next(self._numbers), data))


def message_id(data):
    """Return the id of a MAVLink 2 message."""
    return int.from_bytes(data[7:10], 'little')


class FaultyAutopilot(EmbeddedAutopilot):
    """An embedded autopilot whose ``faults`` happen; each ``data`` holds one message."""

    def __init__(self, personality='px4', *, now, faults=(), seed=0, **options):
        super().__init__(personality, now=now, seed=seed, **options)
        self.faults = list(faults)
        self._begun = set()
        self._zero = now
        self._sent = FaultyLine(faults, 'sent', seed)
        self._received = FaultyLine(faults, 'received', seed)

    def receive(self, data, now):
        return self._sent.carry(self._answers([data], now), now - self._zero)

    def step(self, now):
        since = now - self._zero
        for fault in self.faults:
            if fault.at <= since and fault not in self._begun:
                self._begun.add(fault)
                self._begin(fault, now)
        return self._sent.carry([*self._answers([], now), *super().step(now)], since)

    def _begin(self, fault, now):
        if fault.kind == 'reboot':
            self.reboot(now, fault.duration)
        elif fault.kind == 'pilot':
            self.controller.pilot_switches(fault.mode)
        elif fault.kind == 'battery':
            self.charge = fault.remaining

    def _answers(self, datagrams, now):
        answers = []
        for data in self._received.carry(datagrams, now - self._zero):
            answers += super().receive(data, now)
        return answers


class TruthLink:
    """The second link: HEARTBEAT unasked, the rest at the interval asked for, without a time."""

    def __init__(self, flown, now, system_id=1):
        self._flown, self._start = flown, now
        truth = (mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION if flown.controller.PROFILE.px4
                 else mavlink.MAVLINK_MSG_ID_SIM_STATE)
        self._encoders = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat, truth: self._truth,
            mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: lambda now: mavlink.MAVLink_system_time_message(
                0, round((now - self._start) * 1e3)),
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: lambda now: (
                mavlink.MAVLink_extended_sys_state_message(0, flown.controller.landed_state))}
        self._periods, self._due = {0: 1.0}, {0: now}
        self._codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=1)
        self._codec.robust_parsing = True

    def receive(self, data, now):
        answers = []
        for message in self._codec.parse_buffer(data) or []:
            if message.get_type() != 'COMMAND_LONG':
                continue
            granted = (message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
                       and message.param1 in self._encoders and message.param2 > 0.0)
            if granted:
                self._periods[int(message.param1)] = max(message.param2 * 1e-6, STEP_TIME)
                self._due[int(message.param1)] = now
            answers.append(self._packed(mavlink.MAVLink_command_ack_message(
                message.command, 0 if granted else mavlink.MAV_RESULT_UNSUPPORTED)))
        return answers

    def step(self, now):
        due = [kind for kind, when in self._due.items() if now >= when - 0.5 * STEP_TIME]
        for kind in due:
            self._due[kind] += self._periods[kind] * max(
                1, (now - self._due[kind]) // self._periods[kind])
        return [self._packed(self._encoders[kind](now)) for kind in due]

    def _packed(self, message):
        data = bytes(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256
        return data

    def _heartbeat(self, now):
        controller = self._flown.controller
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, controller.PROFILE.autopilot,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            | mavlink.MAV_MODE_FLAG_SAFETY_ARMED * controller.armed,
            controller.PROFILE.modes[controller.mode].number, controller.system_status, 3)

    def _truth(self, now):
        vehicle = self._flown.vehicle
        latitude, longitude, height = global_position(vehicle.position)
        x, y, z, w = quaternion_enu_flu_to_ned_frd(vehicle.quaternion).tolist()
        rates = flu_to_frd(vehicle.angular_velocity).tolist()
        velocity = enu_to_ned(vehicle.velocity)
        if not self._flown.controller.PROFILE.px4:
            return mavlink.MAVLink_sim_state_message(
                w, x, y, z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *rates, latitude, longitude,
                height * 1e-3, 0.0, 0.0, *velocity.tolist(), latitude, longitude)
        return mavlink.MAVLink_hil_state_quaternion_message(
            0, [w, x, y, z], *rates, latitude, longitude, height,
            *(velocity * 100.0).round().astype(int).tolist(), 0, 0, 0, 0, 0)


def main():
    parser, start = autopilot.parser(), time.monotonic()
    parser.add_argument('--truth', default='')
    parser.add_argument('--fault', action='append', default=[], type=json.loads)
    options = parser.parse_args()
    flown = FaultyAutopilot(now=start, faults=[Fault(**fault) for fault in options.fault],
                            **autopilot.settings(options))
    ends = [autopilot.Endpoint(autopilot.loopback_address(options.connect), flown)]
    if options.truth:
        ends.append(autopilot.Endpoint(autopilot.loopback_address(options.truth),
                                       TruthLink(flown, start)))
    autopilot.serve(options.log, flown, ends)


if __name__ == '__main__':
    sys.exit(main())
