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

"""What really happened in a live flight, for its report: arrays in a .npz file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
import math
from typing import Any, Final

import numpy as np

from flock_desk.closed_loop.real_time_flight import RealTimeFlight, RenderedImage
from flock_desk.sensors.vio import Odometry
from flock_desk.vehicles.flight_log import FlightLog
from flock_desk.vehicles.mavlink_vehicle import STEP
from flock_follower.files import whole_file
from flock_follower.geometry import quaternion_to_matrix

_ODOM: Final = ('odom_stamp', 'odom_position', 'odom_quaternion', 'odom_velocity')
_IMAGE: Final = (
    'image_stamp', 'follower_position', 'follower_quaternion', 'follower_velocity',
    'leader_position', 'leader_quaternion', 'leader_velocity', 'image_usable')
_STATE: Final = ('planner_time', 'planner_state')
_DISTANCE: Final = ('distance_time', 'distance')
_PICTURE: Final = ('picture_stamp', 'picture')
PICTURE_PERIOD: Final[float] = 10.0  # s between images that are kept


class RealTimeLog:
    """
    Collects a flight; ``save`` writes it with the autopilot's log, see ``FlightLog``.

    Arrays added: ``odom_*`` as sent and ``image_stamp``, ``follower_*``, ``leader_*`` as true at
    each image, with stamps (n,) in ns of ROS time, positions and velocities (n, 3) in the odom
    frame, quaternions (n, 4); ``image_usable`` (n,), whether the leader can be seen and placed;
    ``picture`` (p, height, width), some of the images, and their ``picture_stamp`` (p,);
    ``distance`` (m,), m, at ``distance_time`` (m,) and ``planner_state`` (k,) from
    ``planner_time`` (k,) on, s on the monotonic clock; ``epoch_ns``, ROS time, and ``start``,
    monotonic s, of the start; ``began`` and ``ended``, monotonic s, of the scenario;
    ``skipped_images``; ``pose_source`` and ``pose_source_of_leader``, the messages that placed
    vehicles flown elsewhere, else '', and ``clock`` (c, 2), s, our time and the follower's;
    ``duration``, s, that was to be flown, and ``ended_early``, why it was not, else ''.
    """

    def __init__(self, autopilot: FlightLog, epoch_ns: int, start: float) -> None:
        self._autopilot, self._epoch_ns, self._start = autopilot, epoch_ns, start
        self._rows: dict[tuple[str, ...], list[tuple[Any, ...]]] = {
            columns: [] for columns in (_ODOM, _IMAGE, _STATE, _DISTANCE, _PICTURE)}
        self._next_picture = -math.inf

    def odometry(self, stamp_ns: int, state: Odometry) -> None:
        """Record odometry that was sent."""
        self._rows[_ODOM].append((stamp_ns, *_moving(state)))

    def image(self, stamp_ns: int, frame: RenderedImage) -> None:
        """Record the truth at an image, from the first image with a leader on."""
        if frame.leader is None:
            return
        self._rows[_IMAGE].append((
            stamp_ns, *_moving(frame.follower), *_moving(frame.leader), frame.usable))
        if frame.time >= 0.0 and stamp_ns >= self._next_picture:
            self._next_picture = stamp_ns + PICTURE_PERIOD * 1e9
            self._rows[_PICTURE].append((stamp_ns, frame.pixels))

    def distance(self, now: float, distance: float) -> None:
        """Record how far the vehicles are apart."""
        self._rows[_DISTANCE].append((now, distance))

    def planner(self, now: float, state: str) -> None:
        """Record a state of the planner."""
        self._rows[_STATE].append((now, state))

    def save(self, path: str, flight: RealTimeFlight, duration: float,
             sources: Mapping[str, str], clock: Sequence[tuple[float, float]] = (),
             early: tuple[float, str] | None = None) -> None:
        """
        Write the log to a .npz file, whole or not at all.

        :param duration: s of the scenario that were to be flown; what came after is left out.
        :param sources: the messages that placed the ``vehicle`` and the ``leader`` elsewhere.
        :param clock: our time and that of the vehicle's autopilot elsewhere, s.
        :param early: when the scenario ended before that, s, and why; None: it did not.
        :raises OSError: naming the file, if it cannot be written.
        """
        columns = self._autopilot.arrays()
        for names, rows in self._rows.items():
            for i, name in enumerate(names):
                columns[name] = np.array([row[i] for row in rows])
        began = np.nan if flight.began_ns is None else self._start + flight.began_ns * 1e-9
        ended = self._start + flight.time_ns * 1e-9
        flown, why = early or (duration, '')
        packed = BytesIO()
        np.savez_compressed(
            packed, **columns, epoch_ns=self._epoch_ns, start=self._start, began=began,
            ended=np.fmin(ended, began + flown) if flight.time > flown + STEP else ended,
            duration=duration, ended_early=why,
            skipped_images=flight.skipped_images, pose_source=sources.get('vehicle', ''),
            pose_source_of_leader=sources.get('leader', ''), clock=np.reshape(clock, (-1, 2)))
        with whole_file(path) as file:
            file.write(packed.getbuffer())


def _moving(state: Odometry) -> tuple[Any, ...]:
    """Return position, quaternion, and the velocity in the odom frame."""
    return (state.position, state.quaternion,
            quaternion_to_matrix(state.quaternion) @ state.linear)
