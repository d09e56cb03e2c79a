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

"""A live flight as it was recorded: what really happened, what was estimated and sent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

import cv2
import numpy as np

from flock_desk.runs.flight_record import (
    compared,
    estimates,
    FlightRecord,
    read_record,
)
from flock_desk.runs.report import Chapter, Illustration
from flock_desk.scenarios.scenario import Scenario
from flock_follower.geometry import Array
from flock_follower.messages import from_trajectory, OdometryState

if TYPE_CHECKING:
    from flock_desk.runs.plots import PlottedFlight


@dataclass(frozen=True, eq=False)
class LiveRecord(FlightRecord):
    """
    A flight of a scenario, in the odom frame without drift.

    An image of the table counts as one with the leader in view where the simulator says that it
    can be seen, and placed. ``log`` is the simulator's, see ``RealTimeLog``, cut to the scenario.
    Where an external autopilot flew it, nobody sees the wire: ``setpoints`` are what the planner
    commanded.
    """

    scenario: Scenario
    log: dict[str, Any]

    @property
    def external(self) -> bool:
        """Return whether an autopilot elsewhere flew the follower."""
        return bool(str(self.log['pose_source']))

    @property
    def pace(self) -> float:
        """Return how fast such an autopilot's time went, by ours; NaN where it did not tell."""
        ours, theirs = self.log['clock'].T
        return (float((theirs[-1] - theirs[0]) / (ours[-1] - ours[0])) if len(ours) > 1
                else math.nan)

    @property
    def leader_speed(self) -> Array:
        """Return how fast the leader was at each image, m/s."""
        return np.linalg.norm(self.log['leader_velocity'], axis=1)

    @property
    def time_in_band_share(self) -> float:
        """Return the share of the time for which the true distance was inside the band."""
        law = self.scenario.flight
        return float(np.mean((self.distance > math.sqrt(law.d0))
                             & (self.distance < math.sqrt(law.d1))))

    @property
    def blind(self) -> list[tuple[float, float]]:
        """Return from when to when images could not show the leader, or place it, s."""
        times, hidden = self.table['time'], self.table['visible'] == 0.0
        edges = np.flatnonzero(np.diff(np.concatenate([[False], hidden, [False]]).astype(int)))
        return [(float(times[begin]), float(times[min(end, len(times) - 1)]))
                for begin, end in zip(edges[::2], edges[1::2])]


def read(scenario: Scenario, out: Path, namespace: str = '') -> LiveRecord:
    """
    Return the flight recorded in a folder.

    :param namespace: of its nodes; others tell their diagnostics on the same topic.
    :raises BagError: where its record cannot be read.
    :raises RuntimeError: where the scenario never began, or no image was made.
    """
    with np.load(out / 'flight.npz') as file:
        log = dict(file)
    began = float(log['began'])
    if not math.isfinite(began):
        raise RuntimeError('the scenario never began: no offboard mode, or not engaged')
    epoch = int(log['epoch_ns']) + round((began - float(log['start'])) * 1e9)
    ended = float(log['ended'])

    def flown(name: str) -> Any:
        return (log[name] >= began) & (log[name] <= ended)

    apart, state_flown = flown('distance_time'), flown('state_time')
    until = epoch + round((ended - began) * 1e9)
    shown = (log['image_stamp'] >= epoch) & (log['image_stamp'] <= until)
    log['clock'] = log['clock'][(log['clock'][:, 0] >= began) & (log['clock'][:, 0] <= ended)]
    for name in list(log):
        if name.startswith(('image_', 'follower_', 'leader_')):
            log[name] = log[name][shown]
    if not len(log['image_stamp']):
        raise RuntimeError('not one image was rendered in time: the machine is too busy')
    for name in ('state_time', 'position', 'velocity', 'acceleration', 'mode'):
        log[name] = log[name][state_flown]
    record = read_record(out / 'record')
    if str(log['pose_source']):
        commands = record.get('/command/trajectory', [])
        log['setpoint_time'] = np.array([command.time for command in commands])
        log['setpoint_acceleration'] = np.reshape(
            [from_trajectory(command.message, 'odom').acceleration for command in commands],
            (-1, 3))
    sent = flown('setpoint_time')
    table, leader, follower = compared(
        estimates(record.get('/neighbors', [])), _states(log, 'odom', log['odom_stamp']),
        _states(log, 'follower', log['image_stamp']), _states(log, 'leader', log['image_stamp']),
        log['image_stamp'], log['image_usable'].astype(float), epoch)
    return LiveRecord(
        duration=ended - began, params=scenario.flight.planner(True), table=table, leader=leader,
        follower=follower, distance=log['distance'][apart],
        setpoint_times=log['setpoint_time'][sent] - began,
        setpoints=log['setpoint_acceleration'][sent],
        velocity_times=log['state_time'] - began, velocities=log['velocity'],
        states=[(float(t) - began, str(s))
                for t, s in zip(log['planner_time'], log['planner_state'])],
        diagnostics=[(t - began, _of(m, namespace)) for t, m in record.get('/diagnostics', [])],
        scenario=scenario, log=log)


def _of(array: Any, namespace: str) -> Any:
    """Return a DiagnosticArray with what nodes of a namespace tell, under their own names."""
    if namespace:
        array.status = [status for status in array.status
                        if status.name.startswith(f'{namespace}/')]
        for status in array.status:
            status.name = status.name.removeprefix(f'{namespace}/')
    return array


def picture(flight: LiveRecord) -> bytes:
    """Return a JPEG of an image of the follower's camera beside both tracks."""
    from flock_desk.runs import plots
    images = flight.log['picture']
    return plots.portrait(images[len(images) // 2], _plotted(flight))


def _plotted(flight: LiveRecord) -> PlottedFlight:
    from flock_desk.runs import plots
    speeds = [
        plots.Curve('follower', plots.FOLLOWER, flight.velocity_times,
                    np.linalg.norm(flight.velocities, axis=1)),
        plots.Curve('leader', plots.LEADER, flight.table['time'], flight.leader_speed)]
    return flight.plotted(speeds, flight.blind)


def chapters(flight: LiveRecord) -> Iterator[Chapter]:
    """Yield what the report shows of a flight: plots, and images of the follower's camera."""
    from flock_desk.runs import plots
    log, times = flight.log, flight.table['time']
    yield from plots.chapters(
        _plotted(flight),
        note='Shaded: the scenario hides the leader, or withholds the odometry to place it with.')
    epoch = int(log['image_stamp'][0]) - round(float(times[0]) * 1e9)
    yield Chapter("What the follower's camera saw", '', [
        Illustration(cv2.imencode('.jpg', image)[1].tobytes(), '',
                     f'{(int(stamp) - epoch) * 1e-9:.1f} s')
        for stamp, image in zip(log['picture_stamp'], log['picture'])])


def _states(log: dict[str, Any], name: str, stamps: Any) -> list[OdometryState]:
    unknown = np.zeros((6, 6))
    return [OdometryState(int(stamp), 'odom', name, position, quaternion, velocity, np.zeros(3),
                          unknown, unknown, np.eye(3))
            for stamp, position, quaternion, velocity in zip(stamps, *(
                log[f'{name}_{what}'] for what in ('position', 'quaternion', 'velocity')))]
