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
The whole embedded autopilot without socket and clock: bytes in, bytes out, faults in between.

Fly it in simulated time beside a bridge, in one process::

    autopilot = EmbeddedAutopilot('arducopter', now=0.0, start='landed', ready_after=0.5)
    autopilot.receive(data, now)
    for data in autopilot.step(now): ...   # every STEP
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from types import MappingProxyType
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.arducopter_controller import ArduCopter
from flock_desk.vehicles.autopilot_parameters import (
    ARDUCOPTER,
    AutopilotParameters,
    PX4,
)
from flock_desk.vehicles.barometer import BarometerErrors
from flock_desk.vehicles.equipment import Equipment
from flock_desk.vehicles.fault_script import Fault
from flock_desk.vehicles.faulty_line import FaultyLine
from flock_desk.vehicles.flight_controller import FlightController
from flock_desk.vehicles.flight_log import FlightLog
from flock_desk.vehicles.mavlink_vehicle import MavlinkVehicle, STEP
from flock_desk.vehicles.px4_controller import Px4Controller
from flock_desk.vehicles.vehicle import Quadrotor, VehicleParams

PERSONALITIES: Final[tuple[str, ...]] = ('px4', 'arducopter')
STARTS: Final[tuple[str, ...]] = ('airborne', 'armed', 'landed')
_NO_PARAMETERS: Final[Mapping[str, float]] = MappingProxyType({})


class EmbeddedAutopilot:
    """
    An autopilot with the personality of PX4 or ArduCopter.

    :param now: monotonic time, s, of the start; faults count from it.
    :param start: 'airborne' (hovering in Hold or LOITER), 'armed' or 'landed'.
    :param altitude: m, of an airborne start.
    :param yaw: rad, ENU, at the start.
    :param parameters: values that differ from the autopilot's defaults.
    :param arming_denial: where given, arming is refused with this reason.
    :param ready_after: s from the start, and from a reboot, until the estimator is ready.
    :param seed: of the faults' lots and of the sensors' noise.
    :param signing: a pymavlink MAVLinkSigning, where the link is signed.
    :param barometer: how it errs.
    :param rangefinder: whether there is one that looks down.
    :raises ValueError: for an unknown personality, start, parameter or mode of a fault.
    """

    def __init__(self, personality: str = 'px4', *, now: float, start: str = 'airborne',
                 altitude: float = 2.0, yaw: float = 0.0, system_id: int = 1,
                 parameters: Mapping[str, float] = _NO_PARAMETERS, arming_denial: str = '',
                 ready_after: float = 0.0, faults: Sequence[Fault] = (), seed: int = 0,
                 signing: Any = None, barometer: BarometerErrors | None = None,
                 rangefinder: bool = False) -> None:
        if personality not in PERSONALITIES:
            raise ValueError(f'personality = {personality!r}: must be one of '
                             f'{", ".join(PERSONALITIES)}')
        if start not in STARTS:
            raise ValueError(f'start = {start!r}: must be one of {", ".join(STARTS)}')
        px4 = personality == 'px4'
        self._kind: type[Px4Controller | ArduCopter] = Px4Controller if px4 else ArduCopter
        self._parameters = AutopilotParameters(PX4 if px4 else ARDUCOPTER, bytewise=px4)
        for name, value in parameters.items():
            self._parameters.set(name, value)
        for fault in faults:
            if fault.kind == 'pilot':
                self._kind.check_pilot(fault.mode, fault.climb)
        self.log = FlightLog()
        self._faults = sorted(faults, key=lambda fault: fault.at)
        self._waiting = list(self._faults)
        self._first_setpoint = math.inf
        self._start = now
        self._silent_until = -math.inf
        self._steps = 0
        self._system_id = system_id
        self._arming_denial = arming_denial
        self._ready_after = ready_after
        # ArduCopter's ANGLE_MAX is 30 degrees, PX4's MPC_TILTMAX_AIR 45.
        tilt = VehicleParams.tilt_max if px4 else math.radians(30.0)
        self.vehicle = Quadrotor((0.0, 0.0, altitude if start == 'airborne' else 0.0), yaw,
                                 VehicleParams(tilt_max=tilt))
        self.equipment = Equipment(self.vehicle, seed, barometer, rangefinder)
        self._face = self._boot(now, armed=start != 'landed')
        self._sending = FaultyLine(faults, 'sent', seed)
        self._receiving = FaultyLine(faults, 'received', seed)
        self._codec = mavlink.MAVLink(
            None, srcSystem=system_id, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._codec.robust_parsing = True
        if signing is not None:
            self._codec.signing = signing

    @property
    def controller(self) -> FlightController:
        """Return the flight controller that runs; a reboot starts another."""
        return self._face.controller

    @property
    def next_step(self) -> float:
        """Return the time, s, of the next step."""
        return self._start + self._steps * STEP

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes that have arrived, and return what goes out at once."""
        time = now - self._start
        for message in self._codec.parse_buffer(self._receiving.garbled(data, time)) or []:
            self._receiving.put(message.get_type(), message, time)
        self._handle(now)
        return self._outgoing(time)

    def step(self, now: float) -> list[bytes]:
        """Fly on to ``now``, a STEP after the last, and return what goes out."""
        time = now - self._start
        self._steps += 1
        for fault in tuple(self._waiting):
            if fault.at + (self._first_setpoint if fault.after == 'setpoint' else 0.0) <= time:
                self._waiting.remove(fault)
                self._begin(fault, now)
        self.controller.estimator.vision_available = not self._acts('vision', time)
        self.equipment.barometer.offset = sum(
            fault.offset for fault in self._faults
            if fault.kind == 'barometer' and fault.active(time))
        self._face.refusals = dict(fault.refusal() for fault in self._faults
                                   if fault.kind == 'refuse' and fault.active(time))
        self._handle(now)
        if now < self._silent_until:
            self.vehicle.step((0.0, 0.0, 0.0), self.vehicle.yaw, STEP, powered=False)
        else:
            self._send(self._face.step(now), time)
        self.equipment.step(self.controller.armed, STEP)
        self.log.state(self.controller, now)
        return self._outgoing(time)

    def reboot(self, now: float, duration: float) -> None:
        """Restart: silent, motors off, everything but the parameters forgotten."""
        self._silent_until = now + duration
        self._face = self._boot(self._silent_until, armed=False)
        self._codec.seq = 0

    def _boot(self, now: float, *, armed: bool) -> MavlinkVehicle:
        airborne = not self.vehicle.landed
        controller = self._kind(
            self.vehicle, now, armed=armed, parameters=self._parameters,
            arming_denial=self._arming_denial,
            ready_after=-math.inf if airborne and armed else self._ready_after)
        return MavlinkVehicle(controller, self.equipment, now, system_id=self._system_id)

    def _begin(self, fault: Fault, now: float) -> None:
        if fault.kind == 'reboot':
            self.reboot(now, fault.end - fault.at)
        elif fault.kind == 'pilot':
            self.controller.pilot_switches(fault.mode, fault.climb)
        elif fault.kind == 'battery':
            self.equipment.charge_known = fault.remaining >= 0.0
            self.equipment.charge = max(fault.remaining, 0.0)

    def _acts(self, kind: str, time: float) -> bool:
        return any(fault.kind == kind and fault.active(time) for fault in self._faults)

    def _handle(self, now: float) -> None:
        for message in self._receiving.take(now - self._start):
            if now < self._silent_until:
                continue
            self.log.received(message, now)
            if message.get_type() == 'SET_POSITION_TARGET_LOCAL_NED':
                self._first_setpoint = min(self._first_setpoint, now - self._start)
            self._send(self._face.handle(message, now), now - self._start)

    def _send(self, messages: list[Any], time: float) -> None:
        for message in messages:
            data = bytes(message.pack(self._codec))
            self._codec.seq = (self._codec.seq + 1) % 256
            self._sending.put(message.get_type(), data, time)

    def _outgoing(self, time: float) -> list[bytes]:
        return [self._sending.garbled(data, time) for data in self._sending.take(time)]
