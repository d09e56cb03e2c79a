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
The whole embedded autopilot without socket and clock: bytes in, bytes out.

Fly it in simulated time beside a bridge, in one process::

    autopilot = EmbeddedAutopilot('arducopter', now=0.0, start='landed', ready_after=0.5)
    autopilot.receive(data, now)
    for data in autopilot.step(now): ...   # every STEP
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from types import MappingProxyType
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.arducopter import ArduCopter
from flock_desk.vehicles.autopilot_parameters import AutopilotParameters
from flock_desk.vehicles.equipment import BarometerErrors, Equipment
from flock_desk.vehicles.flight_controller import FlightController
from flock_desk.vehicles.flight_log import FlightLog
from flock_desk.vehicles.mavlink_vehicle import MavlinkVehicle, STEP
from flock_desk.vehicles.profiles import PROFILES
from flock_desk.vehicles.px4 import Px4
from flock_desk.vehicles.vehicle import Quadrotor, VehicleParams
from flock_follower.ranges import Range

STARTS: Final[tuple[str, ...]] = ('airborne', 'armed', 'landed')
SYSTEM_IDS: Final[Range] = Range(1, 255, whole=True)
_NO_PARAMETERS: Final[Mapping[str, float]] = MappingProxyType({})


class EmbeddedAutopilot:
    """
    An autopilot with the personality of PX4 or ArduCopter.

    :param now: monotonic time, s, of the start.
    :param start: 'airborne' (hovering in Hold or LOITER), 'armed' or 'landed'.
    :param altitude: m, of an airborne start.
    :param yaw: rad, ENU, at the start.
    :param parameters: values that differ from the autopilot's defaults.
    :param arming_denial: where given, arming is refused with this reason.
    :param ready_after: s from the start, and from a reboot, until the estimator is ready.
    :param seed: of the sensors' noise.
    :param signing: a pymavlink MAVLinkSigning, where the link is signed.
    :param barometer: how it errs.
    :raises ValueError: for an unknown personality, start or parameter.
    """

    def __init__(self, personality: str = 'px4', *, now: float, start: str = 'airborne',
                 altitude: float = 2.0, yaw: float = 0.0, system_id: int = 1,
                 parameters: Mapping[str, float] = _NO_PARAMETERS, arming_denial: str = '',
                 ready_after: float = 0.0, seed: int = 0, signing: Any = None,
                 barometer: BarometerErrors | None = None) -> None:
        for name, value, valid in (('personality', personality, tuple(PROFILES)),
                                   ('start', start, STARTS)):
            if value not in valid:
                raise ValueError(f'{name} = {value!r}: must be one of {", ".join(valid)}')
        SYSTEM_IDS.check('system_id', system_id)
        profile = PROFILES[personality]
        self._parameters = AutopilotParameters(profile)
        for name, number in parameters.items():
            self._parameters.set(name, number)
        self.log = FlightLog()
        self._kind: type[FlightController] = Px4 if profile.px4 else ArduCopter
        self._start, self._steps = now, 0
        self._silent_until = -math.inf
        self._arming_denial, self._ready_after = arming_denial, ready_after
        self.vehicle = Quadrotor((0.0, 0.0, altitude if start == 'airborne' else 0.0), yaw,
                                 VehicleParams(tilt_max=profile.tilt_max))
        self.equipment = Equipment(self.vehicle, seed, barometer)
        self._codec = mavlink.MAVLink(
            None, srcSystem=system_id, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._codec.robust_parsing = True
        if signing is not None:
            self._codec.signing = signing
        self._boot(now, armed=start != 'landed')

    @property
    def next_step(self) -> float:
        """Return the time, s, of the next step."""
        return self._start + self._steps * STEP

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes that have arrived, and return what goes out at once."""
        answers = []
        for message in self._codec.parse_buffer(data) or []:
            if now >= self._silent_until:
                self.log.received(message, now)
                answers += self._packed(self._face.handle(message, now))
        return answers

    def step(self, now: float) -> list[bytes]:
        """Fly on to ``now``, a STEP after the last, and return what goes out."""
        self._steps += 1
        messages = []
        vehicle, controller = self.vehicle, self.controller
        if now < self._silent_until:
            vehicle.step((0.0, 0.0, 0.0), vehicle.yaw, STEP, powered=False)
        else:
            messages = self._face.step(now)
        self.equipment.step(controller.armed, STEP)
        self.log.moved(now, vehicle.position, vehicle.velocity, vehicle.acceleration, vehicle.yaw,
                       controller.armed, controller.mode)
        return self._packed(messages)

    def reboot(self, now: float, duration: float) -> None:
        """Restart: silent, motors off, everything but the parameters forgotten."""
        self._silent_until = now + duration
        self._boot(self._silent_until, armed=False)

    def _boot(self, now: float, *, armed: bool) -> None:
        airborne = armed and not self.vehicle.landed
        #: The flight controller that runs; a reboot starts another.
        self.controller = self._kind(
            self.vehicle, now, armed=armed, parameters=self._parameters,
            arming_denial=self._arming_denial,
            ready_at=-math.inf if airborne else now + self._ready_after)
        self._face = MavlinkVehicle(self.controller, self.equipment, now,
                                    system_id=self._codec.srcSystem)
        self._codec.seq = 0

    def _packed(self, messages: list[Any]) -> list[bytes]:
        packed = []
        for message in messages:
            packed.append(bytes(message.pack(self._codec)))
            self._codec.seq = (self._codec.seq + 1) % 256
        return packed
