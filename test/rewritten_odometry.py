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


"""The odometry of a bag, rewritten as other sources would have sent it (docs/sensors.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import itertools
from pathlib import Path
from typing import Any, NamedTuple

from bag_excerpts import edited, excerpt
import numpy as np

from flock_follower.bags.bag import BagMessage
from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    quaternion_from_rpy,
    quaternion_multiply,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from flock_follower.messages import (
    set_quaternion,
    set_stamp,
    set_vector,
    stamp_to_nanoseconds,
    to_array,
)

#: An IMU behind and beside the center, its axes those of a camera: x right, y down, z ahead.
IMU_POSITION = (0.06, -0.02, 0.03)
IMU_RPY = (-np.pi / 2.0, 0.0, -np.pi / 2.0)


class Source(NamedTuple):
    """
    How a source differs from REP-105.

    ``imu``: its child frame is the IMU above. ``twist`` is 'child', 'odom' or 'none'. It sends no
    ``rates`` or ``covariances`` where these are false, and every ``keep``-th message, ``late`` s
    late; ``gyro_lag`` s is the age of its rates, ``attitude_noise``, rad, white.
    """

    imu: bool = False
    twist: str = 'child'
    rates: bool = True
    covariances: bool = True
    keep: int = 1
    late: float = 0.0
    gyro_lag: float = 0.0
    attitude_noise: float = 0.0

    @property
    def parameters(self) -> dict[str, Any]:
        """Return what a user sets for it: the pose of the child frame, and no more."""
        return ({'odom_child_position': list(IMU_POSITION), 'odom_child_rpy': list(IMU_RPY)}
                if self.imu else {})


def rewrite(source: Source, seed: int = 0) -> Callable[[Any, float], Any]:
    """Return what alters messages one after another: given a message and its time, s."""
    rng = np.random.default_rng(seed)
    q_base_imu = quaternion_from_rpy(*IMU_RPY)
    R_base_imu, lever = quaternion_to_matrix(q_base_imu), np.array(IMU_POSITION)
    past: list[tuple[float, Array]] = []

    def altered(message: Any, time: float) -> Any:
        pose, twist = message.pose.pose, message.twist.twist
        q = pose.orientation
        attitude = np.array([q.x, q.y, q.z, q.w])
        linear, rates = to_array(twist.linear), to_array(twist.angular)
        past.append((time, rates))
        rates = next(r for t, r in reversed(past) if t <= time - source.gyro_lag + 1e-6 or (
            t == past[0][0]))
        rotation = quaternion_to_matrix(attitude)
        if source.attitude_noise:
            attitude = quaternion_multiply(attitude, rotation_vector_to_quaternion(
                source.attitude_noise * rng.standard_normal(3)))
        if source.imu:
            set_vector(pose.position, to_array(pose.position) + rotation @ lever)
            attitude = quaternion_multiply(attitude, q_base_imu)
            linear = R_base_imu.T @ (linear + np.cross(rates, lever))
            rates = R_base_imu.T @ rates
            rotation = rotation @ R_base_imu
            message.child_frame_id = 'imu'
        set_quaternion(pose.orientation, canonical_quaternion(attitude))
        if source.twist == 'odom':
            linear = rotation @ linear
        set_vector(twist.linear, linear if source.twist != 'none' else np.zeros(3))
        set_vector(twist.angular, rates if source.rates else np.zeros(3))
        if not source.covariances:
            message.pose.covariance = np.zeros(36)
            message.twist.covariance = np.zeros(36)
        return message

    return altered


def rewritten_bag(result: Path, source: Source, image_offset: float = 0.0,
                  image_jitter: float = 0.0, seconds: float = 60.0) -> Path:
    """
    Write the sample with the odometry of a source, and its images' stamps off by so many s.

    Of its 12 s no more than so many seconds are written.
    """
    rng, alter, count = np.random.default_rng(1), rewrite(source), itertools.count(1)

    def odom(fields: Any) -> None:
        alter(fields, stamp_to_nanoseconds(fields.header.stamp) * 1e-9)

    def late(fields: Any) -> None:
        off = image_offset + image_jitter * rng.standard_normal()
        set_stamp(fields.header.stamp,
                  stamp_to_nanoseconds(fields.header.stamp) + round(off * 1e9))

    def change(message: BagMessage) -> BagMessage | None:
        if message.topic == '/odom':
            altered = edited(message, odom)
            return None if next(count) % source.keep else altered._replace(
                stamp_ns=message.stamp_ns + round(source.late * 1e9))
        moved = message.topic.startswith('/image') and (image_offset or image_jitter)
        return edited(message, late) if moved else message
    return excerpt(result, seconds, change)


def sources() -> Iterator[tuple[str, Source]]:
    """Yield the sources of docs/sensors.md, by name; the sample bag has odometry at 200 Hz."""
    yield 'as recorded', Source()
    yield 'IMU axes', Source(imu=True)
    yield 'IMU axes, twist in odom, no rates, no covariances', Source(
        imu=True, twist='odom', rates=False, covariances=False)
    yield 'twist in odom, no rates', Source(twist='odom', rates=False)
    yield 'no twist', Source(twist='none', rates=False)
    yield 'no rates', Source(rates=False)
    yield '30 Hz, 60 ms late', Source(keep=7, late=0.06)
    yield '30 Hz, 100 ms late', Source(keep=7, late=0.1)
    yield '10 Hz', Source(keep=20)
    yield '10 Hz, 60 ms late', Source(keep=20, late=0.06)
