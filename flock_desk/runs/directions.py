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

"""Checks that commands point along the law, and setpoints along their commands."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from flock_follower.flocking import acceleration, FlockingParams
from flock_follower.geometry import Array
from flock_follower.messages import OdometryState, RELATIVE
from flock_follower.messages.command_reader import from_trajectory

SAME_TIME_NS = 50_000_000  # between an estimate and the odometry that places it
#: A setpoint rests on a command that arrived at most this long before, s.
FRESH: Final = 0.2
#: Without a command for this long, s, the gate brakes.
SILENT: Final = 0.6
#: Commands, m/s^2, and velocities, m/s, below this are too short to have a direction.
SHORTEST: Final = 0.3
#: Likewise setpoints, m/s^2.
SHORTEST_SETPOINT: Final = 0.05


def along_law(commands: Iterable[Any], neighbors: Sequence[OdometryState],
              own: Sequence[OdometryState], law: FlockingParams) -> NDArray[np.bool_]:
    """
    Return whether each command points along the law, horizontally.

    The guard and the limits change length and direction of the law's command, but seldom reverse
    it. Commands without an estimate, or with an estimate that has no odometry at its stamp, are
    left out.

    :param neighbors: as published. :param own: the odometry.
    """
    known = {state.stamp: state for state in neighbors if state.frame != RELATIVE}
    stamps, along = np.array([state.stamp for state in own]), []
    for message in commands:
        command = from_trajectory(message, message.header.frame_id)
        leader = known.get(command.stamp)
        if leader is None or not len(stamps):
            continue
        ego = own[int(np.argmin(np.abs(stamps - command.stamp)))]
        if abs(ego.stamp - command.stamp) <= SAME_TIME_NS:
            demanded = acceleration([leader.position - ego.position],
                                    [leader.velocity - ego.velocity], law)
            along.append(bool(demanded[:2] @ np.asarray(command.acceleration)[:2] > 0.0))
    return np.array(along, dtype=bool)


def opposed(log: Mapping[str, Array], commands: Sequence[tuple[float, Any]]) -> NDArray[np.bool_]:
    """
    Return whether each setpoint points against its command or along the velocity.

    With fresh commands a setpoint counts if it points horizontally against each of them, and not
    against the velocity: the gate may brake, and on a busy machine it uses a command before the
    newest. The vertical part is not compared, because it contains the offset of the thrust.
    Without a command a setpoint counts if it points along the velocity, because the gate brakes. A
    wrong sign reverses almost all setpoints. Setpoints between the two cases, and very small
    setpoints, commands or velocities, are left out.

    :param log: the autopilot's: times, s, setpoints and velocities (n, 3), ENU.
    :param commands: as published, each with its time of arrival, s, on the same clock.
    """
    times, setpoints = log['setpoint_time'], log['setpoint_acceleration']
    if not len(times) or not len(log['state_time']):
        return np.empty(0, dtype=bool)
    velocity = np.column_stack([np.interp(times, log['state_time'], each)
                                for each in log['velocity'].T])
    arrived = np.array([-np.inf, *(time for time, _ in commands)])
    wanted = np.array([np.zeros(3), *(
        np.asarray(from_trajectory(message, message.header.frame_id).acceleration) * [1, 1, 0]
        for _, message in commands)])
    newest = np.searchsorted(arrived, times, side='right') - 1
    age = times - arrived[newest]
    fresh, silent = age < FRESH, age > SILENT
    along_velocity = np.sum(velocity * setpoints, axis=1)
    with_some = np.array([np.any(wanted[(arrived > time - SILENT) & (arrived <= time)] @ setpoint
                                 > 0.0) for time, setpoint in zip(times, setpoints)])
    basis = np.where(fresh[:, None], wanted[newest], np.where(silent[:, None], velocity, 0.0))
    clear = (np.linalg.norm(basis, axis=1) > SHORTEST) & (
        np.linalg.norm(setpoints, axis=1) > SHORTEST_SETPOINT)
    against: NDArray[np.bool_] = (along_velocity > 0.0) & (silent | ~with_some)
    return against[clear]
