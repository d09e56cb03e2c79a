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

"""A flight in real time without clock, socket or ROS: its sensors show the truth."""

import math
from types import SimpleNamespace

from marker_images import seen_corners
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.camera.renderer import T_BODY_MARKER, T_BODY_OPTICAL
from flock_desk.closed_loop.flown import EmbeddedVehicle, ExternalLeader, ExternalVehicle
from flock_desk.closed_loop.real_time_flight import (
    calibration,
    CAMERA_SENSOR,
    LATEST_NS,
    real_time_camera,
    RealTimeFlight,
    STEP_NS,
)
from flock_desk.closed_loop.scenario_run import ScenarioRun
from flock_desk.external.external_motion import ExternalMotion, Motion
from flock_desk.scenarios.scenario import (
    LeaderMotion,
    Outage,
    RangeErrors,
    Scenario,
    Sensing,
    VioErrors,
)
from flock_desk.sensors.vio import Odometry
from flock_follower.geometry import (
    quaternion_from_yaw,
    quaternion_to_matrix,
    Transform,
    yaw_from_quaternion,
)
from flock_follower.geometry.rotation_vectors import matrix_to_rotation_vector
from flock_follower.mavlink.ned import enu_to_ned, yaw_enu_to_ned
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.markers import detect

pytestmark = pytest.mark.slow
SIDE = 0.16
STILL = Sensing(latency=(0.1, 0.1))


def scenario(**fields):
    at_once = VioErrors(latency=(0.0, 0.0))
    return Scenario('test', 'for a test', duration=20.0, **{'odometry': at_once, **fields})


@pytest.fixture(scope='module')
def camera():
    return real_time_camera(0)


class Commanded:
    """A live flight whose autopilot obeys accelerations in offboard mode, step by step."""

    def __init__(self, camera, acceleration=(0.0, 0.0, 0.0), yaw=0.0, **fields):
        self.flight = RealTimeFlight(scenario(sensing=STILL, **fields), 0,
                                     EmbeddedVehicle(0.0, 1.5), camera)
        # Acceleration and yaw, as the bridge sends them: mask 0x83F.
        self._setpoint = mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, 0x83F, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            *enu_to_ned(acceleration), yaw_enu_to_ned(yaw), 0.0)
        self.odometry, self.frames = [], []

    def fly(self, seconds, engaged=True, look=True):
        for _ in range(round(seconds * 1e9) // STEP_NS):
            now = (self.flight.time_ns + STEP_NS) * 1e-9
            controller = self.flight.vehicle.autopilot.controller
            controller.on_setpoint(self._setpoint, now)
            if controller.mode != 'OFFBOARD':
                controller.change_mode('OFFBOARD', now)
            controller.wind = self.flight.scenario.wind(self.flight.time)
            self.flight.vehicle.autopilot.step(now)
            self.odometry += [(stamp, self.flight.time_ns, state)
                              for stamp, state in self.flight.after_step(engaged)]
            frame = self.flight.look(self.flight.time_ns) if look else None
            if frame is not None:
                self.frames.append(frame)
        return self


def test_the_scenario_begins_once_engaged_in_offboard_mode(camera):
    ranges = RangeErrors(20.0, noise=0.001, bias=0.0, bias_walk=0.0, outliers=0.0)
    waiting = Commanded(camera, ranges=ranges).fly(1.5, engaged=False, look=False)
    assert waiting.flight.vehicle.autopilot.controller.mode == 'OFFBOARD'
    assert waiting.flight.began_ns is None
    assert waiting.flight.distance == pytest.approx(1.5, abs=0.05)
    assert waiting.flight.measured() == pytest.approx(1.5, abs=0.06)
    waiting.fly(0.5, look=False)
    assert waiting.flight.time == pytest.approx(0.5, abs=0.011)


def test_images_come_at_30_hz_late_by_remaining_latency(camera):
    frames = Commanded(camera).fly(1.0).frames
    assert len(frames) in (29, 30)
    stamps = np.array([f.stamp_ns for f in frames])
    assert np.all(np.abs(np.diff(stamps) - 1e9 / 30) <= 1)
    delays = np.array([f.due_ns - f.stamp_ns for f in frames]) * 1e-9
    assert delays.min() >= 0.09 - 0.02 and delays.max() <= 0.11 - 0.02
    assert np.ptp(delays) > 0.01
    late = RealTimeFlight(scenario(sensing=STILL), 0, EmbeddedVehicle(0.0, 1.5), camera)
    for _ in range(20):
        late.after_step(False)
    assert late.look(1_000_000_000) is None
    assert late.skipped_images == 6  # those of the first 0.2 s


def test_image_shows_marker_at_truth_camera_and_mounting(camera):
    motion = LeaderMotion(motion='circle', wait=0.0, speed=(0.5, 0.5), size=1.0)
    flown = Commanded(camera, (0.2, -0.1, 0.05), yaw=-0.1, leader=motion).fly(2.0)
    k = calibration(camera.camera)
    model = CameraModel(np.reshape(k['k'], (3, 3)), k['d'], k['distortion_model'], k['width'],
                        k['height'])
    h = SIDE / 2
    corners = [[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]]
    checked = 0
    for frame in flown.frames[10::10]:
        body, target = (Transform(quaternion_to_matrix(s.quaternion), s.position)
                        for s in (frame.follower, frame.leader))
        optical = (body @ T_BODY_OPTICAL).inverse() @ target @ T_BODY_MARKER
        off = seen_corners(frame.pixels, model, SIDE) - model.project(optical.apply(corners))
        assert np.linalg.norm(off, axis=1).max() < 0.3  # px
        checked += 1
    assert checked >= 4


def test_outages_silence_odometry_and_hide_the_leader(camera):
    outages = (Outage('vio', 0.5, 0.4), Outage('marker', 1.2, 0.4))
    flown = Commanded(camera, outages=outages)
    flown.fly(3.2)  # offboard mode takes a second of setpoints
    began = flown.flight.began_ns * 1e-9
    times = np.arange(1, flown.flight.time_ns // STEP_NS + 1) * STEP_NS * 1e-9 - began
    lost = ~np.isin(np.arange(1, len(times) + 1) * STEP_NS, [o[0] for o in flown.odometry])
    assert np.array_equal(lost, (times >= 0.5 - 1e-9) & (times < 0.9 - 1e-9))
    for frame in flown.frames[::3]:
        time = frame.stamp_ns * 1e-9 - began
        found = len(detect(frame.pixels, 'DICT_4X4_50').ids) == 1
        assert found == (not 1.2 <= time < 1.6)
        assert frame.usable == (not (1.2 <= time < 1.6 or 0.5 <= time < 0.9))


def test_light_changes_hide_marker_as_long_as_scenario_sets():
    changing = ScenarioRun(scenario(sensing=Sensing(light_changes=30.0)), 3)
    assert len(changing.light_changes) > 3
    for begin, end in changing.light_changes:
        assert 0.1 <= end - begin <= 0.4 and changing.hides(0.5 * (begin + end))
    assert not any(ScenarioRun(scenario(), 3).hides(0.1 * k) for k in range(200))


def test_leader_tilts_with_acceleration_twist_fits_pose():
    motion = LeaderMotion(motion='circle', wait=0.0, speed=(1.0, 1.0), size=1.5, heading='course')
    live, time, h = ScenarioRun(scenario(leader=motion), 1), 9.0, 0.01
    before, state, after, opposite = (live.motion(0, t) for t in (
        time - h, time, time + h, time + math.pi * 1.5 / 1.0))
    rotation = quaternion_to_matrix(state.quaternion)
    # Towards the middle of the circle.
    assert rotation[:, 2] @ (opposite.position - state.position) > 0.05
    assert rotation @ state.linear == pytest.approx(
        (after.position - before.position) / (2 * h), abs=1e-3)
    turn = quaternion_to_matrix(before.quaternion).T @ quaternion_to_matrix(after.quaternion)
    assert state.angular == pytest.approx(matrix_to_rotation_vector(turn) / (2 * h), abs=0.02)
    assert yaw_from_quaternion(state.quaternion) == pytest.approx(
        math.atan2(*(rotation @ state.linear)[1::-1]), abs=0.05)


def test_a_leader_that_faces_away_turns_its_tail_to_the_follower():
    live = ScenarioRun(scenario(leader=LeaderMotion(heading='away')), 0)
    follower = Odometry(0.0, np.array([1.5, -1.5, 1.5]), quaternion_from_yaw(0.0), np.zeros(3),
                        np.zeros(3))
    for k in range(1500):
        live.step(follower, 0.01 * k, offboard=True)
    assert yaw_from_quaternion(live.motion(0, 15.0).quaternion) == pytest.approx(
        math.pi / 2, abs=0.01)


# Vehicles flown elsewhere.

START = 5_000_000_000  # ns, of the flight
PERIOD = 20_000_000  # ns between poses
LATE = 13_000_000  # ns by which those of the leader come later
EXACT = VioErrors(latency=(0.0, 0.0), **dict.fromkeys((
    'position_walk', 'height_walk', 'yaw_walk', 'position', 'tilt', 'tilt_bias', 'attitude',
    'velocity', 'velocity_white', 'gyro_bias', 'gyro'), 0.0))
NEVER = math.inf, math.inf


class Elsewhere:
    """
    A vehicle that climbs to 2 m, flies north at 0.2 m/s and faces north-east.

    With ``led`` its leader, too, is flown elsewhere: 2 m ahead at 2 m height, north at 0.3 m/s.
    """

    def __init__(self, camera, led=False):
        self.motion, self.ahead = ExternalMotion(), ExternalMotion()
        self.sent_ns, self.led_ns = START - PERIOD, START - PERIOD
        self.report(START)
        autopilot = SimpleNamespace(motion=self.motion, armed=True, mode='')
        self.vehicle = ExternalVehicle(autopilot, START, height=0.0)
        self.flight = RealTimeFlight(
            scenario(sensing=STILL, odometry=EXACT), 0, self.vehicle, camera,
            LATEST_NS + 40_000_000 * led,
            ExternalLeader(self.ahead, START, self.vehicle.origin) if led else None)
        self.odometry, self.frames, self.distances = [], [], []

    def report(self, now, silent=NEVER):
        east_of_north = quaternion_from_yaw(math.pi / 4)
        while self.sent_ns + PERIOD <= now:
            self.sent_ns += PERIOD
            time = (self.sent_ns - START) * 1e-9
            if not silent[0] < time < silent[1]:
                self.motion.add(Motion(
                    self.sent_ns, np.array([0.0, 0.2 * time, 2.0 * min(time, 1.0)]),
                    np.array([0.0, 0.2, 2.0 * (time < 1.0)]), east_of_north, np.zeros(3)))
        while self.led_ns + PERIOD + LATE * (self.led_ns > START) <= now:
            self.led_ns += PERIOD
            time = (self.led_ns - START) * 1e-9
            self.ahead.add(Motion(
                self.led_ns, np.array([0.0, 2.0 + 0.3 * time, 2.0]),
                np.array([0.0, 0.3, 0.0]), east_of_north, np.zeros(3)))

    def fly(self, seconds, engaged=False, silent=NEVER):
        """Fly on; no pose is reported from one moment of the flight to another, s."""
        end = self.flight.time_ns + round(seconds * 1e9)
        while self.flight.time_ns < end:
            self.report(START + self.flight.time_ns + STEP_NS + PERIOD, silent)
            self.odometry += self.flight.after_step(engaged)
            self.distances.append(self.flight.distance)
            frame = self.flight.look(self.flight.time_ns)
            self.frames += [] if frame is None else [frame]
        return self

    def offboard(self, value, seconds=0.2, engaged=False):
        self.vehicle.offboard = value
        return self.fly(seconds, engaged).frames[-1]


def test_leader_reaches_follower_with_each_mode_before_start(
        camera):
    flown = Elsewhere(camera).fly(1.5)
    assert math.isnan(flown.flight.distance)
    assert {(frame.leader, frame.usable) for frame in flown.frames} == {(None, False)}
    frame = flown.offboard(True)
    # 1.5 m ahead of where it faced then, at its height, facing away from it as it did.
    offset = frame.leader.position - flown.vehicle.at(1_510_000_000).position
    assert offset == pytest.approx([1.5 * math.sqrt(0.5), 1.5 * math.sqrt(0.5), 0.0], abs=0.05)
    assert yaw_from_quaternion(frame.leader.quaternion) == pytest.approx(math.pi / 4, abs=1e-6)
    assert flown.offboard(False, 0.5).leader is None and flown.flight.began_ns is None
    again = flown.offboard(True)
    assert again.leader.position - frame.leader.position == pytest.approx(
        [0.0, 0.7 * 0.2, 0.0], abs=0.02)
    flown.offboard(True, engaged=True)
    assert flown.flight.time == pytest.approx(0.19, abs=0.011)
    assert flown.offboard(False).leader is not None  # the pilot's switch, in the middle of it


def test_without_poses_no_image_and_no_odometry_is_invented(camera):
    flown = Elsewhere(camera).fly(3.0, silent=(1.0, 1.8))
    stamps = np.array([stamp for stamp, _ in flown.odometry]) * 1e-9
    images = np.array([frame.stamp_ns for frame in flown.frames]) * 1e-9
    for times, spacing in ((stamps, 0.01), (images, 1 / 30)):
        assert not np.any((times > 1.0) & (times < 1.8 - 1e-9))
        others = times[(times < 1.0) | (times > 1.8)]
        assert np.count_nonzero(np.diff(others) > 1.5 * spacing) == 1
    assert flown.flight.skipped_images >= 23  # of 0.8 s
    state = flown.odometry[-1][1]
    assert state.position == pytest.approx([0.0, 0.6, 2.0], abs=0.03)
    assert quaternion_to_matrix(state.quaternion) @ state.linear == pytest.approx(
        [0.0, 0.2, 0.0], abs=0.01)


def test_external_leader_is_at_its_report_scenario_leader_absent(camera):
    flown = Elsewhere(camera, led=True).fly(1.5)
    assert flown.distances[-1] == pytest.approx(2.15, abs=0.02)
    flown.offboard(True, 1.0, engaged=True)
    for frame in flown.frames:
        north = 2.0 + 0.3 * frame.stamp_ns * 1e-9
        assert frame.usable
        assert frame.leader.position == pytest.approx([0.0, north, 2.0], abs=1e-6)
        # Every pose that the image shows had been reported.
        assert START + frame.stamp_ns + round(0.5e9 * CAMERA_SENSOR.exposure) <= flown.ahead.newest
    assert len(flown.frames) >= 73 and flown.flight.skipped_images == 0
    leader = ExternalLeader(flown.ahead, START, np.zeros(3))
    for stalled, there in ((0.1, True), (0.2, False)):
        at = flown.ahead.newest - START + round(stalled * 1e9)
        assert (leader.motion(at, 0.0) is not None) == there
