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
Flights in lock step: leader, air, vehicle and sensors around the real followers.

No clock, no rendering, no messages: the runs fly ``follower.Follower``, the object that the
nodes drive part by part: planner, permission and setpoint gate. The world around them advances by
COURSE_STEP for many runs at once. The neighbor filters of perception are fed at 30 Hz with
positions
whose noise has the covariance given with them; a marker is seen if it is in the field of view and
not too oblique, with no vehicle in between.

============  ========  =======================================================
part          rate, Hz  remark
============  ========  =======================================================
vehicle, air  120       first the vehicle moves, then everything looks
odometry      60        arrives ``latency`` later; messages arrive, too
images        30        estimates arrive ``latency`` later
planner       10        engaged at ENGAGE_TIME, unless an operation does it
control       20        the vehicle obeys ``delay`` later, with its lags
============  ========  =======================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

from flock_desk.closed_loop.camera_views import CameraViews
from flock_desk.closed_loop.follower import SimulatedFollower
from flock_desk.closed_loop.metrics import Flights, FlightsLog
from flock_desk.closed_loop.world import GATE_STEPS, ODOMETRY_STEPS, World
from flock_desk.scenarios.courses import COURSE_STEP
from flock_desk.scenarios.scenario import ENGAGE_TIME, Scenario
from flock_desk.sensors.sensing import PerceptionNoise, Radio
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import matrix_to_quaternion, quaternion_from_yaw, Transform
from flock_follower.messages import OdometryState
from flock_follower.planner.sight import FieldOfView

PLANNER_STEPS = 12


def fly(scenario: Scenario, runs: Sequence[int], guard: bool,
        law: type[FlockingParams] = FlockingParams) -> Flights:
    """
    Fly some runs of a scenario and return their results.

    :param runs: their numbers, which seed everything random in them.
    :param guard: whether the planner's guard is on.
    :param law: the law, or a controller in its place: see ``controllers``.
    """
    world, noise = World(scenario, runs), _noise(scenario)
    lookout = CameraViews(world, noise)
    followers = _followers(world, guard, noise, law)
    flock = scenario.company
    radio: Radio[OdometryState] = Radio(
        flock.followers, flock.delay, flock.loss, world.random('radio'))
    count = round(scenario.duration / COURSE_STEP)
    log = FlightsLog(world, lookout)
    for k in range(1, count + 1):
        now = k * COURSE_STEP
        world.advance(k)
        lookout.look(k)
        log.step()
        if k % ODOMETRY_STEPS == 0:
            for follower, own in zip(followers, world.odometry(now)):
                follower.sense(now, own)
            if scenario.flight.relative_flight:
                attitudes = world.attitudes()
                lookout.look_alone(k, [follower.lean(now, matrix_to_quaternion(rotation))
                                       for follower, rotation in zip(followers, attitudes)],
                                   attitudes)
            for row, message in radio.arrived(now):
                followers[row].receive(now, message)
        if k % PLANNER_STEPS == 0:
            for row, (follower, (looked, seen)) in enumerate(zip(
                    followers, lookout.arrived(now))):
                follower.plan(now, looked, seen)
                radio.send(now, row, follower.outbox)
                follower.outbox = []
            if now >= ENGAGE_TIME - 1e-9:
                log.tick(now, followers)
        if flock.fails is not None and now >= flock.fails.at:
            for follower in followers[flock.fails.follower - 1::flock.followers]:
                follower.fail(now)
        if k % GATE_STEPS == GATE_STEPS // 2:
            world.obey([follower.obey(now, *known)
                        for follower, known in zip(followers, world.flown(now))])
    return log.flights()


def _noise(scenario: Scenario) -> PerceptionNoise:
    """Return the errors of perception, and the field of view of a scenario's cameras."""
    flock, usual = scenario.flock, PerceptionNoise()
    if flock is None:
        return usual
    return replace(usual, half_width=flock.half_width, farthest=flock.farthest,
                   half_height=flock.half_width * usual.half_height / usual.half_width)


def _followers(world: World, guard: bool, noise: PerceptionNoise,
               law: type[FlockingParams]) -> list[SimulatedFollower]:
    """Return the follower of every row."""
    scenario, flock = world.scenario, world.scenario.company
    aside, up = math.atan(noise.half_width), math.atan(noise.half_height)
    # The planner keeps neighbors in the view ahead, unless cameras look to all sides.
    ahead = 'front' in flock.cameras and not flock.all_round
    view = (FieldOfView(aside, aside, up, up),) if ahead else ()
    followers = []
    for (_, number), start, yaw in zip(world.rows, world.starts, world.yaws.tolist()):
        name = flock.names[number]
        frame, T_world_odom = ('odom', Transform()) if scenario.flock is None else (
            f'{name}/odom', Transform.from_quaternion(
                start * [1.0, 1.0, 0.0], quaternion_from_yaw(yaw)))
        followers.append(SimulatedFollower(
            scenario, guard, frame, T_world_odom.inverse(), start, view, name, law))
    return followers
