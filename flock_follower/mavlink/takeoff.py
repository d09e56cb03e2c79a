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

"""Whether a take-off may be asked for, and what then to ask for."""

from __future__ import annotations

from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink import commands
from flock_follower.mavlink.commands import Goal, Request
from flock_follower.mavlink.dialect import Dialect, VehicleStatus
from flock_follower.mavlink.gate_limits import GateLimits
from flock_follower.mavlink.parameter_check import ParameterCheck
from flock_follower.mavlink.telemetry import SEA_LEVEL_TIMEOUT, Telemetry

#: PX4 accepts a take-off this much below its minimum height, m.
TOLERANCE: Final[float] = 0.1


def goal(telemetry: Telemetry, height: float, now: float) -> Goal:
    """Return the goal of climbing by ``height``, m, from where the vehicle is at ``now``, s."""
    above_sea = telemetry.sea_level_altitude
    recent = above_sea is not None and now - above_sea.time <= SEA_LEVEL_TIMEOUT
    return commands.takeoff(height, telemetry.altitude(now) or 0.0,
                            above_sea.altitude if above_sea and recent else None,
                            telemetry.height_above_home(now) or 0.0)


def obstacle(status: VehicleStatus | None, telemetry: Telemetry,
             parameters: ParameterCheck | None, height: float, now: float) -> str:
    """
    Return why the vehicle may not climb by ``height``, m, at ``now``, s, or ''.

    :param status: what its HEARTBEAT says, None where none is fresh.
    :param parameters: of the autopilot, as far as they are known.
    """
    if status is None or telemetry.dialect is None:
        return 'no HEARTBEAT from the autopilot'
    if not status.armed:
        return 'disarmed: arm first'
    if telemetry.flying(now):
        return 'already in the air'
    if telemetry.altitude(now) is None:
        return 'no LOCAL_POSITION_NED: nothing would tell when the height is reached'
    return _too_low(telemetry.dialect, parameters, height)


def out_of_bounds(limits: GateLimits, height: float, present: float | None) -> str:
    """
    Return why a climb by ``height``, m, would end outside the envelope, or ''.

    :param present: the present height above the place of arming, m; 0 where it is not known.
    """
    reached = height + (present or 0.0)
    for name, wrong in (('height_min', reached < limits.height_min),
                        ('height_max', reached > limits.height_max)):
        if wrong:
            return (f'it would end {reached:.1f} m above the place of arming: beyond {name} = '
                    f'{getattr(limits, name):g} m')
    return ''


def explains_mode(request: Request | None, telemetry: Telemetry, now: float) -> bool:
    """
    Return whether an armed vehicle is in its offboard mode, and misses no setpoint, by a take-off.

    ArduPilot takes off in GUIDED, and stays in it above. Before and while it climbs out setpoints
    would do nothing, or end it; after our own take-off nobody has asked for them yet.

    :param request: the newest of ours, if any.
    """
    if telemetry.dialect is None or not telemetry.dialect.setpoints_end_takeoff:
        return False
    ours = request is not None and request.goal.command == mavlink.MAV_CMD_NAV_TAKEOFF and (
        request.outcome is None or request.outcome.success)
    return ours or telemetry.flying(now) is False


def _too_low(dialect: Dialect, parameters: ParameterCheck | None, height: float) -> str:
    """Return that the autopilot would climb higher than it is asked to, or ''."""
    name = dialect.minimum_takeoff
    if not name:
        return ''
    least = None if parameters is None else parameters.values.get(name)
    if least is None:
        if parameters is not None:
            parameters.again(name)
        return f'{name} is not known yet: {dialect.title} would climb that high at least'
    if height < least - TOLERANCE:
        return (f'{dialect.title} would climb to {name} = {least:g} m, '
                f'above takeoff_height = {height:g} m')
    return ''
