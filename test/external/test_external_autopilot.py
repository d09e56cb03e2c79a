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

"""The link to an autopilot elsewhere: what it asks for, takes, and says where nothing comes."""

import socket
import time

from faulty_autopilot import TruthLink
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.autopilot import Endpoint
from flock_desk.external import external_autopilot
from flock_desk.external.external_autopilot import ExternalAutopilot
from flock_desk.external.vehicles_elsewhere import FORWARDED
from flock_desk.vehicles.embedded import EmbeddedAutopilot

pytestmark = pytest.mark.ros  # in real time: beside what computes it would be starved
DEADLINE = 20.0  # s, for what takes a fraction of one


@pytest.fixture
def port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


class Elsewhere:
    """An embedded autopilot in this process, stepped while the link waits for it."""

    def __init__(self, port, personality='px4', **fields):
        self.now = time.monotonic()
        self.autopilot = EmbeddedAutopilot(personality, now=self.now, **fields)
        self.end = Endpoint(('127.0.0.1', port), TruthLink(self.autopilot, self.now))

    def fly(self):
        """Return True, after flying on to now."""
        while self.now + 0.01 <= time.monotonic():
            self.now += 0.01
            self.autopilot.step(self.now)
            self.end.receive(0.0)
            self.end.step(self.now)
        return True


def fly_until(condition, elsewhere, external):
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline
        elsewhere.fly()
        external.receive(0.01)


@pytest.mark.parametrize(('personality', 'source'), [
    ('px4', 'HIL_STATE_QUATERNION'), ('arducopter', 'SIM_STATE')])
def test_it_asks_each_autopilot_for_the_truth_that_that_one_tells(port, personality, source):
    external = ExternalAutopilot(f'udpin:127.0.0.1:{port}')
    elsewhere = Elsewhere(port, personality)
    try:
        external.await_pose(DEADLINE, 'a reason', elsewhere.fly)
        assert external.motion.source == source
        fly_until(lambda: len(external.motion.times) > 1 and external.flying, elsewhere, external)
        assert external.armed and external.mode in ('AUTO.LOITER', 'LOITER')
        known = external.known(0.0)
        fly_until(lambda: external.known(0.0) > known + 0.1, elsewhere, external)
        assert external.motion.knows(round((known + 0.05) * 1e9))
    finally:
        external.close()
        elsewhere.end.close()


def test_where_nobody_is_it_says_so_in_time(port):
    external = ExternalAutopilot(f'udpin:127.0.0.1:{port}')
    try:
        with pytest.raises(ValueError, match=f"^truth_connection = 'udpin:127.0.0.1:{port}': no "
                           'pose of a vehicle within 0.2 s: nothing arrives$'):
            external.await_pose(0.2, '', lambda: True)
    finally:
        external.close()


def heartbeats(port):
    """Return a function that sends a HEARTBEAT of a PX4, and what it tells of itself."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    started = time.monotonic()

    def send(*messages):
        beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 3, 3)
        for message in (beat, *messages):
            line.sendto(message.pack(codec), ('127.0.0.1', port))
            codec.seq = (codec.seq + 1) % 256
        return True

    def estimate():
        boot = round((time.monotonic() - started) * 1e3) + 1
        return send(mavlink.MAVLink_attitude_quaternion_message(boot, 1, 0, 0, 0, 0, 0, 0),
                    mavlink.MAVLink_local_position_ned_message(boot, 1, 2, -3, 0, 0, 0))
    return line, send, estimate


def test_an_estimate_does_where_no_truth_comes_but_not_where_it_would_feed_itself(
        port, monkeypatch):
    monkeypatch.setattr(external_autopilot, 'TRUTH_TIMEOUT', 0.3)
    line, _, estimate = heartbeats(port)
    with line:
        external = ExternalAutopilot(f'udpin:127.0.0.1:{port}')
        try:
            with pytest.raises(ValueError, match='PX4 is heard, but sends no '
                               'HIL_STATE_QUATERNION.*it would feed itself$'):
                external.await_pose(DEADLINE, FORWARDED, estimate)
            external.await_pose(DEADLINE, '', estimate)
            assert external.motion.estimated
        finally:
            external.close()


def test_an_autopilot_without_a_position_is_told_from_one_that_is_not_there(port, monkeypatch):
    monkeypatch.setattr(external_autopilot, 'TRUTH_TIMEOUT', 0.1)
    line, send, _ = heartbeats(port)
    with line:
        external = ExternalAutopilot(f'udpin:127.0.0.1:{port}')
        try:
            with pytest.raises(ValueError, match='PX4 is heard, but sends no LOCAL_POSITION_NED: '
                               'it has no position'):
                external.await_pose(1.0, '', send)
        finally:
            external.close()


@pytest.mark.parametrize(('url', 'said'), [
    ('udp:127.0.0.1:14540', 'must be udpin:HOST:PORT'),
    ('udpin:127.0.0.1:99999', 'port = 99999')])
def test_a_url_that_is_none_is_refused(url, said):
    with pytest.raises(ValueError, match=said):
        ExternalAutopilot(url)
