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
What differs between autopilots, behind one interface: modes, take-off, odometry frames.

``px4.Px4`` and ``ardupilot.ArduPilot`` fill it in; ``autopilots`` tells which one is heard.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import all as mavlink


class VehicleStatus(NamedTuple):
    """What a HEARTBEAT says of the vehicle, or after it a CURRENT_MODE."""

    armed: bool
    mode: str
    system_status: str
    """MAV_STATE in lower case: 'standby', 'active', 'critical' (a failsafe acts) and so on."""
    offboard: bool
    """Whether the mode is the one that obeys our setpoints: OFFBOARD, GUIDED."""


class ModeMessage(NamedTuple):
    """The message that shows the pilot's switch."""

    message_id: int
    asked: float
    """How often it is asked for, Hz."""
    least: float
    """How often it then comes while the mode stays, Hz."""


class Dialect(ABC):
    """One autopilot's ways; stateless."""

    name: str
    """As the parameter ``autopilot`` names it."""
    title: str
    """As its makers name it."""
    offboard: str
    """The mode that obeys our setpoints."""
    hold: str
    """The mode that keeps the position, given back when offboard ends."""
    hold_instead: tuple[str, ...]
    """The modes asked for in turn where it refuses ``hold``; in the last it comes down."""
    arming_modes: tuple[str, ...]
    """Modes in which it arms, asked for in turn where the present one is none of them."""
    unarmable_modes: tuple[str, ...]
    """Modes in which it may be left by a flight, and does not arm."""
    land: str
    """The mode that lands where it is."""
    takeoff_modes: tuple[str, ...]
    """The modes it shows during a take-off, and after."""
    stream_before_offboard: float
    """How long setpoints must have been flowing before it takes offboard mode, s."""
    compensates_wind: bool
    """Whether it closes the loop of the acceleration itself, so that a wind does not carry it."""
    setpoints_end_takeoff: bool
    """Whether a setpoint during its take-off ends that, and one on the ground does nothing."""
    bytewise_parameters: bool
    """Whether PARAM_VALUE carries integers as their bytes, else as the float of their value."""
    minimum_takeoff: str
    """The parameter that holds the height it climbs by at least, m, whatever is asked; or ''."""
    odometry_frame: int
    """The only ``frame_id`` (MAV_FRAME) of ODOMETRY it takes, with the child BODY_FRD."""
    estimator_status: int
    """The id of the message in which its estimator tells how it is, see ``aiding``."""
    gps_switch: str
    """The parameter that is 0 where it takes no GPS; or '' where zeros are no origin to it."""
    origin_has_height: bool
    """Whether it is told the height of its origin; PX4's own heights would jump by that."""
    recommendations: str
    """The file of recommended parameters in ``config/``."""
    reports_checks: bool = False
    """Whether MAV_CMD_RUN_PREARM_CHECKS makes it tell by EVENTs what it would refuse, and why."""
    untold: str = ''
    """What to tell where a refusal comes without a cause."""
    mode_message: ModeMessage
    """What shows the pilot's switch."""

    @abstractmethod
    def mode_name(self, custom_mode: int) -> str:
        """Return the name of HEARTBEAT's custom_mode, or its numbers where it has none here."""

    @abstractmethod
    def set_mode_parameters(self, name: str) -> tuple[float, ...]:
        """Return the parameters of MAV_CMD_DO_SET_MODE; ValueError for an unknown name."""

    @abstractmethod
    def takeoff_parameters(self, height: float, sea_level_altitude: float | None,
                           above_home: float) -> tuple[float, ...]:
        """
        Return the parameters of MAV_CMD_NAV_TAKEOFF.

        :param height: to climb, m.
        :param sea_level_altitude: of the vehicle now, m above mean sea level; None if unknown.
        :param above_home: of the vehicle now, m.
        """

    def status(self, heartbeat: Any) -> VehicleStatus:
        """Return what its HEARTBEAT says."""
        state = mavlink.enums['MAV_STATE'].get(heartbeat.system_status)
        mode = self.mode_name(heartbeat.custom_mode)
        return VehicleStatus(
            bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED), mode,
            state.name.removeprefix('MAV_STATE_').lower() if state else 'unknown',
            mode == self.offboard)

    def in_mode(self, status: VehicleStatus, custom_mode: int) -> VehicleStatus:
        """Return ``status`` with another mode: that of a CURRENT_MODE."""
        mode = self.mode_name(custom_mode)
        return status._replace(mode=mode, offboard=mode == self.offboard)


def is_autopilot(heartbeat: Any) -> bool:
    """Return whether a HEARTBEAT comes from a flight controller, not a gimbal or a station."""
    return bool(heartbeat.autopilot != mavlink.MAV_AUTOPILOT_INVALID
                and heartbeat.type not in (mavlink.MAV_TYPE_GCS, mavlink.MAV_TYPE_GIMBAL,
                                           mavlink.MAV_TYPE_ONBOARD_CONTROLLER))
