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

from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

import numpy as np

from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array
from flock_follower.simulation.scenarios.scenario import Scenario
from flock_follower.tools.metrics import relative_errors, RelativeErrors, States, states


@dataclass(frozen=True, eq=False)
class LiveRecord:
    """A flight, its times in s of the scenario, vectors in the odom frame without drift."""

    scenario: Scenario
    log: dict[str, Any]
    """Of the simulator, see ``LiveLog``, cut to the scenario."""
    times: Array
    """(n,) of the images."""
    distance_times: Array
    distance: Array
    """(m,), m, true."""
    errors: RelativeErrors
    error_times: Array
    seen: Any
    """(n,), whether an image gave an estimate."""
    setpoint_times: Array
    setpoints: Array
    """(k, 3), m/s^2, on the wire."""
    states: list[tuple[float, str]]
    """When the planner entered which state."""
    diagnostics: list[tuple[float, Any]]
    """When a node said what about itself."""

    @property
    def duration(self) -> float:
        """Return how long the scenario was flown, s."""
        return float(self.log['ended'] - self.log['began'])

    def values(self, node: str, key: str) -> list[tuple[float, str]]:
        """Return the values of a key in a node's diagnostics, with their times."""
        return [(t, pair.value) for t, array in self.diagnostics for status in array.status
                if status.name == node for pair in status.values if pair.key == key]

    def value(self, node: str, key: str, time: float, otherwise: str) -> str:
        """Return the last value of a key up to a time, s."""
        before = [value for t, value in self.values(node, key) if t <= time]
        return before[-1] if before else otherwise


def read(scenario: Scenario, out: Path) -> LiveRecord:
    """
    Return the flight recorded in a folder.

    :raises RuntimeError: where the scenario never began.
    """
    with np.load(out / 'flight.npz') as file:
        log = dict(file)
    began = float(log['began'])
    if not math.isfinite(began):
        raise RuntimeError('the scenario never began: no offboard mode, or not engaged')
    epoch = int(log['epoch_ns']) + round((began - float(log['start'])) * 1e9)
    flown = (log['state_time'] >= began) & (log['state_time'] <= log['ended'])
    apart = (log['distance_time'] >= began) & (log['distance_time'] <= log['ended'])
    shown = log['image_stamp'] >= epoch
    for name in list(log):
        if name.startswith(('image_', 'follower_', 'leader_')):
            log[name] = log[name][shown]
    for name in ('state_time', 'position', 'velocity', 'acceleration', 'mode'):
        log[name] = log[name][flown]
    neighbors, diagnostics = _recorded(out / 'record')
    estimates = [m for m in neighbors if _stamp(m) >= epoch]
    errors = relative_errors(
        states(estimates), _states(log, 'odom', log['odom_stamp']),
        _states(log, 'leader', log['image_stamp']),
        _states(log, 'follower', log['image_stamp'])) if estimates else RelativeErrors(
            np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0),
            np.zeros(0), 0.0)
    sent = (log['setpoint_time'] >= began) & (log['setpoint_time'] <= log['ended'])
    return LiveRecord(
        scenario, log, (log['image_stamp'] - epoch) * 1e-9,
        log['distance_time'][apart] - began, log['distance'][apart], errors,
        (errors.stamps - epoch) * 1e-9, np.isin(log['image_stamp'], errors.stamps),
        log['setpoint_time'][sent] - began, log['setpoint_acceleration'][sent],
        [(float(t) - began, str(s)) for t, s in zip(log['planner_time'], log['planner_state'])],
        [(t - began, m) for t, m in diagnostics])


def _recorded(path: Path) -> tuple[list[Any], list[tuple[float, Any]]]:
    """Return estimates, and diagnostics with the time of receipt, s on the monotonic clock."""
    neighbors, diagnostics = [], []
    with open_bag(path) as bag:
        for m in bag.messages():
            message = deserialize(m.data, m.msgtype)
            if m.topic == '/diagnostics':
                diagnostics.append((m.stamp_ns * 1e-9, message))
            else:
                neighbors.append(message)
    return neighbors, diagnostics


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def _states(log: dict[str, Any], name: str, stamps: Any) -> States:
    return States(stamps, *(log[f'{name}_{what}'] for what in (
        'position', 'quaternion', 'velocity')))
