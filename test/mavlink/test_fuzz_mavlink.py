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

"""Random and mutated bytes of MAVLink; ``make fuzz`` sends more."""

import math

from fuzz_mavlink import (
    fuzz_autopilot,
    fuzz_bridge,
)
import pytest

from flock_follower.mavlink.link import BAD_SIGNATURE, UNDECODABLE

pytestmark = pytest.mark.slow
BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])


@BOTH
def test_no_bytes_stop_bridge_or_yield_bad_setpoint(personality):
    under_fire = fuzz_bridge(220_000, 1, personality)
    # The fuzzing reached what it is for: the vehicle obeyed, commands passed, others did not.
    assert under_fire.sent['SET_POSITION_TARGET_LOCAL_NED'] > 100
    assert min(under_fire.kinds[kind] for kind in ('command', 'brake', 'none')) > 3
    assert min(under_fire.sent[kind] for kind in (
        'COMMAND_LONG', 'ODOMETRY', 'PARAM_REQUEST_READ', 'TIMESYNC')) > 0
    assert min(under_fire.link.ignored[reason] for reason in (
        UNDECODABLE, 'of system id 2, not target_system 1',
        'of a companion computer (system id 1, component 191)', 'second sender')) > 20


def test_with_signing_nothing_forged_is_heard():
    under_fire = fuzz_bridge(60_000, 2, signing_key=b'0123456789abcdef' * 2)
    assert under_fire.link.ignored[BAD_SIGNATURE] > 200
    autopilot = under_fire.traffic.autopilot
    assert under_fire.link.telemetry.status.mode in autopilot.controller.PROFILE.modes
    assert not any('system id' in reason for reason in under_fire.link.ignored)


@BOTH
def test_no_byte_stops_the_embedded_autopilot(personality):
    autopilot = fuzz_autopilot(50_000, 3, personality)
    assert all(math.isfinite(value) for value in autopilot.vehicle.position)
