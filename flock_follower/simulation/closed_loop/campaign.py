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
Flights in lock step: leader, air, vehicle and sensors around the real follower.

No clock, no rendering, no messages: what is flown is ``pipeline.Follower``, the object that the
nodes drive part by part: planner, permission and setpoint gate. The world around them advances by
STEP for many runs at once. The neighbour filter is that of ``sensing``, fed at 30 Hz with
positions whose noise has the covariance it is told; the marker, on the leader's tail, is seen
where it is in the field of view and not too oblique.

============  ========  =======================================================
what          rate, Hz  remark
============  ========  =======================================================
vehicle, air  120       first the vehicle moves, then everything looks
odometry      60        arrives ``latency`` later
images        30        estimates arrive ``latency`` later
planner       10        engaged at ENGAGED, where no operation says otherwise
control       20        the vehicle obeys ``delay`` later, with its lags
============  ========  =======================================================
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from flock_follower.geometry import Array, quaternion_from_yaw
from flock_follower.mavlink.autopilots import DIALECTS
from flock_follower.mavlink.gate_limits import GateLimits
from flock_follower.mavlink.setpoint_control import SetpointControl
from flock_follower.mavlink.setpoint_gate import SetpointGate
from flock_follower.messages import AccelerationState, OdometryState, to_nanoseconds
from flock_follower.pipeline.follower import Follower
from flock_follower.pipeline.outcomes import ControlCycle, ImageOutcome, Tick
from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.sight import FieldOfView
from flock_follower.planner.state import State
from flock_follower.planner.step import Decision
from flock_follower.simulation.closed_loop.operations import OperatedVehicle
from flock_follower.simulation.closed_loop.world import GATE_STEPS, ODOMETRY_STEPS, World
from flock_follower.simulation.scenarios.leader import STEP
from flock_follower.simulation.scenarios.scenario import ENGAGED, Scenario
from flock_follower.simulation.sensors.sensing import PerceptionNoise

PLANNER_STEPS = 12
STATES = tuple(State)
_AFTER = 1  # ns by which ticks come after what arrives at their moment
_ZERO, _FORWARD, _LEVEL = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.eye(3)
_UNKNOWN = np.zeros((6, 6))


@dataclass(frozen=True)
class Flights:
    """
    What n runs of a scenario did, from engaging on, every planner tick (k of them).

    Everything is true, not estimated; vectors are ENU.
    """

    scenario: Scenario
    times: Array
    """(k,), s."""
    leader: Array
    """(n, k, 3), m."""
    follower: Array
    """(n, k, 3), m."""
    leader_velocity: Array
    """(n, k, 3), m/s."""
    velocity: Array
    """(n, k, 3), m/s."""
    nearest: Array
    """(n, k), least distance up to the next tick, m."""
    farthest: Array
    """(n, k), greatest distance up to the next tick, m."""
    outside: Array
    """(n, k), time out of the band up to the next tick, s."""
    command: Array
    """(n, k, 3), commanded acceleration, m/s^2; NaN where there was none."""
    state: Any
    """(n, k), index into ``STATES``."""
    guarded: Any
    """(n, k), whether the guard altered the command."""
    seen: Any
    """(n, k), whether an image since the last tick showed the leader."""
    in_sight: Any
    """(n, k), whether the newest image would, were nothing in the way."""
    obeying: Any
    """(n, k), whether the vehicle flies setpoints."""
    unasked: Array
    """(n, k), setpoints that have left without anybody having called offboard."""


def fly(scenario: Scenario, runs: Sequence[int], guard: bool,
        noise: PerceptionNoise | None = None,
        progress: Callable[[float], None] | None = None) -> Flights:
    """
    Fly some runs of a scenario and return what they did.

    :param runs: their numbers, which seed everything random in them.
    :param guard: whether the planner's guard is on.
    :param progress: called with the share that is done, now and then.
    """
    world = World(scenario, runs, noise or PerceptionNoise())
    aside, up = math.atan(world.noise.half_width), math.atan(world.noise.half_height)
    view = FieldOfView(aside, aside, up, up)
    followers = [_SimulatedFollower(scenario, guard, run, view) for run in runs]
    count = round(scenario.duration / STEP)
    record = _Record(len(runs))
    for k in range(1, count + 1):
        now = k * STEP
        world.advance(k)
        record.distances(world.distance, scenario)
        if k % ODOMETRY_STEPS == 0:
            for follower, own in zip(followers, world.odometry(now)):
                follower.sense(now, own)
        if k % PLANNER_STEPS == 0:
            for follower, seen, looked in zip(
                    followers, world.estimates(now), world.looked(now)):
                follower.plan(now, seen, looked)
            if now >= ENGAGED - 1e-9:
                record.tick(now, world, followers)
            if progress is not None and k % (20 * PLANNER_STEPS) == 0:
                progress(k / count)
        if k % GATE_STEPS == GATE_STEPS // 2:
            world.obey([follower.obey(now, *known) for follower, known in zip(
                followers, world.flown())])
    return record.flights(scenario)


class _SimulatedFollower:
    """One run's follower, and who operates it; listens to what the follower does."""

    def __init__(self, scenario: Scenario, guard: bool, run: int, view: FieldOfView) -> None:
        limits = GateLimits(a_max=scenario.flight.a_max, v_max=scenario.flight.v_max)
        autopilot = tuple(DIALECTS)[run % len(DIALECTS)] if scenario.operations else 'px4'

        def new_control() -> SetpointControl:
            return SetpointControl(SetpointGate(limits),
                                   DIALECTS[autopilot].setpoints_end_takeoff)
        planner = PlannerLoop()
        planner.view, planner.ground = view, 0.0
        # Ticks come after everything of their moment, cycles in the middle between two ticks.
        self.follower = Follower(
            planner, scenario.flight.planner(guard), new_control(), self,
            cycle_phase=GATE_STEPS // 2 * STEP)
        self.follower.advance(_AFTER)
        self.vehicle = OperatedVehicle(scenario, autopilot, self.follower, new_control)
        self.decision = Decision(State.IDLE)
        self._known: OwnState | None = None
        self._now = 0.0

    def sense(self, now: float, own: OwnState | None) -> None:
        """Take the newest odometry there is."""
        if own is None or own is self._known:
            return
        self._known = own
        self.follower.odometry(to_nanoseconds(now), OdometryState(
            to_nanoseconds(own.stamp), 'odom', 'base_link', own.position,
            quaternion_from_yaw(own.yaw), own.velocity, _ZERO, _UNKNOWN, _UNKNOWN, _LEVEL))

    def plan(self, now: float, seen: list[NeighborEstimate], looked: float | None) -> None:
        """Tick with the newest estimates; ``looked`` is the stamp of the newest image, s."""
        if looked is not None:
            self.follower.frame(to_nanoseconds(now), to_nanoseconds(looked))
        for n in seen:
            pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
            pose[:3, :3], twist[:3, :3] = n.position_covariance, n.velocity_covariance
            self.follower.neighbor(to_nanoseconds(now), OdometryState(
                to_nanoseconds(n.stamp), 'odom', n.name, n.position, _FORWARD, n.velocity, _ZERO,
                pose, twist, _LEVEL), None if n.acceleration is None else AccelerationState(
                    to_nanoseconds(n.stamp), n.name, n.acceleration))
        self.follower.advance(to_nanoseconds(now) + _AFTER)

    def obey(self, now: float, position: Array, velocity: Array, yaw: float,
             estimate: Array) -> tuple[Array, float | None]:
        """Return the acceleration and yaw that the vehicle flies from now on."""
        self._now = now
        self.follower.estimate(to_nanoseconds(now), estimate)
        self.follower.advance(to_nanoseconds(now) + _AFTER)
        return self.vehicle.step(now, position, velocity, yaw)

    def publish(self, topic: str, msgtype: str, time: int, message: Any) -> None:
        pass

    def odometry(self, state: OdometryState) -> None:
        pass

    def image(self, outcome: ImageOutcome) -> None:
        pass

    def words(self, time: int, words: list[OdometryState]) -> None:
        pass

    def rejected(self, reason: str, detail: str) -> None:
        pass

    def tick(self, tick: Tick) -> None:
        self.decision = tick.decision

    def cycle(self, cycle: ControlCycle) -> None:
        self.vehicle.send(cycle.setpoint, self._now)


class _Record:
    """Collects what the flights did."""

    def __init__(self, count: int) -> None:
        self._rows: dict[str, list[Any]] = {name: [] for name in (
            'times', 'leader', 'follower', 'leader_velocity', 'velocity', 'nearest', 'farthest',
            'outside', 'command', 'state', 'guarded', 'seen', 'in_sight', 'obeying',
            'unasked')}
        self._count = count
        self._nearest: Array = np.zeros(count)
        self._farthest: Array = np.zeros(count)
        self._outside: Array = np.zeros(count)

    def distances(self, distance: Array, scenario: Scenario) -> None:
        self._nearest = np.minimum(self._nearest, distance)
        self._farthest = np.maximum(self._farthest, distance)
        out = (distance ** 2 <= scenario.flight.d0) | (distance ** 2 >= scenario.flight.d1)
        self._outside = self._outside + STEP * out

    def tick(self, now: float, world: World, followers: list[_SimulatedFollower]) -> None:
        self._close()
        decisions = [follower.decision for follower in followers]
        add = {
            'times': now, 'leader': world.leader, 'follower': world.vehicle.position,
            'leader_velocity': world.leader_velocity, 'velocity': world.vehicle.velocity,
            'command': np.array([np.full(3, np.nan) if d.acceleration is None else d.acceleration
                                 for d in decisions]),
            'state': np.array([STATES.index(d.state) for d in decisions]),
            'guarded': np.array([d.guarded for d in decisions]),
            'seen': world.seen, 'in_sight': world.in_sight,
            'obeying': np.array([f.vehicle.obeying_since is not None for f in followers]),
            'unasked': np.array([f.vehicle.unasked for f in followers])}
        for name, value in add.items():
            self._rows[name].append(value)
        world.seen = np.zeros(self._count, dtype=bool)
        self._nearest = self._farthest = world.distance
        self._outside = np.zeros(self._count)

    def _close(self) -> None:
        """End the interval since the last tick; what was before the first does not count."""
        if self._rows['times']:
            for name, value in (('nearest', self._nearest), ('farthest', self._farthest),
                                ('outside', self._outside)):
                self._rows[name].append(value)

    def flights(self, scenario: Scenario) -> Flights:
        self._close()
        times = np.array(self._rows.pop('times'))
        return Flights(scenario, times, **{
            name: np.stack(rows, axis=1) for name, rows in self._rows.items()})
