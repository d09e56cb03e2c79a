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
The planner node: odometry and neighbours in, one acceleration command per tick out.

Subscribes ``odom`` and ``neighbors``, publishes ``command/trajectory`` at 10 Hz of ROS time while
engaged (service ``planner/engage``), and ``planner/state``. What it decides, and why, is in
``flock_follower.planner``.
"""

from __future__ import annotations

from dataclasses import fields
import math
import sys
import time
from typing import Any

from geometry_msgs.msg import Transform, Twist, Vector3
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from flock_follower.flocking import FlockingParams, Range
from flock_follower.geometry import Array, quaternion_from_yaw, yaw_from_quaternion
from flock_follower.guard import GuardParams
from flock_follower.nodes.conversions import (
    from_odometry,
    nanoseconds_to_stamp,
    ODOM_TWIST_FRAME,
    OdometryState,
    to_quaternion,
    to_vector3,
)
from flock_follower.nodes.diagnostics import ERROR, Problem, WARN
from flock_follower.nodes.parameters import Spec
from flock_follower.nodes.runtime import FlockNode, run
from flock_follower.planner import (
    Decision,
    Memory,
    NeighborEstimate,
    odometry_fault,
    OwnState,
    State,
    step,
)
from flock_follower.planner_params import PlannerParams, YAW_MODES

# Best effort takes what reliable and best-effort publishers send alike.
ODOM_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
NEIGHBORS_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
COMMAND_QOS = QoSProfile(depth=1)
STATE_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

TICK_TIMEOUT = 2.0  # s of wall time without a tick after which the node says so

FLIGHT = PlannerParams()
LAW_NAMES = tuple(f.name for f in fields(FlockingParams))
GUARD_NAMES = tuple(f.name for f in fields(GuardParams))


def number(name: str, description: str, **options: Any) -> Spec:
    """Return the declaration of a number of the core, with its default and range there."""
    owner: Any = (FLIGHT.law if name in LAW_NAMES else
                  FLIGHT.guarding if name in GUARD_NAMES else FLIGHT)
    valid: Range = owner.RANGES[name]
    return Spec(name, float(getattr(owner, name)), description, valid.unit, valid.low, valid.high,
                **options)


SPECS = [
    number('K', 'gain of the alignment of velocities'),
    number('sigma', 'distance within which the alignment is nearly constant'),
    number('beta', 'decay of the alignment with distance'),
    number('theta', 'steepness of separation and cohesion'),
    number('d0', 'lower bound of the squared distance; below d1'),
    number('d1', 'upper bound of the squared distance; above d0'),
    Spec('guard', FLIGHT.guard, 'hold the band where the law alone does not'),
    number('tau', 'guard: reaction time'),
    number('b', 'guard: deceleration with which an approach to an edge is stopped'),
    number('T_g', 'guard: time in which the rate of the distance is brought to its bound'),
    number('m', 'guard: margin to each edge, at most 0.24 of the width of the band'),
    number('a_max', 'largest acceleration, of the vector'),
    number('v_max', 'largest speed, of the vector'),
    number('period', 'time between commands', read_only=True),
    number('predict_timeout', 'age up to which a neighbor is extrapolated and followed'),
    number('coast_timeout', 'age of the last neighbor up to which to coast, then brake'),
    number('odom_timeout', 'age of the odometry up to which to command at all; from half of it '
           'on it brakes'),
    number('max_position_std', 'uncertainty of a neighbor above which it is not used'),
    number('max_velocity_std', 'uncertainty of a neighbor above which it is not used'),
    number('brake_time_constant', 'time in which braking reduces the speed to 37 %'),
    number('response_time', 'time in which the acceleration follows its command to 63 %'),
    number('handover_time', 'time over which a command is faded in when following begins'),
    Spec('altitude_hold', FLIGHT.altitude_hold,
         'hold the altitude of engaging; false: the law acts vertically too'),
    number('altitude_frequency', 'natural frequency of the altitude hold'),
    number('max_vertical_acceleration', 'largest acceleration of the altitude hold'),
    Spec('yaw_mode', FLIGHT.yaw_mode, 'face the nearest neighbor, or hold the yaw of engaging',
         choices=YAW_MODES),
    number('yaw_rate_max', 'largest rate at which the commanded yaw turns'),
    number('scan_rate', 'rate of turning to look for a neighbor; 0: none'),
    ODOM_TWIST_FRAME,
]


def build(values: dict[str, Any]) -> PlannerParams:
    """Return the parameters of the core; ValueError where they do not fit together."""
    own = {f.name: values[f.name] for f in fields(PlannerParams) if f.name in values}
    return PlannerParams(law=FlockingParams(**{name: values[name] for name in LAW_NAMES}),
                         guarding=GuardParams(**{name: values[name] for name in GUARD_NAMES}),
                         **own)


class Planner(FlockNode):
    """Feeds the messages that came to one step of the core per tick, and publishes its outcome."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('planner', **kwargs)
        self._settings = self.declare(SPECS, build)
        self._memory = Memory()
        self._engaged = False
        self._state: State | None = None
        self._reason = ''
        self._warnings: tuple[str, ...] = ()
        self._guarded = 0
        self._frame = ''
        self._own: OdometryState | None = None
        self._neighbors: list[OdometryState] = []
        self._epoch: int | None = None
        self._missed = 0
        self._limited = 0
        self._ticked = time.monotonic()

        self.subscribe(Odometry, 'odom', self._take_odom, ODOM_QOS)
        self.subscribe(Odometry, 'neighbors', self._take_neighbor, NEIGHBORS_QOS)
        self._commands = self.create_publisher(
            MultiDOFJointTrajectory, 'command/trajectory', COMMAND_QOS)
        self._states = self.create_publisher(String, 'planner/state', STATE_QOS)
        self._engage = self.create_service(SetBool, 'planner/engage', self._serve_engage)
        self.diagnostics.checks += [self._tick_problem, self._state_problem]
        self._timer = self.create_timer(self._settings.current.period, self._tick)

    def _take_odom(self, message: Odometry) -> None:
        self._own = from_odometry(message, self._settings.values['odom_twist_frame'])
        self._frame = self._own.frame

    def _take_neighbor(self, message: Odometry) -> None:
        if not self._frame:
            return  # nothing flies without odometry, and /diagnostics misses it already
        if message.header.frame_id != self._frame:
            raise ValueError(f'{message.child_frame_id} is in frame {message.header.frame_id!r}: '
                             f'must be in that of odom, {self._frame!r}')
        self._neighbors.append(from_odometry(message))

    def _serve_engage(self, request: SetBool.Request,
                      response: SetBool.Response) -> SetBool.Response:
        response.success = True
        if not request.data:
            self._engaged = False
            response.message = 'disengaged: no more commands'
        elif fault := self._engage_fault():
            response.success = False
            response.message = f'not engaged: {fault}'
            self.diagnostics.log(WARN, response.message, key='not engaged')
            return response
        else:
            self._engaged = True
            response.message = 'engaged' if self._memory.neighbors else (
                'engaged, but no neighbor is seen yet: braking to a hover until one is')
        self.get_logger().info(response.message)
        return response

    def _engage_fault(self) -> str:
        """Return why the follower may not be engaged now, or ''."""
        now = self._seconds(self.get_clock().now().nanoseconds)
        fault = odometry_fault(self._memory.own, now, self._settings.current)
        causes = [message for _, message in self.diagnostics.problems(time.monotonic())]
        return '; '.join([f'{fault} on {self.resolve_topic_name("odom")}', *causes]
                         ) if fault else ''

    def _seconds(self, nanoseconds: int) -> float:
        """Return seconds since the first tick: near zero, floats resolve a nanosecond."""
        return (nanoseconds - (self._epoch or 0)) * 1e-9

    def _tick(self) -> None:
        nanoseconds = self.get_clock().now().nanoseconds
        if self._epoch is None:
            self._epoch = nanoseconds
        now, params = self._seconds(nanoseconds), self._settings.current
        self._ticked = time.monotonic()
        self.diagnostics.rate('tick').tick(self._ticked)
        if self._memory.now is not None:
            self._missed += max(0, round((now - self._memory.now) / params.period) - 1)
        own = None if self._own is None else OwnState(
            self._seconds(self._own.stamp), self._own.position, self._own.velocity,
            yaw_from_quaternion(self._own.quaternion))
        neighbors = [NeighborEstimate(
            n.child, self._seconds(n.stamp), n.position, n.velocity, n.pose_covariance[:3, :3],
            n.velocity_covariance) for n in self._neighbors]
        self._own, self._neighbors = None, []
        self._memory, decision = step(self._memory, now, self._engaged, own, neighbors, params)
        if decision.acceleration is not None and decision.yaw is not None:
            # The stamp of what the command rests on, or the tick's where that is nothing.
            stamp = nanoseconds if decision.stamp is None else min(
                nanoseconds, self._epoch + round(decision.stamp * 1e9))
            self._command(decision.acceleration, decision.yaw, stamp, nanoseconds)
        self._tell(decision, now)

    def _command(self, acceleration: Array, yaw: float, stamp: int, tick: int) -> None:
        """Publish a command for the time of the tick: ``stamp`` plus ``time_from_start``."""
        nothing = Vector3(x=math.nan, y=math.nan, z=math.nan)
        message = MultiDOFJointTrajectory(joint_names=['base_link'])
        message.header.stamp = nanoseconds_to_stamp(stamp)
        message.header.frame_id = self._frame
        message.points = [MultiDOFJointTrajectoryPoint(
            transforms=[Transform(
                translation=nothing, rotation=to_quaternion(quaternion_from_yaw(yaw)))],
            velocities=[Twist(linear=nothing)],
            accelerations=[Twist(linear=to_vector3(acceleration))],
            time_from_start=Duration(nanoseconds=tick - stamp).to_msg())]
        self._commands.publish(message)
        self.diagnostics.rate('command').tick(self._ticked)

    def _tell(self, decision: Decision, now: float) -> None:
        """Publish the state where it changed, and keep what /diagnostics shows of the tick."""
        for rejection in decision.rejected:
            self.diagnostics.reject(*rejection)
        self._reason = decision.reason
        if decision.state is not self._state:
            self._state = decision.state
            self._states.publish(String(data=decision.state.value))
            why = f': {decision.reason}' if decision.reason else ''
            self.get_logger().info(f'{decision.state.value}{why}')
        self._warnings = decision.warnings
        self._limited += bool(decision.limits)
        self._guarded += 'separation' in decision.limits or 'cohesion' in decision.limits
        values = self.diagnostics.values
        values.update({'state': decision.state.value, 'reason': decision.reason,
                       'missed_ticks': self._missed, 'limited_commands': self._limited,
                       'guarded_commands': self._guarded, 'limits': decision.limits,
                       'warnings': '; '.join(decision.warnings)})
        if decision.acceleration is not None:
            values['acceleration_m_s2'] = f'{np.linalg.norm(decision.acceleration):.2f}'
        else:
            values.pop('acceleration_m_s2', None)
        for key in [key for key in values if key.endswith('_age_s')]:
            del values[key]
        if self._memory.own is not None:
            values['odom_age_s'] = f'{now - self._memory.own.stamp:.3f}'
        for name, n in self._memory.neighbors.items():
            values[f'{name}_age_s'] = f'{now - n.stamp:.3f}'

    def _tick_problem(self, now: float) -> Problem | None:
        silent = now - self._ticked
        if silent <= TICK_TIMEOUT:
            return None
        clock = 'is /clock published?' if self.get_parameter('use_sim_time').value else (
            'the executor is blocked')
        return ERROR, f'no tick for {silent:.0f} s: {clock}'

    def _state_problem(self, now: float) -> Problem | None:
        if self._state in (State.SEARCH, State.COAST, State.HOLD):
            return WARN, f'{self._state.value}: {self._reason}'
        if self._warnings:
            return WARN, '; '.join(self._warnings)
        return None


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Planner, args)


if __name__ == '__main__':
    sys.exit(main())
