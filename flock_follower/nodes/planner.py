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
The planner node: odometry and neighbors in, one acceleration command per tick out.

The node subscribes ``odom``, ``neighbors`` and ``neighbors/frames``, and if they are published
``camera_info``, ``neighbors/acceleration``, ``neighbors/heard`` (neighbor states received from
other vehicles) and ``mavlink_bridge/armed_at``. It publishes ``command/trajectory`` at 10 Hz (on a
steady clock; with ``use_sim_time`` on ``/clock``), ``planner/state``, and ``planner/distance`` to
the faced neighbor, else to the nearest (``frame_id`` is the neighbor's name).

The node commands while it is engaged (service ``planner/engage``) and ``mavlink_bridge/state``
reports that the bridge flies the commands; with ``require_bridge`` false, while it is engaged.
The commands end if a pilot takes over, and after ``resume_timeout`` without a neighbor, until
``planner/engage`` is called again. ``flock_follower.planner.step`` makes the decisions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
import math
import os
import sys
import time
from typing import Any

from geometry_msgs.msg import AccelWithCovarianceStamped, PointStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Range
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_follower.messages import MOTION_TOPIC, OdometryState, stamp_to_nanoseconds
from flock_follower.messages.accelerations import from_acceleration
from flock_follower.messages.bridge_reading import BridgeState
from flock_follower.messages.bridge_state import ARMED_AT_TOPIC
from flock_follower.messages.bridge_state import TOPIC as BRIDGE_TOPIC
from flock_follower.messages.command_writer import trajectory
from flock_follower.messages.state_reader import from_odometry
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp
from flock_follower.nodes.support.diagnostics import ERROR, Problem, WARN
from flock_follower.nodes.support.even_clock import EvenClock
from flock_follower.nodes.support.inputs import best_effort, LATCHED_QOS, OwnOdometry
from flock_follower.nodes.support.middleware import avoid_shared_memory
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.remote_parameters import WatchedParameters
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.nodes.support.sole_publisher import SolePublisher
from flock_follower.parameters.cameras import cameras
from flock_follower.parameters.settings import find_unsafe_settings
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.modes import State
from flock_follower.planner.parameter_table import PLANNER as SPECS
from flock_follower.planner.parameter_table import planner_params
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.step import Decision

TICK_TIMEOUT = 2.0  # s of wall time without a tick after which the node reports it
FLOWN_TIME = 60.0  # s after the last flying tick in which a change of the bridge is reported


class Planner(FlockNode):
    """Feeds the planner's loop from topics and a timer, and publishes its commands."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('planner', **kwargs)
        self._start: PlannerParams | None = None
        self._settings = self.declare(SPECS, self._build, self._flying)
        values = self._settings.values
        for judgment in find_unsafe_settings(values):
            self.get_logger().warning(str(judgment))
        self._loop = PlannerLoop(values['require_bridge'])
        self._bridge: BridgeState | None = None
        self._bridge_received = -math.inf
        self._flown = -math.inf  # when the vehicle flew the commands last, monotonic, s
        configured = cameras(values)
        self._cameras = {camera.name: camera for camera in configured}
        self._calibrations: dict[str, tuple[Any, ...]] = {}
        self._decision = Decision(State.IDLE, reason='not engaged')
        self._reported: tuple[State, bool] | None = None
        self._ticked = time.monotonic()
        self._even_clock = EvenClock(self)
        self._own = OwnOdometry(self, values, self._take_odom, self._even_clock)

        # All inputs wait for the tick: odometry first, because nothing is taken without it, and
        # accelerations before their states.
        self._polls = [
            self.poll(Odometry, MOTION_TOPIC, self._take_motion, best_effort(200),
                      required=False),
            self._own.poll,
            self._poll_states(AccelWithCovarianceStamped, 'neighbors/acceleration',
                              from_acceleration, self._loop.take_acceleration, 100),
            # Images may have no leader in them: a silent publisher is no fault.
            self._poll_states(Odometry, 'neighbors', from_odometry, self._loop.take_neighbor, 100,
                              required=True, sporadic=True),
            self._poll_states(Odometry, 'neighbors/heard', from_odometry,
                              partial(self._loop.take_neighbor, received=True), 50),
            *(self.poll(CameraInfo, camera.camera_info,
                        partial(self._take_camera_info, camera=camera.name), best_effort(),
                        required=False) for camera in configured)]
        self._poll_frames = self.poll(
            Header, 'neighbors/frames', self._take_frame, best_effort(), required=False)
        self.subscribe(PointStamped, ARMED_AT_TOPIC, self._take_armed_at, LATCHED_QOS,
                       required=False)
        self.subscribe(String, BRIDGE_TOPIC, self._take_bridge, LATCHED_QOS, required=False)
        self._commands = self.create_publisher(
            MultiDOFJointTrajectory, 'command/trajectory', QoSProfile(depth=1))
        self._states = self.create_publisher(String, 'planner/state', LATCHED_QOS)
        self._distances = self.create_publisher(Range, 'planner/distance', best_effort())
        self.create_service(SetBool, 'planner/engage', self._serve_engage)
        self._bridge_parameters = WatchedParameters(
            self, 'mavlink_bridge', lambda: time.monotonic() - self._flown < FLOWN_TIME)
        self._bridge_publishers = SolePublisher(self, BRIDGE_TOPIC)
        self.diagnostics.checks += [
            self._tick_problem, self._state_problem, self._bridge_problem, self._sight_problem,
            self._bridge_changed]
        self.diagnostics.sources.append(self._values)
        self._timer = self.create_timer(self._settings.current.period, self._tick)
        self._silence = self.create_timer(
            self._settings.current.perception_timeout, self._on_silence)
        self._silence.cancel()

    def _build(self, values: dict[str, Any]) -> PlannerParams:
        """Return the parameters of the core; braking and separation keep the initial limits."""
        # A vehicle is known to others by the name of its namespace.
        params = planner_params(values, name=self.get_namespace().strip('/'))
        self._start = start = self._start or params
        return replace(params, a_max_start=start.a_max, v_max_start=start.v_max)

    def _flying(self) -> bool:
        """Return whether the bridge is ACTIVE; if none is required, whether it is engaged."""
        return not self._loop.waiting_reason(self._bridge_age()) and (
            self._settings.values['require_bridge'] or self._loop.engaged)

    def _poll_states(self, kind: Any, topic: str, convert: Callable[[Any], Any],
                     take: Callable[[Any], None], depth: int, required: bool = False,
                     sporadic: bool = False) -> Callable[[], None]:
        """Poll a topic; ``take`` gets states, their stamps by the loop's clock."""
        def taken(message: Any, arrival: int) -> None:
            if self._even_clock.fresh(topic, stamp_to_nanoseconds(message.header.stamp)):
                state = convert(message)
                take(state._replace(stamp=self._even_clock.dated(state.stamp, arrival)))
        return self.poll(kind, topic, taken, best_effort(depth), required=required,
                         sporadic=sporadic)

    def _take_odom(self, state: OdometryState, arrival: int) -> None:
        if not self._even_clock.simulated:
            state = state._replace(stamp=min(state.stamp, arrival))
        self._loop.take_odometry(state, arrival)

    def _take_motion(self, message: Odometry, arrival: int) -> None:
        clock_shift = self._even_clock.clock_shift
        if self._even_clock.fresh(MOTION_TOPIC, stamp_to_nanoseconds(message.header.stamp)):
            state = from_odometry(message)
            self._take_odom(state._replace(stamp=state.stamp - clock_shift), arrival - clock_shift)

    def _take_bridge(self, message: String) -> None:
        reported = self._loop.take_bridge_state(message.data, self._bridge_age())
        self._bridge_received = time.monotonic()
        if reported != self._bridge:
            self._bridge = reported
            self.get_logger().info(f'the bridge: {reported}')

    def _bridge_age(self) -> float:
        """Return how long the bridge has been silent, s, in wall time: it repeats its state."""
        return time.monotonic() - self._bridge_received

    def _take_camera_info(self, message: CameraInfo, _: int, camera: str) -> None:
        calibration = (message.width, message.height, tuple(message.k), tuple(message.p),
                       message.distortion_model)
        if calibration != self._calibrations.get(camera):
            self._calibrations[camera] = calibration
            values = self._cameras[camera]
            self._loop.take_camera_info(message, values.rpy, camera, values.rectified)

    def _take_armed_at(self, message: PointStamped) -> None:
        known = math.isfinite(message.point.z)
        self._loop.ground = message.point.z if known else None
        self.get_logger().info(f'armed at a height of {message.point.z:.2f} m' if known else (
            'the height at arming is unknown'))

    def _take_frame(self, message: Header, arrival: int) -> None:
        # Compared with the stamps of neighbors: on the same clock.
        stamp = self._even_clock.dated(stamp_to_nanoseconds(message.stamp), arrival)
        if self._loop.take_frame(arrival - self._even_clock.clock_shift, stamp):
            timeout = round(self._settings.current.perception_timeout * 1e9)
            late = self.get_clock().now().nanoseconds - arrival
            # Within the timeout, if the clock was set meanwhile.
            self._silence.timer_period_ns = max(timeout - max(late, 0), 1)
            self._silence.reset()

    def _on_silence(self) -> None:
        """Brake at once when images stop, instead of at the next tick."""
        self._silence.cancel()
        self._poll_frames()
        if self._silence.is_canceled():  # none has come meanwhile
            self._tick()

    def _serve_engage(self, request: SetBool.Request,
                      response: SetBool.Response) -> SetBool.Response:
        before = 'already ' if self._loop.engaged else ''
        self._loop.engage(request.data)
        missing = self._missing()
        response.success, response.message = True, 'disengaged: no more commands'
        if request.data:
            response.message = f'{before}engaged' + (
                f'; waiting for: {"; ".join(missing)}' if missing else '')
        self.get_logger().info(response.message)
        return response

    def _missing(self) -> list[str]:
        """Return the conditions for following that are not met yet."""
        fault = self._loop.odometry_fault(self._even_clock.now(), self._settings.current)
        return [*filter(None, [
            f'{fault} on {self.resolve_topic_name("odom")}' if fault else '',
            self._loop.waiting_reason(self._bridge_age()),
            '' if self._loop.memory.neighbors else 'no neighbor seen yet'])]

    def _tick(self) -> None:
        self._even_clock.now()  # a clock that was set is found before the inputs are dated
        self._poll_frames()
        for poll in self._polls:
            poll()
        nanoseconds = self._even_clock.now()
        self._ticked = time.monotonic()
        if self._flying():
            self._flown = self._ticked
        self.diagnostics.rate('tick').tick(self._ticked)
        decision, command = self._loop.tick(
            nanoseconds, self._settings.current, self._bridge_age())
        if command is not None:
            self._commands.publish(trajectory(
                make, command._replace(stamp=command.stamp + self._even_clock.clock_shift)))
            self.diagnostics.rate('command').tick(self._ticked)
        if (known := self._loop.distance()) is not None:
            stamp = nanoseconds_to_stamp(nanoseconds + self._even_clock.clock_shift)
            self._distances.publish(Range(
                header=Header(frame_id=known[0], stamp=stamp), range=known[1]))
        self._report(decision)

    def _report(self, decision: Decision) -> None:
        """Publish the state if it has changed."""
        for rejection in decision.rejected:
            self.diagnostics.reject(*rejection)
        reported = decision.state, self._loop.memory.given_up
        if reported != self._reported:
            self._reported = reported
            self._states.publish(String(data=decision.state.value))
            why = f': {decision.reason}' if decision.reason else ''
            self.get_logger().info(f'{decision.state.value}{why}')
        self._decision = decision

    def _values(self, _: float) -> dict[str, Any]:
        """Return the values of the newest tick for /diagnostics."""
        decision, memory = self._decision, self._loop.memory
        now = self._loop.seconds(self._even_clock.now())
        states, values = {'odom': memory.own, **memory.neighbors}, self._settings.values
        return {
            'state': decision.state.value, 'reason': decision.reason,
            'engaged': self._loop.engaged, 'bridge': self._bridge or 'not received',
            'missed_ticks': self._loop.missed, 'limits': decision.limits,
            # The band about a neighbor, to its hull.
            'nearest_m': f'{math.sqrt(values["d0"]) + values["radius"]:.3f}',
            'farthest_m': f'{math.sqrt(values["d1"]) + values["radius"]:.3f}',
            'warnings': '; '.join(decision.warnings), 'edges': ', '.join(decision.edges),
            **{f'{name}_age_s': f'{now - state.stamp:.3f}'
               for name, state in states.items() if state is not None},
            **{f'{name}_is': f'{n.member.role}, {"heard" if n.received else "seen"}'
               for name, n in memory.neighbors.items()}}

    def _tick_problem(self, now: float) -> Problem | None:
        silent = now - self._ticked
        if silent <= TICK_TIMEOUT:
            return None
        clock = 'is /clock published?' if self._even_clock.simulated else 'the executor is blocked'
        return ERROR, f'no tick for {silent:.0f} s: {clock}'

    def _state_problem(self, now: float) -> Problem | None:
        decision = self._decision
        if decision.reason == 'not engaged':
            return None
        if decision.state is not State.TRACK:
            return WARN, f'{decision.state.value}: {decision.reason}'
        return (WARN, '; '.join(decision.warnings)) if decision.warnings else None

    def _sight_problem(self, now: float) -> Problem | None:
        if self._loop.view or self._decision.state is State.IDLE:
            return None
        return WARN, (f'no {self.resolve_topic_name("camera_info")}: flies without bounds '
                      'that keep the leader in the image')

    def _bridge_problem(self, now: float) -> Problem | None:
        if not self._settings.values['require_bridge']:
            return None
        return self._bridge_publishers.problem(now)

    def _bridge_changed(self, now: float) -> Problem | None:
        changed = self._bridge_parameters.changed_in_flight(now)
        return (WARN, changed) if changed else None


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    avoid_shared_memory(os.environ)
    return run(Planner, args)


if __name__ == '__main__':
    sys.exit(main())
