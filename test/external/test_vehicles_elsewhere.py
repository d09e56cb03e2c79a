"""Two vehicles elsewhere: one frame for both, truth of both, and whose poses stall."""

import socket
import time

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.external import external_autopilot, vehicles_elsewhere
from flock_desk.external.external_autopilot import ExternalAutopilot
from flock_desk.external.told_motion import LONGEST_GAP
from flock_desk.external.vehicles_elsewhere import LATE, VehiclesElsewhere

pytestmark = pytest.mark.ros  # in real time: beside what computes it would be starved
DEADLINE = 20.0  # s, for what takes a fraction of one
DEGREE = 111_320.0  # m along a meridian
NORTH = 47.4  # degrees, where the follower is


class Told:
    """A link to an autopilot that tells nothing by itself, and that autopilot's end of it."""

    def __init__(self, system, parameter):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(('127.0.0.1', 0))
            self.port = probe.getsockname()[1]
        self.link = ExternalAutopilot(f'udpin:127.0.0.1:{self.port}', system, parameter)
        self._codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def say(self, north=None, up=0.0):
        """Send HEARTBEAT, and where it is: m north of the follower's home."""
        messages = [mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 3, 3)]
        if north is not None:
            messages.append(mavlink.MAVLink_hil_state_quaternion_message(
                0, [1, 0, 0, 0], 0, 0, 0, round((NORTH + north / DEGREE) * 1e7), round(8.5e7),
                round((488.0 + up) * 1e3), 0, 0, 0, 0, 0, 0, 0, 0))
        for message in messages:
            self._line.sendto(message.pack(self._codec), ('127.0.0.1', self.port))
        return True

    def close(self):
        self._line.close()
        self.link.close()


@pytest.fixture
def two(monkeypatch):
    monkeypatch.setattr(external_autopilot, 'TRUTH_TIMEOUT', 0.3)
    monkeypatch.setattr(vehicles_elsewhere, 'POSE_TIMEOUT', 1.0)
    both = [Told(1, 'truth_connection'), Told(2, 'leader_truth_connection')]
    yield both
    for told in both:
        told.close()


def test_both_count_from_where_the_follower_was_first_heard_of(two):
    follower, leader = two
    vehicles = VehiclesElsewhere(follower.link, leader.link)
    deadline = time.monotonic() + DEADLINE
    while not leader.link._arrived:  # the leader tells first
        assert leader.say(1.5, 2.0) and time.monotonic() < deadline
    vehicles.find(False, lambda: follower.say(0.0) and leader.say(1.5, 2.0))
    places = [link.motion.at(link.motion.newest).position for link in (
        follower.link, leader.link)]
    np.testing.assert_allclose(places, [[0.0, 0.0, 0.0], [0.0, 1.5, 2.0]], atol=0.006)  # 1e-7 deg
    assert vehicles.sources == dict.fromkeys(('vehicle', 'leader'), 'HIL_STATE_QUATERNION')
    assert vehicles.start_ns == follower.link.motion.newest


@pytest.mark.parametrize(('silent', 'parameter'), [
    (0, 'truth_connection'), (1, 'leader_truth_connection')])
def test_of_two_vehicles_an_estimate_will_not_do(silent, parameter, two):
    vehicles = VehiclesElsewhere(two[0].link, two[1].link)

    def told():
        return two[silent].say() and two[1 - silent].say(0.0)
    with pytest.raises(ValueError, match=f'^{parameter} = .*: PX4 is heard, but sends no '
                       'HIL_STATE_QUATERNION; its own estimate will not do where two vehicles '
                       'are flown elsewhere: each estimate has its own origin$'):
        vehicles.find(False, told)


def test_a_leader_that_is_not_there_is_told_by_its_parameter(two):
    vehicles = VehiclesElsewhere(two[0].link, two[1].link)
    with pytest.raises(ValueError, match=f"^leader_truth_connection = 'udpin:127.0.0.1:"
                       f"{two[1].port}': no pose of a vehicle within 1 s: nothing arrives$"):
        vehicles.find(False, lambda: two[0].say(0.0))


def test_whose_poses_stall_is_told_and_what_is_missing(two):
    follower, leader = two
    vehicles = VehiclesElsewhere(follower.link, leader.link)
    vehicles.find(False, lambda: follower.say(0.0) and leader.say(1.5))
    newest = [told.link.motion.newest for told in two]
    assert vehicles.stalled(max(newest) * 1e-9, 0) == ''  # though one pose is all that there is
    # As if both had told at 50 Hz for 0.3 s, and the leader no more.
    hil = mavlink.MAVLink_hil_state_quaternion_message(
        0, [1, 0, 0, 0], 0, 0, 0, round(NORTH * 1e7), round(8.5e7), 488_000, *[0] * 8)
    for k in range(1, 16):
        for told, since in zip(two, newest):
            told.link.motion.take(hil, since + k * 20_000_000)
    flown = follower.link.motion.newest - vehicles.start_ns
    now = max(told.link.motion.newest for told in two) * 1e-9
    assert vehicles.stalled(now, flown) == '' and vehicles.gone(now) == ''
    for k in range(16, 60):
        follower.link.motion.take(hil, newest[0] + k * 20_000_000)
        flown = follower.link.motion.newest - vehicles.start_ns
        told = vehicles.stalled(follower.link.motion.newest * 1e-9, flown)
        missing = (k - 15) * 0.02
        if missing < 0.13:
            assert told == ''  # the leader's may be late
        elif 0.17 + LONGEST_GAP * 1e-9 < missing < LATE - 0.03:
            assert told == 'poses of the leader come too far apart: no image between them'
    now = follower.link.motion.newest * 1e-9
    told = vehicles.stalled(now, flown)
    assert told.startswith('no pose of the leader for 0.9 s: no image: PX4 is heard')
    assert 'odometry' not in told and vehicles.gone(now) == ''
    told = vehicles.stalled(now + LATE + 0.1, flown)
    assert told.startswith('no pose of the vehicle for 0.6 s: no image, no odometry: ')
    assert 'no pose of the leader for 1.5 s' in told
    assert vehicles.gone(now + 10.1).startswith('no pose of the vehicle for 10 s on udpin:')
