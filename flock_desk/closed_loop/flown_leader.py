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
The leader of a real-time flight: on the scenario's course, or flown by an external autopilot.

Times are integer nanoseconds since the flight's start, and s of the scenario (``scenario_run``).
"""

from __future__ import annotations

import numpy as np

from flock_desk.closed_loop.scenario_run import ScenarioRun
from flock_desk.external.external_motion import ExternalMotion, LONGEST_GAP
from flock_desk.sensors.vio import Odometry
from flock_follower.geometry import (
    Array,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
    Transform,
    yaw_from_quaternion,
)


class ScenarioLeader:
    """
    A leader on the scenario's course; pose and motion are None before it appears.

    :param in_place: whether the follower starts at the scenario's place; else the scenario is
        moved to its place, height and heading once it is in offboard mode.
    """

    def __init__(self, scenario: ScenarioRun, in_place: bool) -> None:
        self._scenario, self._in_place = scenario, in_place
        #: The scenario's frame in the vehicle's.
        self._frame: Transform | None = Transform() if in_place else None

    def step(self, follower: Odometry, time: float, offboard: bool) -> None:
        """Come to a follower that has just come into offboard mode; face away from it."""
        if not self._in_place and time < 0.0 and not offboard:
            self._frame = None
        elif self._frame is None and offboard:
            height = np.array([0.0, 0.0, self._scenario.scenario.start.altitude])
            self._frame = Transform.from_quaternion(
                follower.position - height,
                quaternion_from_yaw(yaw_from_quaternion(follower.quaternion)))
        if self._frame is not None:
            self._scenario.turn(time, self._frame.inverse().apply(follower.position))

    def pose(self, time_ns: int, time: float) -> Transform | None:
        """Return the pose on its course."""
        return None if self._frame is None else self._frame @ self._scenario.leader(time)

    def motion(self, time_ns: int, time: float) -> Odometry | None:
        """Return the motion on its course."""
        if self._frame is None:
            return None
        leader = self._scenario.leader_odometry(time)
        return leader._replace(
            position=self._frame.apply(leader.position),
            quaternion=quaternion_multiply(self._frame.quaternion, leader.quaternion))

    def knows(self, time_ns: int) -> bool:
        """Return True."""
        return True


class ExternalLeader:
    """
    A leader that an external autopilot flies and reports.

    :param motion: with the same ``origin`` as the follower's.
    :param start_ns: time zero of the flight on the clock of ``motion``.
    :param origin: (3,), m, of the frame of ``motion`` in that of the flight.
    """

    def __init__(self, motion: ExternalMotion, start_ns: int, origin: Array) -> None:
        self._motion, self._start_ns, self._origin = motion, start_ns, origin

    def step(self, follower: Odometry, time: float, offboard: bool) -> None:
        """Do nothing: the leader flies by itself."""

    def pose(self, time_ns: int, time: float) -> Transform | None:
        """Return the reported pose; of a future moment, the newest one."""
        leader = self.motion(time_ns, time)
        return None if leader is None else Transform(
            quaternion_to_matrix(leader.quaternion), leader.position)

    def motion(self, time_ns: int, time: float) -> Odometry | None:
        """Return the reported motion at a time; None once its poses stall."""
        newest, at = self._motion.newest, self._start_ns + time_ns
        if newest is None or at - newest > LONGEST_GAP:
            return None
        leader = self._motion.at(at)
        return Odometry(time, self._origin + leader.position, leader.quaternion,
                        quaternion_to_matrix(leader.quaternion).T @ leader.velocity,
                        leader.angular)

    def knows(self, time_ns: int) -> bool:
        """Return whether poses were reported shortly before and after."""
        return self._motion.knows(self._start_ns + time_ns)


FlownLeader = ScenarioLeader | ExternalLeader
