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

"""Status of the vehicle, and properties of its autopilot, as the gate uses them."""

from __future__ import annotations

from typing import NamedTuple


class VehicleStatus(NamedTuple):
    """The vehicle's state by the newest HEARTBEAT or CURRENT_MODE."""

    armed: bool
    mode: str
    offboard: bool
    """Whether the mode obeys our setpoints: OFFBOARD, GUIDED."""


class AutopilotTraits(NamedTuple):
    """Properties of the autopilot that the gate depends on."""

    hover_thrust: str = 'the hover thrust'
    """The autopilot's parameter of the hover thrust."""
    needs_wind_offset: bool = False
    """Whether setpoints offset the wind, because the autopilot does not."""
    fused: bool = False
    """Whether the autopilot's estimate fuses our odometry, so that it cannot confirm it."""
