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

"""Links to autopilots elsewhere: what they ask for and take, and where nothing comes or stalls."""

from functools import partial
import socket
import time

from faulty_autopilot import TruthLink
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.autopilot import Endpoint
from flock_desk.external import external_autopilot
from flock_desk.external.external_autopilot import (
    ExternalAutopilot,
    ExternalVehicles,
    FORWARDED,
    REPORTED_SILENCE,
)
from flock_desk.runs.processes import free_udp_port
from flock_desk.vehicles.embedded import EmbeddedAutopilot

pytestmark = pytest.mark.ros  # in real time: beside what computes it would be starved
DEADLINE = 20.0  # s, for what takes a fraction of one
DEGREE = 111_320.0  # m along a meridian
NORTH = 47.4  # degrees, where the follower is


def pose(north=0.0, up=0.0):
    """Return the truth of a PX4, m north of and above the follower's home."""
    return mavlink.MAVLink_hil_state_quaternion_message(
        0, [1, 0, 0, 0], 0, 0, 0, round((NORTH + north / DEGREE) * 1e7), round(8.5e7),
        round((488.0 + up) * 1e3), *[0] * 8)


class Report:
    """A link to an autopilot that tells nothing by itself, and that autopilot's end of it."""

    def __init__(self, system=1, parameter='truth_connection'):
        self.port = free_udp_port()
        self.link = ExternalAutopilot(f'udpin:127.0.0.1:{self.port}', system, parameter)
        self._codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def say(self, *messages):
        """Send HEARTBEAT and messages; return True."""
        beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 3, 3)
        for message in (beat, *messages):
            self._line.sendto(message.pack(self._codec), ('127.0.0.1', self.port))
            self._codec.seq = (self._codec.seq + 1) % 256
        return True

    def estimate(self):
        return self.say(mavlink.MAVLink_attitude_quaternion_message(0, 1, 0, 0, 0, 0, 0, 0),
                        mavlink.MAVLink_local_position_ned_message(0, 1, 2, -3, 0, 0, 0))

    def close(self):
        self._line.close()
        self.link.close()


@pytest.fixture
def two(monkeypatch):
    monkeypatch.setattr(external_autopilot, 'TRUTH_TIMEOUT', 0.3)
    monkeypatch.setattr(external_autopilot, 'POSE_TIMEOUT', 1.0)
    both = [Report(), Report(2, 'leader_truth_connection')]
    yield both
    for reported in both:
        reported.close()


@pytest.mark.parametrize(('personality', 'source'), [
    ('px4', 'HIL_STATE_QUATERNION'), ('arducopter', 'SIM_STATE')])
def test_each_autopilot_is_asked_for_the_truth_it_sends(personality, source):
    port, now = free_udp_port(), time.monotonic()
    external = ExternalAutopilot(f'udpin:127.0.0.1:{port}')
    autopilot = EmbeddedAutopilot(personality, now=now)
    end = Endpoint(('127.0.0.1', port), TruthLink(autopilot, now))

    def fly():
        """Return True, after flying on to now."""
        while autopilot.next_step <= time.monotonic():
            step = autopilot.next_step
            autopilot.step(step)
            end.receive(0.0)
            end.step(step)
        external.receive(0.01)
        return True
    try:
        external.await_pose(DEADLINE, 'a reason', fly)
        known, deadline = external.known, time.monotonic() + DEADLINE
        while not external.flying or external.known < known + 0.1:
            assert fly() and time.monotonic() < deadline
        assert (external.motion.source, external.armed) == (source, True)
        assert external.mode in ('AUTO.LOITER', 'LOITER')
        assert external.motion.knows(round((known + 0.05) * 1e9))
    finally:
        external.close()
        end.close()


@pytest.mark.parametrize(('received', 'forwarded', 'reported'), [
    (None, '', 'no pose of a vehicle within 0.4 s: nothing arrives$'),
    # An autopilot without a position is told from one that is not there.
    (Report.say, '', 'PX4 is connected, but sends no LOCAL_POSITION_NED: it has no position'),
    (Report.estimate, FORWARDED,
     'PX4 is connected, but sends no HIL_STATE_QUATERNION.*it would feed itself$')])
def test_where_no_pose_comes_it_says_so_in_time(two, received, forwarded, reported):
    speak = partial(received, two[0]) if received else lambda: True
    with pytest.raises(ValueError, match=f"^truth_connection = 'udpin:127.0.0.1:.*{reported}"):
        two[0].link.await_pose(0.4, forwarded, speak)


def test_an_estimate_does_where_no_truth_comes(two):
    two[0].link.await_pose(DEADLINE, '', two[0].estimate)
    assert two[0].link.motion.estimated


# Two vehicles elsewhere.

def test_both_count_from_where_the_follower_was_first_heard_of(two):
    follower, leader = two
    vehicles = ExternalVehicles(follower.link, leader.link)
    deadline = time.monotonic() + DEADLINE
    while not leader.link._arrived:  # the leader tells first
        assert leader.say(pose(1.5, 2.0)) and time.monotonic() < deadline
    vehicles.find(False, lambda: follower.say(pose()) and leader.say(pose(1.5, 2.0)))
    places = [reported.link.motion.at(reported.link.motion.newest).position for reported in two]
    np.testing.assert_allclose(places, [[0.0, 0.0, 0.0], [0.0, 1.5, 2.0]], atol=0.006)  # 1e-7 deg
    assert vehicles.sources == dict.fromkeys(('vehicle', 'leader'), 'HIL_STATE_QUATERNION')
    assert vehicles.start_ns == follower.link.motion.newest


@pytest.mark.parametrize(('silent', 'received', 'reported'), [
    (0, True, '^truth_connection = .*PX4 is connected, but sends no HIL_STATE_QUATERNION; its own '
              'estimate is not sufficient: two vehicles are flown elsewhere'),
    (1, True, '^leader_truth_connection = .*its own estimate is not sufficient'),
    (1, False, '^leader_truth_connection = .*no pose of a vehicle within 1 s: nothing arrives$')])
def test_of_two_vehicles_both_have_to_tell_the_truth(silent, received, reported, two):
    vehicles = ExternalVehicles(two[0].link, two[1].link)

    def speak():
        return (two[silent].say() if received else True) and two[1 - silent].say(pose())
    with pytest.raises(ValueError, match=reported):
        vehicles.find(False, speak)


def test_whose_poses_stall_is_told_and_what_is_missing(two):
    follower, leader = two
    vehicles = ExternalVehicles(follower.link, leader.link)
    vehicles.find(False, lambda: follower.say(pose()) and leader.say(pose(1.5)))
    newest = [reported.link.motion.newest for reported in two]
    assert vehicles.stalled(max(newest) * 1e-9, 0) == ''  # though one pose is all that there is
    found = {}
    # As if both had told at 50 Hz for 0.3 s, and the leader no more.
    for k in range(1, 60):
        for reported, since in zip(two if k < 16 else two[:1], newest):
            reported.link.motion.take(pose(), since + k * 20_000_000)
        now = max(reported.link.motion.newest for reported in two) * 1e-9
        flown = follower.link.motion.newest - vehicles.start_ns
        found[round((k - 15) * 0.02, 2)] = vehicles.stalled(now, flown)
    assert found[0.12] == ''  # the leader's may be late
    assert found[0.4] == 'poses of the leader come too far apart: no image between them'
    assert found[0.88].startswith('no pose of the leader for 0.9 s: no image: PX4 is connected')
    assert 'odometry' not in found[0.88] and vehicles.gone(now) == ''
    stalled = vehicles.stalled(now + REPORTED_SILENCE + 0.1, flown)
    assert stalled.startswith('no pose of the vehicle for 0.6 s: no image, no odometry: ')
    assert vehicles.gone(now + 10.1).startswith('no pose of the vehicle for 10 s on udpin:')
