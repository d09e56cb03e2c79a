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

"""A live flight without clock, socket or ROS: its sensors show what is true."""

import math

from marker_images import seen_corners
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.camera.renderer import Light, T_BODY_MARKER, T_BODY_OPTICAL
from flock_desk.closed_loop.flown import EmbeddedVehicle
from flock_desk.closed_loop.real_time_flight import (
    calibration,
    real_time_camera,
    RealTimeFlight,
    STEP_NS,
)
from flock_desk.closed_loop.scenario_run import ScenarioRun
from flock_desk.scenarios.scenario import (
    LeaderMotion,
    Outage,
    RangeErrors,
    Scenario,
    Sensing,
    VioErrors,
)
from flock_follower.geometry import (
    enu_to_ned,
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    Transform,
    yaw_enu_to_ned,
    yaw_from_quaternion,
)
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
                controller.outbox.clear()
            controller.wind = self.flight.scenario.wind(self.flight.time)
            self.flight.vehicle.autopilot.step(now)
            self.odometry += [(stamp, self.flight.time_ns, state)
                              for stamp, state in self.flight.after_step(engaged)]
            frame = self.flight.look(self.flight.time_ns) if look else None
            if frame is not None:
                self.frames.append(frame)
        return self


def test_the_scenario_begins_once_engaged_in_offboard_mode(camera):
    waiting = Commanded(camera).fly(1.5, engaged=False, look=False)
    assert waiting.flight.vehicle.autopilot.controller.mode == 'OFFBOARD'
    assert waiting.flight.began_ns is None
    assert waiting.flight.distance == pytest.approx(1.5, abs=0.05)
    waiting.fly(0.5, look=False)
    assert waiting.flight.time == pytest.approx(0.5, abs=0.011)


def test_ranges_come_at_their_rate_and_are_of_the_distance(camera):
    errors = RangeErrors(20.0, noise=0.01, bias=0.0, bias_walk=0.0, outliers=0.0)
    measured = []
    for ranges in (errors, RangeErrors()):
        flight = RealTimeFlight(scenario(sensing=STILL, ranges=ranges), 0,
                                EmbeddedVehicle(0.0, 1.5), camera)
        measured.append([])
        for _ in range(round(1e9) // STEP_NS):
            flight.after_step(False)
            if (distance := flight.measured()) is not None:
                measured[-1].append(distance)
    assert len(measured[0]) in (20, 21)
    assert measured[0] == pytest.approx([flight.distance] * len(measured[0]), abs=0.06)
    assert np.std(measured[0]) > 0.003
    assert measured[1] == []


def test_images_come_at_30_hz_and_late_by_the_latency_less_what_the_nodes_take(camera):
    frames = Commanded(camera).fly(1.0).frames
    assert len(frames) in (29, 30)
    stamps = np.array([f.stamp_ns for f in frames])
    assert np.all(np.abs(np.diff(stamps) - 1e9 / 30) <= 1)
    delays = np.array([f.due_ns - f.stamp_ns for f in frames]) * 1e-9
    assert delays.min() >= 0.09 - 0.02 and delays.max() <= 0.11 - 0.02
    assert np.ptp(delays) > 0.01


def test_images_that_are_too_late_are_left_out(camera):
    flight = RealTimeFlight(scenario(sensing=STILL), 0, EmbeddedVehicle(0.0, 1.5), camera)
    for _ in range(20):
        flight.after_step(False)
    assert flight.look(1_000_000_000) is None
    assert flight.skipped_images == 6  # those of the first 0.2 s


def test_the_image_shows_the_marker_where_truth_camera_and_mounting_put_it(camera):
    motion = LeaderMotion(motion='circle', wait=0.0, speed=0.5, size=1.0)
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


def test_light_changes_blind_for_as_long_as_the_scenario_says():
    changing = ScenarioRun(scenario(sensing=Sensing(light_changes=30.0)), 3)
    assert len(changing.light_changes) > 3
    for begin, end, _ in changing.light_changes:
        assert 0.1 <= end - begin <= 0.4
        light = changing.light(0.5 * (begin + end))
        assert light.veil > 1.0 or light.gain < 0.01
    assert {glare for *_, glare in changing.light_changes} == {True, False}
    assert changing.light(0.5) != changing.light(2.5)  # clouds
    assert ScenarioRun(scenario(), 3).light(7.0) == Light()


def test_the_leader_leans_into_its_acceleration_and_its_twist_is_that_of_its_pose():
    motion = LeaderMotion(motion='circle', wait=0.0, speed=1.0, size=1.5, heading='course')
    live = ScenarioRun(scenario(leader=motion), 1)
    time, h = 9.0, 0.01
    before, after = live.leader(time - h), live.leader(time + h)
    state = live.leader_odometry(time)
    rotation = quaternion_to_matrix(state.quaternion)
    centripetal = live.leader(time + math.pi * 1.5 / 1.0).translation - state.position
    assert rotation[:, 2] @ centripetal > 0.05  # towards the middle of the circle
    assert rotation @ state.linear == pytest.approx(
        (after.translation - before.translation) / (2 * h), abs=1e-3)
    assert state.angular == pytest.approx(
        matrix_to_rotation_vector(before.rotation.T @ after.rotation) / (2 * h), abs=0.02)
    assert yaw_from_quaternion(state.quaternion) == pytest.approx(
        math.atan2(*(rotation @ state.linear)[1::-1]), abs=0.05)


def test_a_leader_that_faces_away_turns_its_tail_to_the_follower_and_not_faster_than_it_may():
    live = ScenarioRun(scenario(leader=LeaderMotion(heading='away')), 0)
    follower = np.array([1.5, -1.5, 1.5])  # from behind it has come to the leader's right
    headings = []
    for k in range(1500):
        live.turn(0.01 * k, follower)
        headings.append(live.leader_odometry(0.01 * k + 0.005))
    assert yaw_from_quaternion(headings[-1].quaternion) == pytest.approx(math.pi / 2, abs=0.01)
    assert max(abs(h.angular[2]) for h in headings) <= 1.0 + 1e-6
    fixed = ScenarioRun(scenario(), 0)
    fixed.turn(5.0, follower)
    assert yaw_from_quaternion(fixed.leader_odometry(9.0).quaternion) == pytest.approx(0.0)
