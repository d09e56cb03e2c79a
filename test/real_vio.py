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

"""
Real odometry, and tags on walls seen meanwhile: recordings that are not in this repository.

``truth.yaml`` beside them tells what they hold. base_link is put into the camera: x along its line
of sight, z up in the image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag1 import Reader
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
import yaml

from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array, skew, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.messages import NANOSECONDS, OdometryState, stamp_to_nanoseconds
from flock_follower.odometry.buffer import Missing, OdometryBuffer, OdometrySample
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.look import CameraMotion
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.neighbor_filter import FilterParams, NeighborFilter, UpdateOutcome
from flock_follower.perception.square_pose import ippe, refine
from flock_follower.perception.time_offset import TimeOffset
from flock_follower.perception.tracker import camera_mounting

FOLDER = Path(__file__).resolve().parents[2] / 'shared' / 'data' / 'real'
T_BASE_CAMERA = camera_mounting([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
#: Deviation of a corner's coordinate, px, as a plain detector finds it.
CORNER = 0.5
#: A tag counts from so long, s, after its filter began on it,
SETTLED = 1.0
#: and again after the odometry corrected itself by more, m: what is at rest jumps alike.
CORRECTED = 0.1

Read = Callable[[Any, int], OdometryState | None]


class Tag(NamedTuple):
    """A tag in an image of a stamp, ns: its number, and corners (4, 2), px."""

    stamp: int
    number: int
    corners: Array


class Recording:
    """
    One of them: odometry as (arrival, ns, message), tags, and what truth.yaml tells.

    ``T_base_camera`` (optical) and ``T_base_child``, of the odometry, are where things are.
    """

    def __init__(self, name: str) -> None:
        truth = yaml.safe_load((FOLDER / 'truth.yaml').read_text(encoding='utf-8'))[name]
        self.truth: dict[str, Any] = truth
        with open_bag(FOLDER / name) as bag:
            self.odometry: list[tuple[int, Any]] = [
                (m.stamp_ns, deserialize(m.data, m.msgtype))
                for m in bag.messages([truth['odom']['topic']])]
        self.tags = list(_tags(FOLDER / name, truth['tags']['topic']))
        self.camera = _camera(FOLDER / truth['tags']['camera'].split()[0])
        child = truth['odom']['child_in_camera']
        self.T_base_camera = T_BASE_CAMERA
        self.T_base_child = T_BASE_CAMERA @ Transform(
            rotation_vector_to_matrix(child['rotation_vector']), np.array(child['position']))

    def side_length(self, number: int) -> float | None:
        """Return that of a tag, m; None where it is not known."""
        lengths = self.truth['tags']['side_length_m']
        return lengths.get(number) if isinstance(lengths, dict) else lengths


def _tags(path: Path, topic: str) -> Iterator[Tag]:
    """Yield the tags of a bag; the definition of their message is in there."""
    types = get_typestore(Stores.ROS1_NOETIC)
    with Reader(path) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection in connections:
            types.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, _, data in reader.messages(connections=connections):
            message: Any = types.deserialize_ros1(data, connection.msgtype)
            for tag in message.apriltags:
                yield Tag(stamp_to_nanoseconds(message.header.stamp), tag.id,
                          np.array([[c.x, c.y] for c in tag.corners])[::-1])


def _camera(path: Path) -> CameraModel:
    """Return the first camera of a file of Kalibr's."""
    said = yaml.safe_load(path.read_text(encoding='utf-8'))['cam0']
    fx, fy, cx, cy = said['intrinsics']
    width, height = said['resolution']
    return CameraModel(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
                       np.array(said['distortion_coeffs']), said['distortion_model'],
                       width, height)


class Seen(NamedTuple):
    """A tag as a filter has it at a time, s: position (3,), m, and velocity (3,), m/s, in odom."""

    time: float
    number: int
    visit: int
    position: Array
    velocity: Array


def seen_tags(recording: Recording, read: Read,
              T_base_camera: Transform = T_BASE_CAMERA,
              time_offset: TimeOffset | None = None, shift: float = 0.0) -> list[Seen]:
    """
    Return the tags as filters have them, with one's own odometry as ``read`` makes it.

    :param time_offset: to be estimated; :param shift: what is added to the images' stamps, s.
    """
    offset = time_offset or TimeOffset(fixed=True)
    buffer = OdometryBuffer()
    buffer.MAX_GAP = 0.6
    params = FilterParams()
    filters: dict[int, NeighborFilter] = {}
    began: dict[int, float] = {}
    visits: dict[int, int] = {}
    epoch = recording.tags[0].stamp - NANOSECONDS
    messages = iter(recording.odometry)
    found: list[Seen] = []
    last: OdometryState | None = None
    for tag in sorted(recording.tags, key=lambda t: t.stamp):
        time = (tag.stamp - epoch) / NANOSECONDS + shift
        while buffer.newest is None or buffer.newest < time + offset.applied:
            arrival, message = next(messages, (0, None))
            if message is None:
                return found
            state = read(message, arrival)
            if state is not None:
                if last is not None and _corrected(last, state):
                    began = dict.fromkeys(began, time)
                    visits = {number: visit + 1 for number, visit in visits.items()}
                last = state
                buffer.add(OdometrySample(
                    (state.stamp - epoch) / NANOSECONDS, state.position, state.quaternion,
                    state.velocity, state.angular_velocity))
        own, side_length = buffer.at(time + offset.applied), recording.side_length(tag.number)
        if isinstance(own, Missing) or side_length is None:
            continue
        T_odom_camera = own.smooth_pose @ T_base_camera
        track = filters.setdefault(tag.number, NeighborFilter(params))
        expected = track.predict(time)
        fitted = fitted_corners(recording.camera, side_length, tag.corners,
                                expected and (T_odom_camera.inverse() @ expected.pose).rotation)
        if fitted is None:
            continue
        pose, jacobian = fitted
        T_odom_tag = T_odom_camera @ pose
        covariance = np.linalg.inv(jacobian.T @ jacobian) * CORNER**2
        turn = np.kron(np.eye(2), T_odom_camera.rotation)
        # As in Tracker: an error of one's own attitude moves and tilts what is seen.
        leverage = np.concatenate([-skew(T_odom_tag.translation - own.travel), np.eye(3)])
        covariance = turn @ covariance @ turn.T + params.attitude_noise**2 * leverage @ leverage.T
        outcome = track.update(time, T_odom_tag, np.zeros(3), covariance)
        if outcome is UpdateOutcome.STARTED:
            began[tag.number], visits[tag.number] = time, visits.get(tag.number, 0) + 1
        if change := offset.take(str(tag.number), time, pose.translation, T_base_camera,
                                 buffer):
            view = CameraMotion.of(own, T_base_camera)
            for other in filters.values():
                if other.newest is not None:
                    other.add_error(change * view.moving(other.newest.position - own.travel))
        estimate = track.predict(time)
        if estimate is not None and time - began[tag.number] >= SETTLED:
            found.append(Seen(time, tag.number, visits[tag.number],
                              estimate.position + own.correction, estimate.velocity))
    return found


def _corrected(last: OdometryState, state: OdometryState) -> bool:
    dt = (state.stamp - last.stamp) / NANOSECONDS
    step = state.position - last.position - 0.5 * dt * (last.velocity + state.velocity)
    return float(np.linalg.norm(step)) > CORRECTED


def fitted_corners(camera: CameraModel, side_length: float, corners: Array,
                   expected: Array | None) -> tuple[Transform, Array] | None:
    """
    Return the pose that four corners show, and its Jacobian.

    Of two alike, it is the nearer to an attitude (3, 3).
    """
    points = marker_corners(side_length)
    fits = [fitted for pose in ippe(corners, camera, side_length)
            if (fitted := refine(corners, camera, points, np.zeros(3), pose)) is not None]
    if expected is None:
        return min(fits, key=lambda f: float(np.sum(
            (camera.project(f[0].apply(points)) - corners)**2)), default=None)
    return max(fits, key=lambda f: float(np.sum(f[0].rotation * expected)), default=None)


def velocity_rms(seen: list[Seen]) -> float:
    """Return the RMS of the speed, m/s."""
    return float(np.sqrt(np.mean([s.velocity @ s.velocity for s in seen])))


def scatter(seen: list[Seen]) -> float:
    """
    Return how far, m, a tag is from the middle of its visit: nine of ten times it is nearer.

    A visit is without a break; where odometry corrects itself meanwhile, the tag moves with it.
    """
    visits: dict[tuple[int, int], list[Array]] = {}
    for s in seen:
        visits.setdefault((s.number, s.visit), []).append(s.position)
    off = np.concatenate([np.array(p) - np.median(p, axis=0) for p in visits.values()])
    return float(np.percentile(np.linalg.norm(off, axis=1), 90.0))
