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


"""A flight through the real nodes, read from its files: a replayed one, and one of a scenario."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass, field
import fcntl
import math
from pathlib import Path
import shutil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flock_desk.runs.directions import along_law, opposed
from flock_desk.runs.frame_errors import FrameErrors, Table
from flock_desk.runs.processes import LateError
from flock_desk.scenarios.scenario import Scenario
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array, quaternion_to_matrix, Transform
from flock_follower.messages import NANOSECONDS, OdometryState, RELATIVE, stamp_to_nanoseconds
from flock_follower.messages.command_reader import from_trajectory
from flock_follower.messages.state_reader import from_odometry
from flock_follower.odometry.reader import OdometrySource
from flock_follower.parameters.neighbors_file import MarkedNeighbor
from flock_follower.perception.neighbor_filter import Estimate
from flock_follower.planner.params import PlannerParams

LEADER_NAME = 'leader'  # as config/neighbors.yaml names it
REPLAYED = 'vehicle that flew the commands'
_RECORD = 'record'
_FILES = (_RECORD, 'autopilot.npz', 'flight.npz', 'report.html', 'summary.json')


@dataclass(frozen=True, eq=False, kw_only=True)
class Flight:
    """
    A flight behind one neighbor; times in s from its beginning, vectors in odom.

    ``table`` is the table of ``frame_errors`` for n images. ``paths`` holds the positions of
    leader and follower at these images, (n, 2) or (n, 3), m, by label. ``speeds`` holds times (m,)
    and speeds (m,), m/s, by label; the first label is the vehicle that flew the setpoints.
    ``setpoints`` (k, 3), m/s^2, were sent at ``setpoint_times`` (k,); if ``commanded`` (k,) is
    False, without a command. ``states`` are the planner's states with the times of entry.
    ``blind`` holds the intervals in which the leader could not be seen.

    A flight through the nodes also has: ``distance``, the known true distances, m;
    ``diagnostics``, the published arrays with their times; ``command_times``, the ticks of the
    planner's commands, s on the bag's clock; ``along_law`` and ``opposed``, see ``directions``.
    """

    name: str = LEADER_NAME
    duration: float
    params: PlannerParams
    table: Table
    paths: Mapping[str, Array]
    speeds: Mapping[str, tuple[Array, Array]]
    setpoint_times: Array
    setpoints: Array
    commanded: NDArray[np.bool_] | None = None
    states: list[tuple[float, str]]
    blind: Sequence[tuple[float, float]] = ()
    distance: Array = field(default_factory=lambda: np.empty(0))
    diagnostics: Sequence[tuple[float, Any]] = ()
    command_times: Array = field(default_factory=lambda: np.empty(0))
    along_law: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))
    opposed: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))

    def values(self, node: str, key: str) -> list[tuple[float, str]]:
        """Return the values of a key in a node's diagnostics, with their times."""
        return [(t, pair.value) for t, array in self.diagnostics for status in array.status
                if status.name == node for pair in status.values if pair.key == key]

    def value(self, node: str, key: str, time: float, otherwise: float = math.nan) -> float:
        """Return the last value of a key up to a time, s."""
        before = [value for t, value in self.values(node, key) if t <= time]
        return float(before[-1]) if before else otherwise


@dataclass(frozen=True, eq=False, kw_only=True)
class LiveFlight(Flight):
    """
    A flight of a scenario, in the odom frame without drift; its paths are the true ones.

    An image of the table counts as "leader in view" if the simulator reports that the leader can
    be seen and located. ``log`` is the simulator's, see ``FlightLog``, cut to the
    scenario. If an external autopilot flew it, ``setpoints`` are the planner's commands.
    """

    scenario: Scenario
    log: dict[str, Any]

    @property
    def external(self) -> bool:
        """Return whether an external autopilot flew the follower."""
        return bool(str(self.log['pose_source']))

    @property
    def pace(self) -> float:
        """Return the rate of the external autopilot's clock by ours; NaN if it is unknown."""
        ours, theirs = self.log['clock'].T
        return (float((theirs[-1] - theirs[0]) / (ours[-1] - ours[0])) if len(ours) > 1
                else math.nan)

    @property
    def time_in_band_share(self) -> float:
        """Return the share of the time for which the true distance was inside the band."""
        law = self.scenario.flight
        return float(np.mean((self.distance > math.sqrt(law.d0))
                             & (self.distance < math.sqrt(law.d1))))


def read_replayed(bag: Path, out: Path, params: PlannerParams) -> Flight:
    """
    Return a replayed flight; its time begins with the bag's first image.

    A figure is unknown if no node published its data.

    :param out: the folder of the record and the log of the embedded autopilot.
    :param params: that it was flown with.
    :raises BagError: if a record cannot be read.
    """
    record = read_record(out / _RECORD)
    commands = record.get('/command/trajectory', [])
    received = np.array([t for t, _ in commands])
    ticks = np.array([tick_time(message) for _, message in commands])
    with open_bag(bag) as opened:
        images, odometry, true_own, true_leader = (
            [deserialize(m.data, m.msgtype) for m in opened.messages([topic])]
            for topic in ('/image_raw/compressed', '/odom', '/truth/odom', '/truth/neighbors'))
    stamps = np.array([stamp_to_nanoseconds(image.header.stamp) for image in images])
    source = OdometrySource()  # as the nodes read it
    own = [state for message in odometry
           if (state := source.take(message, stamp_to_nanoseconds(message.header.stamp)))]
    leader_states, follower_states = (
        [*map(from_odometry, states)] for states in (true_leader, true_own))
    table = compared(estimates(_received(record)), own, follower_states, leader_states, stamps,
                     np.ones(len(stamps)), int(stamps[0]))  # its leader is always in view
    with np.load(out / 'autopilot.npz') as file:
        log = dict(file)
    # The bag's clock relative to the monotonic one of the logs; without a command about so.
    origin = (stamps[0] / NANOSECONDS + float(np.median(received - ticks)) if commands
              else float(log['state_time'][-1] - table['time'][-1]))
    sent = (np.zeros(len(log['setpoint_time']), dtype=bool) if not commands else
            (log['setpoint_time'] >= received[0]) & (log['setpoint_time'] <= received[-1]))
    return Flight(
        duration=float(table['time'][-1]), params=params, table=table,
        paths={'leader': _positions(leader_states, stamps),
               'follower': _positions(follower_states, stamps)},
        # Its path means nothing in the bag.
        speeds={REPLAYED: (log['state_time'] - origin, np.linalg.norm(log['velocity'], axis=1))},
        distance=table['true_distance'][np.isfinite(table['true_distance'])],
        setpoint_times=log['setpoint_time'][sent] - origin,
        setpoints=log['setpoint_acceleration'][sent],
        states=[(t - origin, m.data) for t, m in record.get('/planner/state', [])],
        diagnostics=[(t - origin, m) for t, m in record.get('/diagnostics', [])],
        command_times=ticks,
        along_law=along_law([m for _, m in commands], _received(record), own, params.law),
        opposed=opposed(log, commands))


def tick_time(message: Any) -> float:
    """Return the time for which a command holds, s: its stamp plus its point's time from start."""
    command = from_trajectory(message, message.header.frame_id)
    return (command.stamp + command.ahead) / NANOSECONDS


def read_flown(scenario: Scenario, out: Path, namespace: str = '') -> LiveFlight:
    """
    Return the flight of a scenario that `fly` recorded in a folder.

    :param namespace: of the flight's nodes; other nodes publish their diagnostics on the same
    topic.
    :raises BagError: if its record cannot be read.
    :raises LateError: if the scenario never began, no image was made, or nothing was written.
    """
    if not (out / 'flight.npz').is_file():
        raise LateError('the simulator was ended before it had written its record')
    with np.load(out / 'flight.npz') as file:
        log = dict(file)
    began, ended = float(log['began']), float(log['ended'])
    if not math.isfinite(began):
        raise LateError('the scenario never began: no offboard mode, or not engaged')
    epoch = int(log['epoch_ns']) + round((began - float(log['start'])) * 1e9)

    def flown(times: Any, begin: float = began, end: float = ended) -> Any:
        return (times >= begin) & (times <= end)

    shown = flown(log['image_stamp'], epoch, epoch + round((ended - began) * 1e9))
    if not shown.any():
        raise LateError('not one image was rendered in time')
    record = read_record(out / _RECORD)
    commands = record.get('/command/trajectory', [])
    against = opposed(log, commands)  # no setpoints of an external autopilot are logged
    _cut(log, shown, flown(log['state_time']), flown(log['clock'][:, 0]))
    if str(log['pose_source']):
        log['setpoint_time'] = np.array([time for time, _ in commands])
        log['setpoint_acceleration'] = np.reshape(
            [from_trajectory(message, 'odom').acceleration for _, message in commands],
            (-1, 3))
    sent = flown(log['setpoint_time'])
    neighbors, stamps = _received(record), log['image_stamp']
    own = _logged_states(log, 'odom', log['odom_stamp'])
    table = compared(
        estimates(neighbors), own,
        _logged_states(log, 'follower', stamps), _logged_states(log, LEADER_NAME, stamps), stamps,
        judged(log['image_usable'], stamps, neighbors), epoch)
    return LiveFlight(
        duration=ended - began, params=scenario.flight.planner(True), table=table,
        paths={name: log[f'{name}_position'] for name in (LEADER_NAME, 'follower')},
        speeds={'follower': (log['state_time'] - began, np.linalg.norm(log['velocity'], axis=1)),
                'leader': (table['time'], np.linalg.norm(log['leader_velocity'], axis=1))},
        blind=_hidden_intervals(table),
        distance=log['distance'][flown(log['distance_time'])],
        setpoint_times=log['setpoint_time'][sent] - began,
        setpoints=log['setpoint_acceleration'][sent],
        along_law=along_law([m for t, m in commands if began <= t <= ended], neighbors, own,
                            scenario.flight.planner(True).law),
        opposed=against,
        states=[(float(t) - began, str(s))
                for t, s in zip(log['planner_time'], log['planner_state'])],
        diagnostics=[(t - began, _of(m, namespace)) for t, m in record.get('/diagnostics', [])],
        scenario=scenario, log=log)


def _cut(log: dict[str, Any], images: Any, states: Any, clock: Any) -> None:
    """Keep those images, states and clock times of a log that the masks select."""
    log['clock'] = log['clock'][clock]
    for name in log:
        if name.startswith(('image_', 'follower_', 'leader_')):
            log[name] = log[name][images]
        elif name in ('state_time', 'position', 'velocity', 'acceleration', 'mode'):
            log[name] = log[name][states]


def _hidden_intervals(table: Table) -> list[tuple[float, float]]:
    """Return the times, s, in which the leader could not be seen, from and to."""
    times, hidden = table['time'], table['visible'] == 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], hidden, [False]]).astype(int)))
    return [(float(times[begin]), float(times[min(end, len(times) - 1)]))
            for begin, end in zip(edges[::2], edges[1::2])]


def _of(array: Any, namespace: str) -> Any:
    """Return a DiagnosticArray with the statuses of a namespace, under the nodes' own names."""
    if namespace:
        array.status = [status for status in array.status
                        if status.name.startswith(f'{namespace}/')]
        for status in array.status:
            status.name = status.name.removeprefix(f'{namespace}/')
    return array


def _logged_states(log: Mapping[str, Any], name: str, stamps: Any) -> list[OdometryState]:
    zero, unknown = np.zeros(3), np.zeros((6, 6))
    return [OdometryState(int(stamp), 'odom', name, position, quaternion, velocity, zero,
                          unknown, unknown, np.eye(3))
            for stamp, position, quaternion, velocity in zip(stamps, *(
                log[f'{name}_{what}'] for what in ('position', 'quaternion', 'velocity')))]


def read_record(path: Path) -> dict[str, list[tuple[float, Any]]]:
    """
    Return the messages that the recorder wrote, by topic, each with its monotonic time, s.

    :raises BagError: if it cannot be read.
    """
    with open_bag(path) as bag:
        messages = [(m.topic, m.stamp_ns / NANOSECONDS, deserialize(m.data, m.msgtype))
                    for m in bag.messages()]
    return {topic: [(time, message) for name, time, message in messages if name == topic]
            for topic in {topic for topic, _, _ in messages}}


def _received(record: Mapping[str, Sequence[tuple[float, Any]]]) -> list[OdometryState]:
    return [from_odometry(message) for _, message in record.get('/neighbors', [])]


def estimates(states: Iterable[OdometryState]) -> dict[int, dict[str, Estimate]]:
    """
    Return the estimates of states published on ``neighbors``, by stamp, ns, and name.

    Missing parts of a state are zero. States of flight without odometry are left out.
    """
    found: dict[int, dict[str, Estimate]] = {}
    for state in states:
        if state.frame == RELATIVE:
            continue
        rotation, covariance = quaternion_to_matrix(state.quaternion), np.zeros((15, 15))
        covariance[:3, :3] = state.pose_covariance[:3, :3]
        covariance[3:6, 3:6] = state.velocity_covariance
        found.setdefault(state.stamp, {})[state.child] = Estimate(
            state.stamp / NANOSECONDS, state.position, state.velocity, rotation,
            rotation @ state.angular_velocity, np.zeros(3), covariance)
    return found


def judged(visible: Array, stamps: NDArray[np.int64], neighbors: Sequence[OdometryState]) -> Array:
    """
    Return 1 for images with the leader in view, 0 for others, NaN in flight without odometry.

    In flight without odometry the leader is found, but no truth exists in the frame RELATIVE.

    :param visible: (n,); :param stamps: (n,), ns; :param neighbors: as published.
    """
    relative = [state.stamp for state in neighbors if state.frame == RELATIVE]
    return np.where(np.isin(stamps, relative), np.nan, visible)


def compared(found: Mapping[int, Mapping[str, Estimate]], own: Sequence[OdometryState],
             true_own: Sequence[OdometryState], true_leader: Sequence[OdometryState],
             stamps: NDArray[np.int64], visible: Array, start: int) -> Table:
    """
    Return the table of ``frame_errors``.

    The consistency of velocities (error over covariance) is NaN: the covariance of a message is
    that of the twist in the leader's body, and includes the error of the leader's attitude.

    :param stamps: (n,) of the images, ns.
    :param visible: (n,), see :func:`judged`.
    :param start: stamp of the time 0 of the table, ns.
    """
    errors = FrameErrors(
        [MarkedNeighbor(LEADER_NAME, ())], Transform(np.eye(3), np.zeros(3)), start)
    for state in own:
        errors.odometry(state)
    for true_state in true_own:
        errors.truth(true_state, own=True)
    for true_state in true_leader:
        errors.truth(true_state._replace(child=LEADER_NAME))
    for stamp in stamps.tolist():
        errors.frame(stamp, found.get(stamp, {}), {})
    return {**errors.table(LEADER_NAME), 'visible': visible,
            'nees_velocity': np.full(len(stamps), np.nan)}


def _positions(states: Sequence[OdometryState], stamps: NDArray[np.int64]) -> Array:
    """Return the positions (n, 3) at stamps, linear between states."""
    times = np.array([s.stamp for s in states]) - stamps[0]
    return along(stamps - stamps[0], times, np.array([s.position for s in states]))


def along(times: Array, known: Array, positions: Array) -> Array:
    """Return positions (n, 3) at times (n,), linear between known ones; NaN outside."""
    return np.stack([np.interp(times, known, column, np.nan, np.nan)
                     for column in positions.T], axis=1)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """
    Keep a folder, which is made, from a second flight inside the block.

    :raises RuntimeError: if another flight is writing to it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / '.lock', 'w', encoding='ascii') as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RuntimeError(f'another flight writes to {folder}: give --output (with make: '
                               'OUTPUT=)') from error
        yield


def clear(folder: Path) -> None:
    """Remove the record, the logs and the results of an earlier flight, and nothing else."""
    for path in (*(folder / name for name in _FILES), *folder.glob('*.log')):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
