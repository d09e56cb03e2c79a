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

"""The parameters of mavlink_bridge, and the objects that the node builds from their values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.flight_end import EndParams
from flock_follower.gate.motion_sources import VELOCITY_SOURCES
from flock_follower.mavlink.bridge import BLIND_ACTIONS, WIND_COMPENSATIONS
from flock_follower.mavlink.dialects import AUTOPILOTS, DIALECTS
from flock_follower.mavlink.link import ID_RANGE
from flock_follower.mavlink.parameter_check import read_recommendations, Recommendation
from flock_follower.odometry.reader import SourceParams
from flock_follower.parameters.settings import refuse
from flock_follower.parameters.spec import filled, Spec, specs_of
from flock_follower.ranges import Range
from flock_follower.system.files import resource

ORIGIN_RANGES = {
    'latitude': Range(-90.0, 90.0, 'deg'), 'longitude': Range(-180.0, 180.0, 'deg'),
    'height': Range(-10_000.0, 10_000.0, 'm')}
MAVLINK_BRIDGE = [
    Spec('connection', 'udpin:127.0.0.1:14540',
         'connection to the autopilot: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or '
         '/dev/DEVICE[,BAUD]'),
    Spec('autopilot', 'auto', 'firmware of the autopilot; auto: by its HEARTBEAT', AUTOPILOTS),
    Spec('target_system', 1,
         'MAVLink system id of the autopilot; others are ignored', ID_RANGE),
    Spec('source_system', 0,
         'own MAVLink system id; 0: that of target_system, as MAVLink requires of the companion '
         'computer of a vehicle', replace(ID_RANGE, low=0)),
    Spec('announce_as_gcs', False,
         'send the HEARTBEAT of a ground station, so that PX4 sends its STATUSTEXTs on this '
         'link, too. While the bridge runs, PX4 then counts a ground station as connected: the '
         'failsafe for the loss of the real one (NAV_DLL_ACT, COM_DL_LOSS_T) acts only when the '
         'bridge ends. ArduPilot checks the system id, and sends them anyway'),
    Spec('report_to_gcs', True,
         "send the planner's state as STATUSTEXT, at most one per 2 s, and the distance as "
         'NAMED_VALUE_FLOAT flock_dist, 1 Hz; PX4 forwards them with MAV_n_FORWARD 1'),
    Spec('signing_key_file', '',
         'file with the 32-byte MAVLink 2 signing key; none: unsigned'),
    Spec('stream_rate', 20.0,
         'rate of setpoints between new commands', Range(5.0, 100.0, 'Hz')),
    Spec('telemetry_rate', 50.0,
         "requested rate of the autopilot's position and attitude; 20 for 57600 baud",
         Range(5.0, 200.0, 'Hz')),
    Spec('forward_odometry', False,
         'send odom to the autopilot as ODOMETRY, for flight without GPS'),
    Spec('odometry_rate', 30.0,
         'largest rate of ODOMETRY messages, of 247 bytes each; 10 for 57600 baud',
         Range(10.0, 100.0, 'Hz')),
    Spec('global_origin', [0.0, 0.0, 0.0],
         'latitude, longitude (deg) and height (m) sent to an estimator without an origin (no '
         'GPS); PX4 receives no height. Zeros: not set; PX4 then receives one near Zurich if '
         'odometry is forwarded and GPS off', fixed_length=True),
    Spec('require_failsafe', True,
         'refuse offboard while the autopilot would fly the last setpoint for over 1 s if the '
         'bridge died (COM_OF_LOSS_T, GUID_TIMEOUT), or stop its motors (COM_OBL_RC_ACT), or '
         'does not fuse the odometry that is forwarded to it (EKF2_EV_CTRL; VISO_TYPE, '
         'EK3_SRC1_POSXY, EK3_SRC1_VELXY), or does not answer'),
    Spec('takeoff_height', 2.5,
         'climb of the takeoff service', Range(0.5, 30.0, 'm'), live=True),
    Spec('velocity_source', 'auto',
         'velocity for v_max and braking; auto: odom once received', VELOCITY_SOURCES),
    Spec('blind_action', 'land',
         'action after 2 s without any velocity, when the stream stops: land requests a landing; '
         'silence requests nothing: PX4 starts its failsafe, ArduPilot stays in GUIDED',
         BLIND_ACTIONS),
    Spec('wind_compensation', 'auto',
         'offset the steady acceleration of the wind, up to 1 m/s^2; auto: only for PX4, which '
         'has no such correction', WIND_COMPENSATIONS),
    *specs_of(GateLimits()),
    *specs_of(EndParams()),
    *specs_of(SourceParams(), 'odom_'),
]


def gate_limits(values: Mapping[str, Any]) -> GateLimits:
    """
    Return the limits of the gate in the values of mavlink_bridge.

    :raises ValueError: if the values contradict each other, or cannot fly.
    """
    limits = filled(GateLimits(), values)
    refuse(values)
    return limits


def origin(values: list[float]) -> tuple[float, float, float] | None:
    """
    Return latitude and longitude, deg, and height, m, or None for zeros.

    :raises ValueError: if the values are no place on Earth.
    """
    if not any(values):
        return None
    for (name, valid), value in zip(ORIGIN_RANGES.items(), values):
        valid.check(f'global_origin = {values}: {name}', value)
    latitude, longitude, height = values
    return latitude, longitude, height


def recommendations(forwarding: bool, takeoff_height: float) -> dict[str, list[Recommendation]]:
    """
    Return the recommended parameters of each autopilot by the name of its dialect.

    :param forwarding: whether odometry is forwarded, which needs more parameters.
    :param takeoff_height: m; the autopilot's own take-off height must not exceed it.
    """
    found = {}
    for dialect in DIALECTS.values():
        text = resource(f'config/{dialect.recommendations}').read_text(encoding='utf-8')
        found[dialect.name] = [
            entry._replace(value=min(entry.value, takeoff_height))
            if entry.name == dialect.minimum_takeoff else entry
            for entry in read_recommendations(text, forwarding=forwarding)]
    return found
