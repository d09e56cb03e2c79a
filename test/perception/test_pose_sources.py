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

"""Poses by other detectors: the same filter, and every bad input refused by its reason."""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import Any

import numpy as np
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.geometry import Array, quaternion_from_rpy, quaternion_from_yaw, Transform
from flock_follower.messages import to_nanoseconds
from flock_follower.messages.poses import from_pose, pose_with_covariance, PoseState
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import odometry
from flock_follower.parameters.neighbors_file import NeighborConfig, parse, PoseSource
from flock_follower.perception import pose_sources
from flock_follower.perception.pending_images import Perceiver
from flock_follower.perception.pose_sources import Sourced
from flock_follower.perception.time_offset import MountedCamera
from flock_follower.perception.tracker import camera_mounting, Tracker

MOUNTING = camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
START = 1_700_000_000.0  # s
COVARIANCE = np.diag([0.02**2] * 3 + [0.05**2] * 3)


def config(**source: Any) -> NeighborConfig:
    return parse({'neighbors': [{'name': 'leader', 'pose_topic': '/poses', **source}]})


def own_pose(t: float) -> Transform:
    return Transform.from_quaternion([0.3 * t, 0.0, 1.0], quaternion_from_rpy(
        0.05 * math.sin(2.0 * t), 0.05 * math.cos(2.0 * t), 0.5 + 0.2 * math.sin(t)))


def leader_pose(t: float) -> Transform:
    return Transform.from_quaternion([1.6 + 0.3 * t, 1.0 + 0.1 * t, 1.2], quaternion_from_yaw(0.4))


def seconds(perceiver: Perceiver, first: float, last: float, rate: float = 100.0) -> None:
    """Let a perceiver take odometry of a time, s from START."""
    for t in np.arange(first, last, 1.0 / rate).tolist():
        own, h = own_pose(t), 1e-4
        velocity = (own_pose(t + h).translation - own.translation) / h
        perceiver.take_odometry(from_odometry(odometry(
            empty, to_nanoseconds(START + t), 'odom', 'base_link', own.translation,
            own.quaternion, own.rotation.T @ velocity)))


def pose(t: float, frame: str = 'camera', covariance: Array = COVARIANCE,
         error: Any = 0.0) -> PoseState:
    T_odom_frame = {'odom': Transform(), 'base_link': own_pose(t),
                    'camera': own_pose(t) @ MOUNTING}[frame]
    measured = T_odom_frame.inverse() @ leader_pose(t)
    measured = Transform(measured.rotation, measured.translation + error)
    return from_pose(pose_with_covariance(
        empty, to_nanoseconds(START + t), frame, measured, covariance))


def started(neighbors: NeighborConfig | None = None) -> Perceiver:
    perceiver = Perceiver(Tracker(neighbors or config(), MOUNTING), max_wait=0.35)
    perceiver.sources.frames['camera'] = MOUNTING
    return perceiver


def fly(perceiver: Perceiver, frame: str = 'camera', rate: float = 10.0, duration: float = 3.0,
        outliers: float = 0.0, missing: float = 0.0) -> Iterator[tuple[float, Any]]:
    """Yield stamps, s, and the messages of estimates, of a flight with noisy poses."""
    noise, turn = np.random.default_rng(3), 0.0
    for k in range(round(duration * rate)):
        t = k / rate
        seconds(perceiver, turn, t + 0.015)
        turn = t + 0.015
        error = noise.normal(0.0, 0.02, 3) + (
            noise.normal(0.0, 1.0, 3) if noise.random() < outliers else 0.0)
        if noise.random() < missing:
            continue
        assert perceiver.take_pose('leader', pose(t, frame, error=error), t) is None
        for outcome in perceiver.sources.due(t):
            if isinstance(outcome, Sourced):
                for name, estimate in outcome.sighting.estimates.items():
                    yield t, from_odometry(perceiver.messages(
                        empty, outcome.stamp, name, estimate)[0])


@pytest.mark.parametrize('frame', ['camera', 'base_link', 'odom'])
def test_pose_in_each_frame_gives_the_state_in_odom(frame: str) -> None:
    errors, velocities, squares = [], [], []
    for t, state in fly(started(), frame, duration=6.0):
        if t > 2.0:
            off = state.position - leader_pose(t).translation
            errors.append(off)
            squares.append(off @ np.linalg.solve(state.pose_covariance[:3, :3], off))
            velocities.append(state.velocity - [0.3, 0.1, 0.0])
    assert len(errors) == 39
    assert np.sqrt(np.mean(np.square(errors))) < 0.02
    assert np.sqrt(np.mean(np.square(velocities))) < 0.08
    assert 1.0 < np.mean(squares) < 5.0


def test_outliers_and_gaps_leave_the_track_near_the_neighbor() -> None:
    far = [math.dist(state.position, leader_pose(t).translation)
           for t, state in fly(started(), duration=20.0, outliers=0.05, missing=0.2)]
    assert len(far) > 140 and max(far) < 0.3


def test_position_only_has_certain_velocity_unknown_attitude() -> None:
    perceiver = started(config(position_only=True))
    *_, (t, state) = fly(perceiver, duration=4.0)
    assert np.linalg.norm(state.position - leader_pose(t).translation) < 0.05
    assert np.linalg.norm(state.velocity - [0.3, 0.1, 0.0]) < 0.15
    assert float(state.velocity_covariance.trace()) < 0.1
    assert state.pose_covariance[5, 5] >= math.pi**2


@pytest.mark.parametrize(('changes', 'reason'), [
    ({'frame': 'map'}, pose_sources.UNKNOWN_FRAME),
    ({'stamp': to_nanoseconds(START + 100.0)}, pose_sources.UNTIMELY),
    ({'stamp': 5}, pose_sources.UNTIMELY),
    ({'position': np.array([math.nan, 0.0, 1.0])}, pose_sources.INVALID),
    ({'position': np.array([0.0, 0.0, 1e3])}, pose_sources.INVALID),
    # What a detector sends that found nothing.
    ({'position': np.zeros(3), 'quaternion': np.array([0.0, 0.0, 0.0, 1.0])},
     pose_sources.INVALID),
    ({'quaternion': np.array([0.0, 0.0, 0.0, math.nan])}, pose_sources.INVALID),
    ({'quaternion': np.zeros(4)}, pose_sources.NO_ATTITUDE),
    ({'covariance': np.zeros((6, 6))}, pose_sources.NO_COVARIANCE),
    ({'covariance': None}, pose_sources.NO_COVARIANCE),
    ({'covariance': -COVARIANCE}, pose_sources.INVALID_COVARIANCE),
    ({'covariance': math.nan * COVARIANCE}, pose_sources.INVALID_COVARIANCE)])
def test_a_bad_pose_is_refused_by_its_reason(changes: dict[str, Any], reason: str) -> None:
    perceiver = started()
    seconds(perceiver, 0.0, 1.0)
    refused = perceiver.take_pose('leader', pose(0.5)._replace(**changes), 0.0)
    assert refused is not None and refused[0] == reason
    assert not [*perceiver.sources.due(0.0)]


@pytest.mark.parametrize('place', [own_pose(0.5).translation, [101.5, 0.0, 1.0]])
@pytest.mark.parametrize('only', [False, True])
def test_pose_in_odom_at_own_place_or_too_far_is_refused(place: Any, only: bool) -> None:
    perceiver = started(config(position_only=only))
    seconds(perceiver, 0.0, 1.0)
    wrong = pose(0.5, 'odom')._replace(position=np.array(place))
    assert perceiver.take_pose('leader', wrong, 0.0) is None  # own place: not known before
    assert [each[0] for each in perceiver.sources.due(0.0) if not isinstance(each, int)] == [
        pose_sources.INVALID]


def test_pose_that_finds_no_room_to_wait_is_counted() -> None:
    perceiver = started()
    seconds(perceiver, 0.0, 1.0)
    refused = [perceiver.take_pose('leader', pose(1.0 + 0.002 * k), 0.0)
               for k in range(pose_sources.MOST_WAITING + 2)]
    assert [each[0] for each in refused if each is not None] == 2 * [pose_sources.CROWDED]


def test_repeated_stamp_and_pose_without_odometry_are_refused() -> None:
    perceiver = started()
    assert perceiver.take_pose('leader', pose(0.5), 0.0) == (pose_sources.UNPLACED, 'leader')
    seconds(perceiver, 0.0, 1.0)
    assert perceiver.take_pose('leader', pose(0.5), 0.0) is None
    refused = perceiver.take_pose('leader', pose(0.5), 0.0)
    assert refused is not None and refused[0] == pose_sources.UNTIMELY


def test_deviations_of_the_file_replace_a_missing_covariance() -> None:
    perceiver = started(config(position_std=0.05, attitude_std=0.1))
    seconds(perceiver, 0.0, 1.0)
    assert perceiver.take_pose('leader', pose(0.5)._replace(covariance=None), 0.0) is None
    outcome, frame = perceiver.sources.due(0.0)
    assert isinstance(outcome, Sourced) and 'leader' in outcome.sighting.estimates
    assert frame == outcome.stamp  # without frames_topic each pose shows that its image came


def test_frames_follow_the_poses_of_their_images() -> None:
    neighbors = parse({'frames_topic': '/info', 'neighbors': [
        {'name': 'leader', 'pose_topic': '/poses'}]})
    perceiver, stamps = started(neighbors), [to_nanoseconds(START + k / 10) for k in range(5)]
    seconds(perceiver, 0.0, 1.0)

    def due(now: float) -> list[int]:
        return [each for each in perceiver.sources.due(now) if isinstance(each, int)]

    for k in range(2):
        perceiver.take_frame(stamps[k], k / 10)
        assert due(k / 10) == []
    perceiver.take_pose('leader', pose(0.0), 0.15)
    assert due(0.15) == stamps[:1]
    assert due(0.27) == [] and due(0.29) == stamps[1:2]  # 0.1 s, and 0.15 s + LATE_MARGIN
    perceiver.take_frame(stamps[2], 0.5)
    assert due(0.67) == [] and due(0.69) == stamps[2:3]


def test_frame_after_its_pose_teaches_later_ones_not_to_wait() -> None:
    neighbors = parse({'frames_topic': '/info', 'neighbors': [
        {'name': 'leader', 'pose_topic': '/poses'}]})
    perceiver = started(neighbors)
    seconds(perceiver, 0.0, 1.0)
    for t in (0.0, 0.1):
        perceiver.take_pose('leader', pose(t), t + 0.2)
        assert [each for each in perceiver.sources.due(t + 0.2) if isinstance(each, int)] == []
        perceiver.take_frame(to_nanoseconds(START + t), t + 0.2)
        assert [*perceiver.sources.due(t + 0.2)] == [to_nanoseconds(START + t)]
    perceiver.take_frame(to_nanoseconds(START + 0.2), 0.4)  # its pose is missing
    assert [*perceiver.sources.due(0.42)] == []
    assert [*perceiver.sources.due(0.44)] == [to_nanoseconds(START + 0.2)]
    # The detector is slower from now on: one frame is passed on too early, the next one waits.
    for t, too_early in ((0.3, True), (0.4, False)):
        perceiver.take_frame(to_nanoseconds(START + t), t)
        assert bool([*perceiver.sources.due(t + 0.04)]) == too_early
        perceiver.take_pose('leader', pose(t), t + 0.1)
        assert [each for each in perceiver.sources.due(t + 0.1) if isinstance(each, int)] == (
            [] if too_early else [to_nanoseconds(START + t)])


@pytest.mark.parametrize(('entry', 'message'), [
    ({'tf_frame': 'x'}, 'neighbors[0] lacks position_std'),
    ({'tf_frame': 'x', 'position_std': 0.1}, 'neighbors[0] lacks attitude_std'),
    ({'pose_topic': 'a b'}, 'neighbors[0].pose_topic'),
    *(({'pose_topic': name}, 'neighbors[0].pose_topic') for name in ('', '/a//b', 'a-b', '/1')),
    *(({'tf_frame': name, 'position_std': 0.1, 'attitude_std': 0.1}, 'neighbors[0].tf_frame')
      for name in ('', '/', 5)),
    ({'pose_topic': '/x', 'marker_id': 1}, 'neighbors[0] has an unknown key marker_id'),
    ({'pose_topic': '/x', 'position_std': 0.0}, 'neighbors[0].position_std'),
    ({'pose_topic': '/x', 'position_only': 1}, 'neighbors[0].position_only')])
def test_a_wrong_source_is_refused(entry: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse({'neighbors': [{'name': 'leader', **entry}]})
    assert message in str(caught.value)


@pytest.mark.parametrize('key', ['pose_topic', 'tf_frame'])
def test_one_source_is_of_one_neighbor(key: str) -> None:
    leader, other = ({'name': name, key: 'x', 'position_std': 0.1, 'attitude_std': 0.1}
                     for name in ('leader', 'other'))
    with pytest.raises(ValueError, match=rf"neighbors\[1\]\.{key} = 'x': must be unique"):
        parse({'neighbors': [leader, other]})


def test_topic_of_the_poses_is_not_that_of_the_frames() -> None:
    with pytest.raises(ValueError, match=r'neighbors\[0\]\.pose_topic = .*frames_topic'):
        parse({'frames_topic': 'x', 'neighbors': [{'name': 'leader', 'pose_topic': 'x'}]})


@pytest.mark.parametrize(('frames', 'known'), [
    (('left', '/right'), True), (('right', 'right'), False), (('left', 'base_link'), False),
    (('odom', 'right'), False)])
def test_frame_with_two_meanings_is_not_guessed(frames: tuple[str, str], known: bool) -> None:
    """A detector copies the frame of its images: two cameras may share one, or name the body's."""
    turned = Transform(MOUNTING.rotation @ np.diag([-1.0, 1.0, -1.0]), MOUNTING.translation)
    perceiver = Perceiver(Tracker(config(), {
        'left': MountedCamera(turned), 'right': MountedCamera(MOUNTING)}), max_wait=0.35)
    for name, frame in zip(('left', 'right'), frames):
        calibration = empty('sensor_msgs/msg/CameraInfo')
        calibration.header.frame_id = frame
        with pytest.raises(ValueError, match='not calibrated'):
            perceiver.take_camera_info(calibration, name)
    seconds(perceiver, 0.0, 1.0)
    named = frames[0] if frames[0] == 'odom' else frames[1]
    refused = perceiver.take_pose('leader', pose(0.5)._replace(frame=named), 0.0)
    assert (refused is None) == known
    assert known or (refused and refused[0] == pose_sources.UNKNOWN_FRAME)


def test_without_odometry_the_frame_of_the_camera_is_that_of_all() -> None:
    perceiver = Perceiver(Tracker(config(), MOUNTING, alone=True), max_wait=0.35)
    perceiver.sources.frames['camera'] = Transform()
    for k in range(101):
        perceiver.take_odometry(from_odometry(odometry(
            empty, pose(k * 0.01).stamp, 'camera', 'camera', np.zeros(3),
            np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))))
    assert perceiver.take_pose('leader', pose(0.5), 0.0) is None


def test_poses_of_the_body_need_no_frame_of_odometry() -> None:
    perceiver = started()
    for k in range(101):
        nameless = pose(k * 0.01, 'odom')
        perceiver.take_odometry(from_odometry(odometry(
            empty, nameless.stamp, '', '', own_pose(k * 0.01).translation,
            own_pose(k * 0.01).quaternion, np.zeros(3))))
    assert perceiver.take_pose('leader', pose(0.5), 0.0) is None
    refused = perceiver.take_pose('leader', pose(0.6)._replace(frame=''), 0.0)
    assert refused is not None and refused[0] == pose_sources.UNKNOWN_FRAME


def test_source_needs_no_dictionary_marker_beside_it_does() -> None:
    tf = {'name': 'a', 'tf_frame': 'x', 'position_std': 0.1, 'position_only': True}
    assert parse({'neighbors': [tf]}).neighbors[0].source == PoseSource(
        tf_frame='x', position_std=0.1, position_only=True)
    marker = {'name': 'b', 'marker_id': 0, 'side_length': 0.2, 'position': [0, 0, 0],
              'rpy': [0, 0, 0]}
    with pytest.raises(ValueError, match='lacks dictionary'):
        parse({'neighbors': [tf, marker]})
    both = {'dictionary': 'DICT_4X4_50', 'neighbors': [tf, marker]}
    assert len(parse(both).neighbors) == 2
    with pytest.raises(ValueError, match='frames_topic'):
        parse({**both, 'frames_topic': '/info'})
