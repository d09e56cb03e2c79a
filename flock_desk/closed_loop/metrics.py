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
Simulated flights since ``engage``: their record at every planner tick, and their figures.

All values are true, not estimated. Each array has one row per follower, see ``world``. Distances
are to the leader; in a flock to the neighbors with an edge, or before the first edge to the
vehicle ahead. ``of_runs`` combines the rows of a flock's followers run by run: the worst value for
safety and for shares of runs, else the mean. A follower that fails is left out; its effect on the
others is in their figures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np

from flock_desk.closed_loop.camera_views import CameraViews
from flock_desk.closed_loop.follower import SimulatedFollower
from flock_desk.closed_loop.world import Moment, World
from flock_desk.scenarios.courses import COURSE_STEP
from flock_desk.scenarios.flock import places
from flock_desk.scenarios.scenario import Scenario
from flock_follower.geometry import Array
from flock_follower.planner.bound_keeping import REASONS
from flock_follower.planner.modes import State
from flock_follower.planner.scene import Decision

STATES = tuple(State)


def is_guarded(decision: Decision) -> bool:
    """Return whether the guard altered the command."""
    return any(reason in decision.limits for reason in REASONS)


@dataclass(frozen=True)
class Flights:
    """
    The motion of n rows of a scenario, from engaging on, at every planner tick (k of them).

    All values are ground truth; vectors are ENU. Each row is a follower: see ``world``.
    """

    scenario: Scenario
    times: Array
    """(k,), s."""
    leader: Array
    """(n, k, 3), the nearest vehicle that each follows, m."""
    follower: Array
    """(n, k, 3), m."""
    leader_velocity: Array
    """(n, k, 3), m/s."""
    velocity: Array
    """(n, k, 3), m/s."""
    nearest: Array
    """(n, k), least distance to any vehicle up to the next tick, m."""
    farthest: Array
    """(n, k), greatest distance to a followed vehicle up to the next tick, m."""
    outside: Array
    """(n, k), time out of the band up to the next tick, s; mean over the followed vehicles."""
    command: Array
    """(n, k, 3), commanded acceleration, m/s^2; NaN without one."""
    state: Any
    """(n, k), index into ``STATES``."""
    guarded: Any
    """(n, k), whether the guard altered the command."""
    seen: Any
    """(n, k), whether an image since the last tick showed a followed vehicle."""
    in_sight: Any
    """(n, k), whether the newest image could show one; outages and missed detections do not
    count."""
    obeying: Any
    """(n, k), whether the vehicle flies setpoints."""
    unasked: Array
    """(n, k), setpoints sent without an offboard call."""
    shown: Any = None
    """(n, k), number of other vehicles in the images since the last tick."""
    edges: Any = None
    """(n, k), how many it follows."""
    positions: Any = None
    """(n / m, k, m + 1, 3), of all vehicles, the leader first, m."""


class FlightsLog:
    """Records the flights in a world."""

    def __init__(self, world: World, lookout: CameraViews) -> None:
        self._world, self._lookout = world, lookout
        self._times: list[float] = []
        self._ticks: list[dict[str, Any]] = []
        """The arrays of ``Flights`` at each tick, one value or vector per row."""
        self._moments: list[Moment] = []
        """Those since the newest tick."""
        rows, m = len(world.starts), len(world.others)
        flock = world.scenario.flock
        self._names = world.scenario.company.names
        self._others = np.tile(world.others, (rows // m, 1))
        ahead = [0] if flock is None else [place.ahead for place in places(flock)]
        self._edges: Any = self._others == np.tile(ahead, rows // m)[:, None]

    def step(self) -> None:
        """Take the places after a step; those before the first tick do not count."""
        if self._ticks:
            self._moments.append(Moment.of(self._world))

    def _take_distances(self) -> None:
        """Take the distances since the newest tick."""
        if not self._moments:
            return
        distance, last = self._world.distances_at(self._moments), self._ticks[-1]
        self._moments = []
        band = self._world.scenario.flight
        farthest, edges = self._edge_distances(distance)
        last['nearest'] = np.minimum(last['nearest'], distance.min(axis=(0, 2)))
        last['farthest'] = np.maximum(last['farthest'], farthest.max(axis=0))
        out = edges & ((distance ** 2 <= band.d0) | (distance ** 2 >= band.d1))
        many = edges.sum(axis=2)
        # A follower without a vehicle to follow is out of the band.
        share = np.where(many > 0, out.sum(axis=2) / np.maximum(many, 1), 1.0)
        last['outside'] = np.cumsum(COURSE_STEP * share, axis=0)[-1]

    def _edge_distances(self, distance: Array) -> tuple[Array, Any]:
        """Return the greatest distance (..., n), and the edges (..., n, m), to those present."""
        edges = self._edges & np.isfinite(distance)
        return np.where(edges, distance, 0.0).max(axis=-1), edges

    def tick(self, now: float, followers: Sequence[SimulatedFollower]) -> None:
        """Take the outcome of a tick of the planners."""
        self._take_distances()
        world, rows, lookout = self._world, np.arange(len(followers)), self._lookout
        decisions = [follower.decision for follower in followers]
        for row, decision in enumerate(decisions):
            if world.scenario.flock is not None and decision.edges:
                self._edges[row] = [self._names[v] in decision.edges for v in self._others[row]]
        distance = world.distances
        farthest, edges = self._edge_distances(distance)
        # The nearest that it follows.
        met = self._others[rows, np.where(edges, distance, np.inf).argmin(axis=1)]
        runs = rows // len(world.others)
        self._times.append(now)
        self._ticks.append({
            'leader': world.positions[runs, met], 'follower': world.vehicle.position,
            'leader_velocity': world.velocities[runs, met], 'velocity': world.vehicle.velocity,
            'nearest': distance.min(axis=1), 'farthest': farthest,
            'outside': np.zeros(len(followers)),
            'command': np.array([np.full(3, np.nan) if d.acceleration is None else d.acceleration
                                 for d in decisions]),
            'state': np.array([STATES.index(d.state) for d in decisions]),
            'guarded': np.array([is_guarded(d) for d in decisions]),
            'seen': (lookout.seen & edges).any(axis=1),
            'in_sight': (lookout.in_sight & edges).any(axis=1),
            'obeying': np.array([f.obeying for f in followers]),
            'unasked': np.array([f.unasked for f in followers]),
            'shown': lookout.seen.sum(axis=1), 'edges': edges.sum(axis=1),
            'positions': world.positions})
        lookout.seen = np.zeros_like(lookout.seen)

    def flights(self) -> Flights:
        """Return the collected figures."""
        self._take_distances()
        return Flights(self._world.scenario, np.array(self._times), **{
            name: np.stack([tick[name] for tick in self._ticks], axis=1)
            for name in self._ticks[0]})


FIRST_TICKS = 10  # 1 s, in which a handover must not change the altitude
TOO_FAST = 1.05  # times v_max: runs that are ever faster count as too fast
SETTLED = 20.0  # s at the end of a flight over which its final distance is averaged
LOST_AFTER = 5.0  # s without following at the end of a flight, and it counts as lost
STRAYED = 1.25  # times the far edge of the band: a follower without a vehicle in it is lost

Measures = dict[str, Array]
"""Figures by name, (n,) each."""
Reduction = Callable[..., Any]


class Figure(NamedTuple):
    """A figure of a scenario: its measure, and how it is combined over runs and over followers."""

    measure: str
    over_runs: Reduction
    over_followers: Reduction = np.mean


def _rms(values: Array, axis: int | None = None) -> Any:
    return np.sqrt(np.mean(values ** 2, axis=axis))


#: By key of flights.json; the last ones are of flocks.
FIGURES = {
    'in_band': Figure('in_band', np.mean, np.min),  # sqrt(d0) < r < sqrt(d1) throughout
    'min_separation_m': Figure('min_separation', np.min, np.min),
    'max_separation_m': Figure('max_separation', np.max, np.max),
    'out_of_band_s': Figure('out_of_band', np.mean, np.max),
    'time_in_band': Figure('time_in_band', np.mean),  # a share, as the next
    'time_in_sight': Figure('in_sight', np.mean),  # the marker in view, from its front
    # In whole ticks; what hides the marker does not count.
    'longest_out_of_sight_s': Figure('out_of_sight', np.max, np.max),
    'guard_active': Figure('guard_active', np.mean),  # share of ticks with an altered command
    'jerk_m_s3': Figure('jerk', np.mean),  # RMS of the command's change from tick to tick
    'horizontal_jerk_m_s3': Figure('horizontal_jerk', np.mean),
    'tracking_error_m': Figure('tracking_error', np.mean),  # RMS of r - sqrt((d0 + d1) / 2)
    'velocity_error_m_s': Figure('velocity_error', np.mean),  # RMS of |v_F - v_L|
    # Without an image that showed the leader, in whole ticks.
    'longest_detection_gap_s': Figure('detection_gap', np.max, np.max),
    'final_distance_m': Figure('final_distance', np.mean),
    'final_distance_lowest_m': Figure('final_distance', np.min),
    'final_distance_highest_m': Figure('final_distance', np.max),
    # From here on while the vehicle flies setpoints.
    'max_speed_m_s': Figure('max_speed', np.max, np.max),
    'max_speed_share': Figure('speed_share', np.max, np.max),  # of v_max
    'too_fast': Figure('speed_share', lambda share: (share > TOO_FAST).mean(), np.max),
    # In the first second; afterwards; and the change of altitude in the whole time.
    'handover_altitude_m': Figure('handover_altitude', np.max, np.max),
    'handover_climb_m_s': Figure('handover_climb', np.max, np.max),
    'altitude_change_m': Figure('altitude_change', np.max, np.max),
    'unasked_setpoints': Figure('unasked_setpoints', np.sum, np.sum),  # without an offboard call
    # Followers that do not follow at the end, or that no chain of near ones links to the leader.
    'lost_for_good': Figure('lost', np.sum),
    'rms_acceleration_m_s2': Figure('rms_acceleration', _rms, _rms),
    'time_tracking': Figure('tracking', np.mean),  # share in TRACK
    'edges': Figure('edges', np.mean),  # how many each follows
    'neighbors_in_sight': Figure('shown', np.mean),  # of all others, each
}


def measure(flights: Flights) -> Measures:
    """Return the measures of every row."""
    band = flights.scenario.flight
    distance = np.linalg.norm(flights.leader - flights.follower, axis=2)
    period = float(flights.times[1] - flights.times[0])
    middle = math.sqrt((band.d0 + band.d1) / 2.0)
    handovers = np.array([_handovers(*run) for run in zip(
        flights.obeying, flights.follower[:, :, 2], flights.velocity[:, :, 2])])
    fastest = (np.linalg.norm(flights.velocity, axis=2) * flights.obeying).max(axis=1)
    steps, level = (np.linalg.norm(np.diff(flights.command[..., :axes], axis=1), axis=2) / period
                    for axes in (3, 2))
    outside = flights.outside.sum(axis=1)
    return {
        'in_band': (outside == 0.0).astype(float),
        'min_separation': flights.nearest.min(axis=1),
        'max_separation': flights.farthest.max(axis=1),
        'out_of_band': outside,
        'time_in_band': 1.0 - outside / (period * len(flights.times)),
        'guard_active': flights.guarded.mean(axis=1),
        'jerk': np.sqrt(np.nanmean(steps ** 2, axis=1)),
        'horizontal_jerk': np.sqrt(np.nanmean(level ** 2, axis=1)),
        'tracking_error': _rms(distance - middle, axis=1),
        'velocity_error': _rms(np.linalg.norm(
            flights.velocity - flights.leader_velocity, axis=2), axis=1),
        'in_sight': flights.in_sight.mean(axis=1),
        'out_of_sight': np.array([period * _longest_run(~seen) for seen in flights.in_sight]),
        'detection_gap': np.array([period * _longest_run(~seen) for seen in flights.seen]),
        'final_distance': distance[:, flights.times > flights.times[-1] - SETTLED].mean(axis=1),
        'max_speed': fastest, 'speed_share': fastest / band.v_max,
        'handover_altitude': handovers[:, 0], 'handover_climb': handovers[:, 1],
        'altitude_change': handovers[:, 2],
        'unasked_setpoints': flights.unasked[:, -1].astype(float)}


def of_runs(rows: Measures, flights: Flights) -> Measures:
    """Return the measures of the runs of a flock: of its followers combined, and of the flock."""
    kept = _find_counted(flights)
    by_run = len(flights.positions), -1
    tracking = flights.state == STATES.index(State.TRACK)
    rows = {**rows, 'tracking': tracking.mean(axis=1), 'edges': flights.edges.mean(axis=1),
            'shown': flights.shown.mean(axis=1),
            'rms_acceleration': np.sqrt(np.nanmean(np.sum(flights.command ** 2, axis=2), axis=1))}
    reductions = {figure.measure: figure.over_followers for figure in FIGURES.values()}
    runs = {name: reductions[name](values.reshape(by_run)[:, kept], axis=1)
            for name, values in rows.items()}
    late = flights.times > flights.times[-1] - LOST_AFTER
    strayed = np.stack([_find_unconnected(positions[-1], flights)
                        for positions in flights.positions])
    lost = ~tracking[:, late].any(axis=1).reshape(by_run) | strayed
    runs['lost'] = lost[:, kept].sum(axis=1).astype(float)
    return runs


def concatenate_measures(parts: Sequence[Measures]) -> Measures:
    """Return the measures of all runs of several parts, in their order."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def summary(runs: Measures) -> dict[str, float]:
    """Return the figures of a scenario: extremes if safety asks for them, else means."""
    return {'runs': len(runs['in_band']), **{
        key: float(figure.over_runs(runs[figure.measure]))
        for key, figure in FIGURES.items() if figure.measure in runs}}


def band_exits(flights: Flights) -> list[tuple[int, str]]:
    """Return each row that left the band, with time and circumstances of its first exit."""
    exits, period = [], float(flights.times[1] - flights.times[0])
    for row in np.flatnonzero(flights.outside.sum(axis=1) > 0.0).tolist():
        k = int(np.flatnonzero(flights.outside[row] > 0.0)[0])
        near = flights.nearest[row, k] ** 2 <= flights.scenario.flight.d0
        distance = (flights.nearest if near else flights.farthest)[row, k]
        unseen = period * _longest_run(~flights.seen[row, :k + 1], at_the_end=True)
        exits.append((row, f'at {flights.times[k]:.1f} s too {"near" if near else "far"}, '
                           f'{distance:.2f} m; {STATES[int(flights.state[row, k])].value}, leader '
                           + (f'not seen for {unseen:.1f} s' if unseen else 'seen')))
    return exits


def _handovers(obeying: Any, height: Array, climb: Array) -> tuple[float, float, float]:
    """
    Return the greatest values over all handovers of a run; the inputs are (k,) each.

    The values are the change of height in the first second, the vertical speed after it, and the
    change of height until the vehicle no longer flies setpoints.
    """
    early = late = change = 0.0
    for begin, end in _stretches(obeying):
        changes = np.abs(height[begin:end] - height[begin])
        early = max(early, float(changes[:FIRST_TICKS].max()))
        late = max(late, float(np.abs(climb[begin + FIRST_TICKS:end]).max(initial=0.0)))
        change = max(change, float(changes.max()))
    return early, late, change


def _stretches(values: Any) -> Any:
    """Return the first index and the last index + 1, (m, 2), of each stretch of True."""
    edges = np.diff(np.concatenate([[False], values, [False]]).astype(int))
    return np.flatnonzero(edges).reshape(-1, 2)


def _longest_run(missing: Array, at_the_end: bool = False) -> int:
    """Return the greatest number of consecutive True values, anywhere or at the end."""
    lengths = np.diff(_stretches(missing)).ravel()
    if at_the_end:
        return int(lengths[-1]) if missing[-1] else 0
    return int(np.max(lengths, initial=0))


def _find_counted(flights: Flights) -> Any:
    """Return which followers count (m,): all but the one that fails."""
    flock = flights.scenario.company
    return np.array([flock.fails is None or flock.fails.follower != number
                     for number in range(1, flock.followers + 1)])


def _find_unconnected(positions: Array, flights: Flights) -> Any:
    """Return which followers (m,) are not connected to the leader; positions (m + 1, 3), m."""
    apart = np.linalg.norm(positions[:, None] - positions, axis=2)
    near = apart < STRAYED * math.sqrt(flights.scenario.flight.d1)
    near &= np.append(True, _find_counted(flights))  # a failed follower leads no other
    reached = np.arange(len(positions)) == 0
    for _ in positions:
        reached = reached | near[:, reached].any(axis=1)
    return ~reached[1:]
