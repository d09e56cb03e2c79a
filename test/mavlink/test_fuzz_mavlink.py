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

"""Millions of random and mutated bytes of MAVLink; ``make fuzz`` sends more."""

import math

from embedded_flight import setpoint
from fuzz_mavlink import (
    BridgeUnderFire,
    frame,
    fuzz_autopilot,
    fuzz_bridge,
    FuzzError,
    judge_moment,
    judge_setpoint,
    no_hang,
    Traffic,
)
from pymavlink.dialects.v20 import all as mavlink
import pytest

pytestmark = pytest.mark.slow
BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])


@BOTH
def test_no_byte_stops_the_bridge_or_gets_a_bad_setpoint_out_of_it(personality):
    under_fire = fuzz_bridge(800_000, 1, personality)
    # The fuzzing reached what it is for: the vehicle obeyed, commands passed, others did not.
    assert under_fire.sent['SET_POSITION_TARGET_LOCAL_NED'] > 200
    assert min(under_fire.kinds[kind] for kind in ('command', 'brake', 'none')) > 20
    assert min(under_fire.sent[kind] for kind in (
        'COMMAND_LONG', 'ODOMETRY', 'PARAM_REQUEST_READ', 'TIMESYNC')) > 0
    assert min(under_fire.link.ignored[reason] for reason in (
        'undecodable', 'other system', 'other component', 'second sender')) > 50


def test_with_signing_nothing_forged_is_heard():
    under_fire = fuzz_bridge(200_000, 2, signing_key=b'0123456789abcdef' * 2)
    assert under_fire.link.ignored['wrong signature'] > 500
    autopilot = under_fire.traffic.autopilot
    assert under_fire.link.telemetry.status.mode in autopilot.controller.PROFILE.modes
    assert under_fire.link.received > 500
    assert not under_fire.link.other_autopilots


@BOTH
def test_no_byte_stops_the_embedded_autopilot(personality):
    autopilot = fuzz_autopilot(200_000, 3, personality)
    assert all(math.isfinite(value) for value in autopilot.vehicle.position)


def test_equal_seeds_send_equal_bytes():
    traffic = [Traffic(5, 'px4'), Traffic(5, 'px4'), Traffic(6, 'px4')]
    chunks = [[source.chunk() for _ in range(300)] for source in traffic]
    assert chunks[0] == chunks[1] != chunks[2]


@pytest.mark.parametrize(('bad', 'complaint'), [
    ({'east': math.nan}, 'not finite'), ({'yaw': math.inf}, 'not finite'),
    ({'east': 2.0, 'north': 2.0}, 'above a_max'), ({'mask': 0xDF8}, 'unknown meaning'),
    ({'mask': 0xA3F}, 'unknown meaning'), ({'frame': 8}, 'unknown meaning')])
def test_a_bad_setpoint_would_be_found(bad, complaint):
    with pytest.raises(FuzzError, match=complaint):
        judge_setpoint(setpoint(**bad), 2.5)
    judge_setpoint(setpoint(2.4), 2.5)


def test_a_setpoint_at_a_bad_moment_would_be_found():
    up, level = setpoint(up=0.1), setpoint()
    with pytest.raises(FuzzError, match='upward setpoint on the ground'):
        judge_moment(up, mavlink.MAV_LANDED_STATE_ON_GROUND, False, math.inf)
    with pytest.raises(FuzzError, match=r'setpoint 9\.90 s after a takeover'):
        judge_moment(level, mavlink.MAV_LANDED_STATE_IN_AIR, False, 9.9)
    judge_moment(level, mavlink.MAV_LANDED_STATE_ON_GROUND, False, 10.0)
    judge_moment(up, mavlink.MAV_LANDED_STATE_ON_GROUND, True, math.inf)
    judge_moment(up, mavlink.MAV_LANDED_STATE_IN_AIR, False, math.inf)


def test_an_exception_would_be_found_with_its_input(monkeypatch):
    def broken(bridge, now):
        raise KeyError('oops')
    monkeypatch.setattr('flock_follower.mavlink.bridge.Bridge.receive', broken)
    expected = r"px4, seed 7, after 0 bytes: KeyError: 'oops' \(in broken"
    with pytest.raises(FuzzError, match=expected):
        fuzz_bridge(100, 7)


def test_a_hang_would_be_found(monkeypatch):
    monkeypatch.setattr('fuzz_mavlink.LONGEST', 1)
    with pytest.raises(FuzzError, match='still busy after 1 s'), no_hang('a loop'):
        while True:
            pass


def test_forged_frames_are_believed_by_a_parser():
    message = setpoint(1.0)
    codec = mavlink.MAVLink(None, 1, 1)
    packed = bytes(message.pack(codec))
    kind = mavlink.mavlink_map[84]
    assert frame(84, packed[10:-2], crc_extra=kind.crc_extra) == packed


def test_the_bridge_under_fire_hears_its_autopilot():
    under_fire = BridgeUnderFire(1)
    for _ in range(2000):
        under_fire.receive(*under_fire.traffic.chunk())
    assert under_fire.bridge.alive(under_fire.now)
