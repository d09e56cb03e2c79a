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

"""Changes that put something amiss in what a check observes."""

from __future__ import annotations

from collections.abc import Callable
import copy
import math
from typing import Any

import numpy as np
from observed import Observed, shift_rows, sighting_rows

from flock_follower.checks.observations import TopicEnd
from flock_follower.geometry import (
    quaternion_from_rpy,
    quaternion_multiply,
    quaternion_to_matrix,
    Transform,
)
from flock_follower.messages.topic_names import TYPES
from flock_follower.odometry.static_frames import StaticFrames

CAMERA = '/camera/camera/infra1/image_rect_raw'
CAMERA_INFO = '/camera/camera/infra1/camera_info'
Change = Callable[[Observed], Any]


def change(of: Callable[[Observed], Any] = lambda seen: seen, **fields: Any) -> Change:
    """Return a change of fields of the observations, or of a part ``of`` them."""
    return lambda seen: vars(of(seen)).update(copy.deepcopy(fields))


def machine(**fields: Any) -> Change:
    return change(lambda seen: seen.machine, **fields)


def pictures(**fields: Any) -> Change:
    return lambda seen: [vars(picture).update(fields) for picture in seen.pictures]


def columns(which: slice, values: list[float]) -> Change:
    return lambda seen: [row.__setitem__(which, values) for row in seen.rows]


def bridge(key: str, value: str) -> Change:
    return lambda seen: seen.statuses['mavlink_bridge'].values.update({key: value})


def parameter(node: str, name: str, value: Any) -> Change:
    return lambda seen: seen.parameters[node].update({name: value})


def publisher(name: str, node: str) -> Change:
    return lambda seen: seen.topic(name).publishers.append(TopicEnd(node, TYPES[name]))


def set_clock(name: str, share: float, step: float) -> Change:
    """Return a change of the stamps after a share of the messages, by a step, s."""
    def make(seen: Observed) -> None:
        topic = seen.topic(name)
        first = round(share * len(topic.stamps))
        topic.stamps = [stamp + step * (number >= max(first, 1))
                        for number, stamp in enumerate(topic.stamps)]
    return make


def kept(name: str, which: slice) -> Change:
    """Return a change that leaves some of the messages."""
    def make(seen: Observed) -> None:
        topic = seen.topic(name)
        topic.arrivals, topic.stamps = topic.arrivals[which], topic.stamps[which]
        if name == 'odom':
            seen.rows = seen.rows[which]
    return make


def together(*changes: Change) -> Change:
    return lambda seen: [make(seen) for make in changes]


def moved(name: str, to: str) -> Change:
    """Return a change that publishes one of our topics under another name."""
    return lambda seen: seen.topics.update({to: seen.topics.pop(seen.names[name])})


def static_frames(rpy: tuple[float, float, float]) -> StaticFrames:
    """Return the frames of a vehicle whose IMU is turned so on base_link."""
    frames = StaticFrames()
    frames.add('base_link', 'imu', Transform.from_quaternion(
        np.zeros(3), quaternion_from_rpy(*rpy)))
    return frames


def child_axes(*rpy: float) -> Change:
    """Return a change of the odometry to that of a child frame turned so on base_link."""
    q = quaternion_from_rpy(*rpy)

    def make(seen: Observed) -> None:
        for row in seen.rows:
            row[5:9] = quaternion_multiply(row[5:9], q).tolist()
            row[9:15] = (np.reshape(row[9:15], (2, 3)) @ quaternion_to_matrix(q)).ravel().tolist()
    return make


def delayed(name: str, seconds: float) -> Change:
    return lambda seen: vars(seen.topic(name)).update(
        arrivals=[arrival + seconds for arrival in seen.topic(name).arrivals])


def stamped(name: str, seconds: float) -> Change:
    return lambda seen: vars(seen.topic(name)).update(
        stamps=[stamp + seconds for stamp in seen.topic(name).stamps])


def unstamped(each: int) -> Change:
    """Return a change of the stamp of each third, fourth, ... image to 0."""
    return lambda seen: vars(seen.topic('image_raw')).update(stamps=[
        0.0 if n % each == 0 else stamp
        for n, stamp in enumerate(seen.topic('image_raw').stamps)])


def stamped_as(index: Callable[[int], int]) -> Change:
    """Return a change of the stamps of images to those of other images, by their numbers."""
    def make(seen: Observed) -> None:
        stamps = seen.topic('image_raw').stamps
        seen.topic('image_raw').stamps = [stamps[index(n)] for n in range(len(stamps))]
    return make


def mounted(*degrees: float) -> Change:
    """Return a change of the camera's roll, pitch, yaw on the body, deg."""
    R = quaternion_to_matrix(quaternion_from_rpy(*map(math.radians, degrees)))
    return change(sightings=sighting_rows(mounted=R), shifts=shift_rows(mounted=R))


def moving(ratio: float) -> Change:
    """Return a change of the shifts of the images by a ratio."""
    return lambda seen: vars(seen).update(shifts=[
        [*row[:2], *(np.reshape(row[2:], (-1, 3)) * [ratio, ratio, 1.0]).ravel()]
        for row in seen.shifts])


def positions(columns: list[int], signs: list[float], twist_in_odom: bool) -> Change:
    """Return a change of the axes of the positions, with a twist in the child frame or in odom."""
    def make(seen: Observed) -> None:
        for row in seen.rows:
            row[2:5] = [sign * row[2 + k] for k, sign in zip(columns, signs)]
            if twist_in_odom:
                row[9:12] = (quaternion_to_matrix(row[5:9]) @ row[9:12]).tolist()
    return make


def level_flight(height: float) -> Change:
    """Return a change to a vehicle that stays at a height, m, and sees no marker."""
    def make(seen: Observed) -> None:
        seen.sightings = []
        for row in seen.rows:
            up = quaternion_to_matrix(row[5:9])
            row[4], row[9:12] = height, (up.T @ ((up @ row[9:12]) * [1.0, 1.0, 0.0])).tolist()
    return make


def at_rest(seen: Observed) -> None:
    """Have the vehicle stand still."""
    seen.rows = [row[:2] + seen.rows[0][2:9] + [0.0] * 3 + [1e-3] * 3 + row[15:]
                 for row in seen.rows]
    seen.shifts = [[*row[:2], *[0.1, -0.1, 0.9] * 6] for row in seen.shifts]


NO_CALIBRATION = together(moved('camera_info', CAMERA_INFO), change(calibration=None))
OTHER_ODOMETRY = together(moved('odom', '/ov_msckf/odomimu'), change(rows=[]))
