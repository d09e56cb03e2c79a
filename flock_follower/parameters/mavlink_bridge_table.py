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

"""The parameters of the MAVLink bridge, and what is built from them."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from flock_follower.mavlink.bridge import BLIND_ACTIONS, WIND_COMPENSATIONS
from flock_follower.mavlink.dialects import AUTOPILOTS, DIALECTS
from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.flight_end import ACTIONS, EndParams
from flock_follower.mavlink.gate import VELOCITY_SOURCES
from flock_follower.mavlink.link import IDS
from flock_follower.mavlink.parameter_check import read_recommendations, Recommendation
from flock_follower.parameters.odometry_table import ODOMETRY_SPECS
from flock_follower.parameters.spec import Spec
from flock_follower.ranges import Range
from flock_follower.resources import resource

LIMITS, END = GateLimits(), EndParams()
ORIGIN = {'latitude': Range(-90.0, 90.0, 'deg'), 'longitude': Range(-180.0, 180.0, 'deg'),
          'height': Range(-10_000.0, 10_000.0, 'm')}
SPECS = [
    Spec('connection', 'udpin:127.0.0.1:14540',
         'where the autopilot is: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or '
         '/dev/DEVICE[,BAUD]', read_only=True),
    Spec('autopilot', 'auto', 'its firmware; auto: as its HEARTBEAT says', choices=AUTOPILOTS,
         read_only=True),
    Spec.within(IDS, 'target_system', 1, 'MAVLink system id of the autopilot, the only one '
                'listened to', read_only=True),
    Spec.within(IDS, 'source_system', 1, 'own MAVLink system id', read_only=True),
    Spec('announce_as_gcs', False, 'send the HEARTBEAT of a ground station, so that PX4 tells its '
         'STATUSTEXTs on this link, too. While the bridge runs PX4 then takes the ground station '
         'for connected: the failsafe for the loss of the real one (NAV_DLL_ACT, COM_DL_LOSS_T) '
         'does not act, and acts when the bridge ends. ArduPilot goes by the system id, and '
         'talks anyway', read_only=True),
    Spec('signing_key_file', '', 'file with the 32-byte MAVLink 2 signing key; none: unsigned',
         read_only=True),
    Spec('stream_rate', 20.0, 'rate of setpoints between new commands', 'Hz', 5.0, 100.0,
         read_only=True),
    Spec('telemetry_rate', 50.0, "wanted rate of the autopilot's position and attitude; 20 for "
         '57600 baud', 'Hz', 5.0, 200.0, read_only=True),
    Spec('forward_odometry', False, 'send odom to the autopilot as ODOMETRY, for flight without '
         'GPS', read_only=True),
    Spec('odometry_rate', 30.0, 'most ODOMETRY messages per second, of 247 bytes each', 'Hz',
         10.0, 100.0, read_only=True),
    Spec('global_origin', [0.0, 0.0, 0.0], 'latitude, longitude (deg) and height (m) told to an '
         'estimator that has no origin, as it has none without GPS; PX4 is told no height. Zeros: '
         'not set; PX4 is then told one near Zurich where odometry is forwarded and GPS off',
         fixed_length=True, read_only=True),
    Spec('check_parameters', True, "compare the autopilot's parameters with the recommended ones",
         read_only=True),
    Spec('require_failsafe', True, 'refuse offboard while the autopilot would fly the last '
         'setpoint for over 1 s if the bridge died (COM_OF_LOSS_T, GUID_TIMEOUT), or stop its '
         'motors (COM_OBL_RC_ACT), or does not fuse the odometry that is forwarded to it '
         '(EKF2_EV_CTRL; VISO_TYPE, EK3_SRC1_POSXY, EK3_SRC1_VELXY), or tells not',
         read_only=True),
    Spec('takeoff_height', 2.5, 'height the takeoff service climbs by', 'm', 0.5, 30.0),
    Spec('velocity_source', 'auto', 'velocity for v_max and braking; auto: odom once heard',
         choices=VELOCITY_SOURCES, read_only=True),
    *ODOMETRY_SPECS,
    Spec.of(LIMITS, 'a_max', 'largest acceleration, of the vector'),
    Spec.of(LIMITS, 'v_max', 'largest speed, of the vector'),
    # The planner's period has to fit it: it is not to change under a flight.
    Spec.of(LIMITS, 'planner_timeout', 'oldest command obeyed', read_only=True),
    Spec.of(LIMITS, 'odom_timeout', 'oldest velocity used'),
    Spec.of(LIMITS, 'link_timeout', 'silence of the autopilot before braking'),
    Spec('blind_action', 'land', 'what follows after 2 s without any velocity, when the stream '
         'stops: a landing is requested; or silence only, on which PX4 fails over and ArduPilot '
         'stays in GUIDED',
         choices=BLIND_ACTIONS, read_only=True),
    Spec.of(LIMITS, 'yaw_disagreement', 'difference between the yaws of odom and of the '
            'autopilot above which it brakes, and refuses offboard'),
    Spec.of(LIMITS, 'velocity_disagreement', 'difference between their velocities above which it '
            'believes neither, where odom is the velocity source; 0: half of v_max, and 0.4 at '
            'least'),
    Spec('wind_compensation', 'auto', 'offset the steady acceleration by the wind, up to 1 m/s^2; '
         'auto: for PX4, which does not do so itself', choices=WIND_COMPENSATIONS,
         read_only=True),
    Spec.of(LIMITS, 'height_min', 'least height above the place of arming that setpoints fly to, '
            'by barometer or rangefinder', read_only=True),
    Spec.of(LIMITS, 'height_max', 'greatest height above the place of arming', read_only=True),
    Spec.of(LIMITS, 'radius_max', 'greatest horizontal distance from where it became ACTIVE',
            read_only=True),
    Spec.of(END, 'engage_timeout', 'time without a first command after it became ACTIVE, before '
            'the hold mode of the autopilot is requested', read_only=True),
    Spec('leader_lost_action', END.leader_lost_action, 'what follows 3 s after the last command: '
         'the hold mode of the autopilot, or after that a landing', choices=ACTIONS,
         read_only=True),
    Spec.of(END, 'battery_low', 'share of the battery below which, for 5 s, battery_action '
            'follows, and offboard is refused; 0: never', read_only=True),
    Spec('battery_action', END.battery_action, 'what follows on a low battery', choices=ACTIONS,
         read_only=True),
]


def build(values: dict[str, Any]) -> GateLimits:
    """Return the limits of the parameter values."""
    return GateLimits(**{field.name: values[field.name] for field in fields(GateLimits)
                         if field.name in values})


def end(values: dict[str, Any]) -> EndParams:
    """Return when a flight ends, by the parameter values."""
    return EndParams(**{field.name: values[field.name] for field in fields(EndParams)})


def origin(values: list[float]) -> tuple[float, float, float] | None:
    """
    Return latitude and longitude, deg, and height, m, or None for zeros.

    :raises ValueError: where they are no place on Earth.
    """
    if not any(values):
        return None
    for (name, valid), value in zip(ORIGIN.items(), values):
        valid.check(f'global_origin = {values}: {name}', value)
    latitude, longitude, height = values
    return latitude, longitude, height


def recommendations(forwarding: bool, takeoff_height: float) -> dict[str, list[Recommendation]]:
    """
    Return the recommended parameters of each autopilot by the name of its dialect.

    :param forwarding: whether odometry is forwarded, which takes more of them.
    :param takeoff_height: m; an autopilot that would climb higher by itself is to climb no higher.
    """
    found = {}
    for dialect in DIALECTS.values():
        text = resource(f'config/{dialect.recommendations}').read_text(encoding='utf-8')
        found[dialect.name] = [
            entry._replace(value=min(entry.value, takeoff_height))
            if entry.name == dialect.minimum_takeoff else entry
            for entry in read_recommendations(text, forwarding=forwarding)]
    return found
