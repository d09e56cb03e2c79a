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

"""The parameters of the MAVLink bridge, and the limits its setpoint gate makes of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flock_follower.mavlink import px4
from flock_follower.mavlink.gate import GateLimits, VELOCITY_SOURCES
from flock_follower.parameters.spec import ODOM_TWIST_FRAME, Spec

LIMITS = GateLimits()
SPECS = [
    Spec('connection', 'udpin:127.0.0.1:14540',
         'where the autopilot is: udpin:HOST:PORT, udpout:HOST:PORT or /dev/DEVICE[,BAUD]',
         read_only=True),
    Spec('dialect', 'px4', 'firmware of the autopilot', choices=('px4',), read_only=True),
    Spec('target_system', 1, 'MAVLink system id of the autopilot, the only one listened to',
         low=1, high=255, read_only=True),
    Spec('source_system', 1, 'own MAVLink system id', low=1, high=255, read_only=True),
    Spec('signing_key_file', '', 'file with the 32-byte MAVLink 2 signing key; none: unsigned',
         read_only=True),
    Spec('setpoint_mode', 'acceleration_yaw', 'what the setpoints hold',
         choices=tuple(px4.SETPOINT_MASKS), read_only=True),
    Spec('stream_rate', 20.0, 'rate of the setpoints', 'Hz', 5.0, 100.0, read_only=True),
    Spec('velocity_source', 'auto', 'velocity for v_max and braking; auto: odom once heard',
         choices=VELOCITY_SOURCES, read_only=True),
    ODOM_TWIST_FRAME,
    Spec('a_max', LIMITS.a_max, 'largest acceleration, of the vector', 'm/s^2', 0.01, 20.0),
    Spec('v_max', LIMITS.v_max, 'largest speed, of the vector', 'm/s', 0.01, 20.0),
    Spec('speed_horizon', LIMITS.speed_horizon, 'how far ahead v_max is applied', 's', 0.02, 2.0),
    Spec('planner_timeout', LIMITS.planner_timeout, 'oldest command obeyed', 's', 0.05, 1.0),
    Spec('odom_timeout', LIMITS.odom_timeout, 'oldest velocity used', 's', 0.05, 1.0),
    Spec('link_timeout', 1.0, 'silence of the autopilot before braking', 's', 0.2, 5.0),
    Spec('blind_timeout', LIMITS.blind_timeout,
         'time without any velocity before the stream stops and the autopilot fails over',
         's', 0.2, 10.0),
    Spec('yaw_disagreement', LIMITS.yaw_disagreement, 'difference between the yaws of odom and of '
         'the autopilot above which it brakes, and refuses offboard', 'rad', 0.01, 3.2),
    Spec('velocity_disagreement', LIMITS.velocity_disagreement, 'difference between their '
         'velocities above which it brakes, where odom is the velocity source', 'm/s', 0.1, 100.0),
]


@dataclass(frozen=True)
class Settings:
    """What can change while flying."""

    limits: GateLimits
    link_timeout: float


def build(values: dict[str, Any]) -> Settings:
    """Return the settings of the parameter values."""
    limits = GateLimits(**{name: values[name] for name in (
        'a_max', 'v_max', 'planner_timeout', 'odom_timeout', 'blind_timeout', 'speed_horizon',
        'yaw_disagreement', 'velocity_disagreement')})
    return Settings(limits, values['link_timeout'])
