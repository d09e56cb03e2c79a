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
The signs of commands and setpoints, judged without a clock.

On a busy machine a flight through the nodes may send too little to judge a sign by, or not even
begin. Then filter, planner and gate fly a few seconds in lock step, behind a leader that leaves:
load does not change that flight. It does not show a fault in a node itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flock_desk.closed_loop.detector_flight import Detector, DetectorFlight
from flock_desk.runs.directions import along_law, opposed
from flock_desk.runs.figure_table import bounds
from flock_desk.runs.judge import judge
from flock_desk.runs.summary import mean
from flock_desk.scenarios.scenario import LeaderMotion, Leg, Scenario, Start
from flock_follower.bags.message_types import empty
from flock_follower.messages import NANOSECONDS, OdometryState
from flock_follower.messages.command_writer import TRAJECTORY
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import ODOMETRY

OFFBOARD_TIME = 2.5  # s in offboard mode
#: The leader leaves at once, faster than the default v_max: all commands point one way.
LEAVING = LeaderMotion(wait=0.0, acceleration=2.0, jerk=10.0, legs=(
    Leg(duration=60.0, velocity=(1.0, 0.0, 0.0)),))
#: The figures that judge the signs.
SIGNS = 'planner.along_law_share', 'setpoints.opposed_share'


class SignFlight(DetectorFlight):
    """A flight in lock step whose commands, estimates and odometry are kept."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin a flight with the parameters of a scenario, and a leader that leaves."""
        start = Start(distance=scenario.start.distance, altitude=scenario.start.altitude)
        super().__init__(Scenario('signs', 'a leader that leaves', flight=scenario.flight,
                                  start=start, leader=LEAVING), 0, Detector(), empty)
        self._law = scenario.flight.planner(True).law
        self._commands: list[tuple[float, Any]] = []
        self._neighbors: list[OdometryState] = []
        self._own: list[OdometryState] = []

    def publish(self, topic: str, msgtype: str, time: int, message: Any) -> None:
        if msgtype == TRAJECTORY and topic == 'command/trajectory':
            self._commands.append((self._flight.time_ns / NANOSECONDS, message))
        elif msgtype == ODOMETRY and topic == 'neighbors':
            self._neighbors.append(from_odometry(message))

    def odometry(self, state: OdometryState) -> None:
        self._own.append(state)

    def shares(self) -> dict[str, float | None]:
        """Fly, and return the figures of ``SIGNS``; None if nothing could be judged."""
        self.fly(OFFBOARD_TIME)
        directions = (along_law([message for _, message in self._commands], self._neighbors,
                                self._own, self._law),
                      opposed(self._vehicle.log.arrays(), self._commands))
        return {key: mean(np.asarray(each)) for key, each in zip(SIGNS, directions)}


def sign_faults(scenario: Scenario) -> list[str]:
    """Return the broken bounds of ``fly`` on the signs, in lock step; none if it does not fly."""
    try:
        shares = SignFlight(scenario).shares()
    except RuntimeError:  # it is not permitted: a turned sign does not do that
        return []
    return [f'{each.fault} (in lock step)'
            for each in judge(bounds('fly', {}, SIGNS).values(), shares)
            if each.fault and each.figure is not None]
