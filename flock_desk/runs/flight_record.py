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

"""A flight through the real nodes as their recorder and the autopilot's log tell it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flock_desk.runs.frame_errors import FrameErrors, Table
from flock_desk.runs.summary import (
    hold_figures,
    holds,
    most,
    rate,
    sight_figures,
    spread,
)
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array, quaternion_to_matrix, Transform
from flock_follower.messages import from_odometry, NANOSECONDS, OdometryState
from flock_follower.perception.markers import MarkedNeighbor
from flock_follower.perception.neighbor_filter import Estimate
from flock_follower.planner.params import PlannerParams

if TYPE_CHECKING:
    from flock_desk.runs.plots import Curve, PlottedFlight

LEADER_NAME = 'leader'  # as config/neighbors.yaml names it


class Received(NamedTuple):
    """A recorded message and when it came, s on the monotonic clock."""

    time: float
    message: Any


@dataclass(frozen=True, eq=False)
class FlightRecord:
    """
    A flight; times in s from its beginning, vectors in odom or a frame like it without drift.

    ``table`` is that of ``frame_errors``, n images; ``leader`` and ``follower`` (n, 3) are the
    true places, m, at these. ``distance`` holds true distances, m, as often as they are known.
    ``setpoints`` (k, 3), m/s^2, were on the wire at ``setpoint_times`` (k,); the vehicle flew
    ``velocities`` (m, 3), m/s, at ``velocity_times`` (m,). ``states`` are the planner's, and
    ``diagnostics`` the arrays published, each with its time.
    """

    duration: float
    params: PlannerParams
    table: Table
    leader: Array
    follower: Array
    distance: Array
    setpoint_times: Array
    setpoints: Array
    velocity_times: Array
    velocities: Array
    states: list[tuple[float, str]]
    diagnostics: list[tuple[float, Any]]

    def values(self, node: str, key: str) -> list[tuple[float, str]]:
        """Return the values of a key in a node's diagnostics, with their times."""
        return [(t, pair.value) for t, array in self.diagnostics for status in array.status
                if status.name == node for pair in status.values if pair.key == key]

    def value(self, node: str, key: str, time: float, otherwise: float = float('nan')) -> float:
        """Return the last value of a key up to a time, s."""
        before = [value for t, value in self.values(node, key) if t <= time]
        return float(before[-1]) if before else otherwise

    def plotted(self, speeds: Sequence[Curve],
                blind: Sequence[tuple[float, float]] = ()) -> PlottedFlight:
        """
        Return what the pictures of ``plots`` show of it, which needs matplotlib.

        :param speeds: curves over time, m/s.
        :param blind: from when to when the leader could not be seen.
        """
        from flock_desk.runs.plots import Curve, FOLLOWER, LEADER, PlottedFlight
        paths = [Curve('leader', LEADER, *self.leader[:, :2].T),
                 Curve('follower', FOLLOWER, *self.follower[:, :2].T)]
        return PlottedFlight(
            name=LEADER_NAME, duration=self.duration, table=self.table, params=self.params,
            paths=paths, speeds=speeds, setpoint_times=self.setpoint_times,
            setpoints=self.setpoints, commanded=np.ones(len(self.setpoints), dtype=bool),
            states=self.states, blind=blind)


def flight_figures(flight: FlightRecord,
                   exit_codes: Mapping[str, int | None]) -> dict[str, Any]:
    """
    Return the figures that ``demo`` and ``fly`` have in common, NaN where they are not known.

    ``true_distance_m`` is that of ``flight.distance``. ``setpoints`` are those on the wire,
    ``speed_max_m_s`` is the vehicle's, ``latency_ms`` from an image's stamp to MAVLink, as the
    bridge counts it. ``holds`` are those of the planner, each with its reason.
    ``failed_processes`` counts those that did not end with 0 in time.
    """
    speeds = np.linalg.norm(flight.velocities, axis=1)
    held = hold_figures(holds(flight.states, flight.values('planner', 'reason'), flight.duration))
    after = flight.duration + 1.0  # every node says once per second what it has counted
    return {
        'duration_s': flight.duration,
        'frames': len(flight.table['time']),
        **sight_figures([flight.table], flight.params.max_velocity_std),
        'true_distance_m': spread(flight.distance),
        'planner': {'missed_ticks': flight.value('planner', 'missed_ticks', after)
                    - flight.value('planner', 'missed_ticks', 0.0, 0.0),
                    **held['planner']},
        'holds': held['holds'],
        'setpoints': {
            'sent': len(flight.setpoints),
            'rate_hz': rate(flight.setpoint_times),
            'acceleration_max_m_s2': most(np.linalg.norm(flight.setpoints, axis=1))},
        'speed_max_m_s': most(speeds),
        'latency_ms': {f'p{p}': flight.value('mavlink_bridge', f'latency_p{p}_ms', after)
                       for p in (50, 95, 99)},
        'failed_processes': sum(code != 0 for code in exit_codes.values())}


def read_record(path: Path, wanted: Iterable[str] = ()) -> dict[str, list[Received]]:
    """
    Return what the recorder wrote, by topic.

    :raises BagError: where it cannot be read.
    :raises RuntimeError: naming those of the wanted topics on which nothing was published.
    """
    record: dict[str, list[Received]] = {}
    with open_bag(path) as bag:
        for m in bag.messages():
            record.setdefault(m.topic, []).append(
                Received(m.stamp_ns / NANOSECONDS, deserialize(m.data, m.msgtype)))
    if missing := sorted(set(wanted) - set(record)):
        raise RuntimeError(f'nothing was published on {", ".join(missing)}')
    return record


def estimates(messages: Iterable[Received]) -> dict[int, dict[str, Estimate]]:
    """Return the estimates that messages of ``neighbors`` hold, by stamp, ns, and name."""
    found: dict[int, dict[str, Estimate]] = {}
    for received in messages:
        state = from_odometry(received.message)
        found.setdefault(state.stamp, {})[state.child] = _estimate(state)
    return found


def compared(found: Mapping[int, Mapping[str, Estimate]], own: Sequence[OdometryState],
             true_own: Sequence[OdometryState], true_leader: Sequence[OdometryState],
             stamps: NDArray[np.int64], visible: Array,
             start: int) -> tuple[Table, Array, Array]:
    """
    Return the table of ``frame_errors`` and the true places (n, 3) of leader and follower.

    The consistency of velocities is left unknown (NaN): the covariance in a message is of the
    twist in the leader's body, and holds the error of the leader's attitude, too.

    :param stamps: (n,) of the images, ns.
    :param visible: (n,), 1 where the truth has the leader in view.
    :param start: the time of zero in the table, ns.
    """
    errors = FrameErrors(
        [MarkedNeighbor(LEADER_NAME, ())], Transform(np.eye(3), np.zeros(3)), start)
    events: list[tuple[int, Callable[..., None], tuple[Any, ...]]] = [
        (state.stamp, take, (state,)) for states, take in (
            (own, errors.odometry), (true_own, errors.true_odometry),
            (true_leader, errors.true_neighbor)) for state in states]
    events += [(stamp, errors.frame, (stamp, found.get(stamp, {}), {}))
               for stamp in stamps.tolist()]
    for _, take, arguments in sorted(events, key=itemgetter(0)):
        take(*arguments)
    errors.finish()
    leader, follower = (_places(states, stamps) for states in (true_leader, true_own))
    table = {**errors.table(LEADER_NAME), 'visible': visible,
             'nees_velocity': np.full(len(stamps), np.nan)}
    return table, leader, follower


def _places(states: Sequence[OdometryState], stamps: NDArray[np.int64]) -> Array:
    """Return the places (n, 3) at stamps, linear between states."""
    times = np.array([s.stamp for s in states]) - stamps[0]
    places = np.array([s.position for s in states])
    return np.stack([np.interp(stamps - stamps[0], times, column) for column in places.T], axis=1)


def _estimate(state: OdometryState) -> Estimate:
    """Return the estimate of a message; what the message does not hold is zero."""
    rotation, covariance = quaternion_to_matrix(state.quaternion), np.zeros((15, 15))
    covariance[:3, :3] = state.pose_covariance[:3, :3]
    covariance[3:6, 3:6] = state.velocity_covariance
    return Estimate(state.stamp / NANOSECONDS, state.position, state.velocity, rotation,
                    rotation @ state.angular_velocity, np.zeros(3), covariance)
