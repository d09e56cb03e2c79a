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
The MAVLink bridge node: commands and odometry in, a stream of setpoints out.

A new command is sent at once; without a command setpoints are sent at ``stream_rate`` (20 Hz).

The node subscribes ``command/trajectory`` and ``odom``, and for the reports to the pilot's ground
station ``planner/state`` and ``planner/distance``. It publishes ``mavlink/odom``,
``mavlink/battery``, ``mavlink_bridge/state`` and ``mavlink_bridge/armed_at``, and serves
``mavlink_bridge/arm``, ``offboard``, ``takeoff`` and ``land``. ``flock_follower.gate`` decides
which setpoints are sent.

The messages of odometry are read together, ODOM_RATE times a second: a callback for each message
of a fast source would cost more than the rest of the bridge.

The node has three threads. ``SetpointThread`` owns the bridge and sends the setpoints on the
monotonic clock: it waits for neither the executor nor ``/clock``, and calls nothing of rclpy. The
executor's thread takes messages and service calls, and passes actions to the bridge by
``SetpointThread.submit``. The publisher thread publishes and logs what ``PublisherThread.submit``
passes to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
import os
import sys
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from sensor_msgs.msg import Range
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_follower.gate.flight_end import CommandSources, EndParams
from flock_follower.gate.gate import Gate
from flock_follower.gate.permission import Phase
from flock_follower.gate.velocity_check import MotionReport, ODOM
from flock_follower.mavlink.bridge import Bridge, Cycle
from flock_follower.mavlink.commands import Outcome, Request
from flock_follower.mavlink.link import Link, Signing
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder
from flock_follower.mavlink.parameter_table import gate_limits, origin, recommendations
from flock_follower.mavlink.parameter_table import MAVLINK_BRIDGE as SPECS
from flock_follower.mavlink.setpoint_thread import SetpointThread
from flock_follower.mavlink.status_texts import DISTANCE_PERIOD
from flock_follower.mavlink.transport import open_transport
from flock_follower.messages import OdometryState, stamp_age
from flock_follower.messages.command_reader import from_trajectory
from flock_follower.nodes.support.bridge_report import BridgeReport
from flock_follower.nodes.support.diagnostics import internal_error, STEADY
from flock_follower.nodes.support.even_clock import EvenClock
from flock_follower.nodes.support.inputs import best_effort, LATCHED_QOS, OwnOdometry
from flock_follower.nodes.support.middleware import avoid_shared_memory
from flock_follower.nodes.support.output import never_block_output
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.publisher_thread import PublisherThread
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.parameters.spec import filled
from flock_follower.system.fast_dds import opened_segment_names

# Not only the newest: otherwise a second commanding node would not be detected.
COMMANDS_QOS = best_effort(10)
ODOM_RATE = 50.0  # Hz: at most 20 ms after the arrival; higher if it is forwarded faster
SERVICES = {'arm': SetBool, 'offboard': SetBool, 'takeoff': Trigger, 'land': Trigger}
UNNUMBERED = ('this middleware does not number messages: a second node that commands is reported '
              'on /diagnostics, but causes no braking')
TOO_MANY = 'too many wait for the setpoint thread'
STOPPING = Outcome(False, 'refused: the bridge is stopping')
ENDED = Outcome(False, 'refused: the setpoint thread has ended or takes no more')


class _Call:
    """A call of a service; the setpoint thread begins its request."""

    def __init__(self) -> None:
        self.answer = Future()
        self.request: Request | None = None
        self.outcome: Outcome | None = None

    def begin(self, ask: Callable[[float], Request]) -> None:
        """Make the request, in the setpoint thread."""
        try:
            self.request = ask(time.monotonic())
        except Exception as error:
            self.outcome = Outcome(False, internal_error(error))
            raise

    def refuse(self, outcome: Outcome = STOPPING) -> None:
        """End the call without a request, because the setpoint thread ends."""
        self.outcome = outcome

    def result(self) -> Outcome | None:
        """Return the outcome, None before."""
        return self.request.outcome if self.request is not None else self.outcome


class MavlinkBridge(FlockNode):
    """Feeds the bridge from topics and services, and publishes its state."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('mavlink_bridge', **kwargs)
        self._settings = self.declare(SPECS, gate_limits, self._flying)
        values = self._settings.values
        if values['forward_odometry'] and (
                self.resolve_topic_name('odom') == self.resolve_topic_name('mavlink/odom')):
            raise ValueError('forward_odometry = true: odom is the estimate of the autopilot, '
                             'which must not be fed back to it')
        self._bridge = Bridge(
            _open_link(values), Gate(self._settings.current, values['velocity_source']),
            now=time.monotonic(),
            forwarder=(OdometryForwarder(values['odometry_rate']) if values['forward_odometry']
                       else None),
            blind_action=values['blind_action'],
            require_failsafe=values['require_failsafe'],
            recommendations=recommendations(
                values['forward_odometry'], values['takeoff_height']),
            estimate_rate=values['telemetry_rate'], origin=origin(values['global_origin']),
            wind_compensation=values['wind_compensation'], end=filled(EndParams(), values),
            report_to_gcs=values['report_to_gcs'])
        self._even_clock = EvenClock(self)
        self._odom_frame = 'odom'
        self._new_odom: list[tuple[OdometryState, float, float]] = []
        self._calls: list[_Call] = []
        self._sources = CommandSources()
        self._numbered = True
        self._stream = SetpointThread(
            self._bridge, 1.0 / values['stream_rate'],
            lambda messages, now: self._report.on_messages(messages, now), self._on_cycle,
            lambda error: self._report.fault('in the stream', error))
        self._publisher = PublisherThread(
            lambda error: self._report.fault('while publishing', error))
        self._report = BridgeReport(self, self._bridge, self._publisher)
        self._connect(values)
        self._publisher.start()
        self._stream.start()
        self.get_logger().info(f'waiting for system id {values["target_system"]} on '
                               f'{values["connection"]}')
        if opened_segment_names():
            self.get_logger().warning(
                'Fast DDS shares memory with other processes here: connecting to one can '
                'stop the setpoints for up to 1 s; config/dds/fastdds_udp.xml prevents that')

    def _connect(self, values: Mapping[str, Any]) -> None:
        """Create the subscriptions, timers and services."""
        self.subscribe(MultiDOFJointTrajectory, 'command/trajectory', self._on_command,
                       COMMANDS_QOS, required=False, informed=True)
        self._own = OwnOdometry(self, values, self._take_odom, self._even_clock, required=(
            values['velocity_source'] == 'odom' or values['forward_odometry']))
        rate = max(ODOM_RATE, values['odometry_rate'] if values['forward_odometry'] else 0.0)
        self.create_timer(1.0 / rate, self._hand_over_odom, clock=STEADY)
        # A separate group: services wait for the autopilot while the other callbacks run.
        waiting = ReentrantCallbackGroup()
        for name, kind in SERVICES.items():
            self.create_service(kind, f'mavlink_bridge/{name}', partial(self._serve, name),
                                callback_group=waiting)
        if values['report_to_gcs']:
            self.subscribe(String, 'planner/state', self._on_planner_state, LATCHED_QOS,
                           required=False)
            self.create_timer(DISTANCE_PERIOD, self.poll(
                Range, 'planner/distance', self._on_distance, best_effort(), required=False))

    def destroy_node(self) -> None:
        """Brake, end the stream, release the port."""
        self._stream.stop()
        self._answer_calls(otherwise=STOPPING)
        self._publisher.stop()
        self._bridge.link.transport.close()
        super().destroy_node()

    # The executor's thread: it changes the bridge only by actions for the setpoint thread.

    def _on_command(self, message: MultiDOFJointTrajectory, info: Mapping[str, Any]) -> None:
        now = time.monotonic()
        self._watch_commanders(info, now)
        command = from_trajectory(message, self._odom_frame)
        self._even_clock.now()
        if not self._even_clock.fresh('command/trajectory', command.stamp):
            return
        age, source_age = command.ages(self.get_clock().now().nanoseconds)

        def take() -> None:
            if refused := self._bridge.gate.take_command(command, age, now, source_age):
                self._report.refused(f'command {refused}', f'stamp {age:.3f} s old')
        if not self._stream.submit(take):
            self.diagnostics.reject('command not taken', TOO_MANY)

    def _watch_commanders(self, info: Mapping[str, Any], now: float) -> None:
        """Brake if the sequence numbers of commands show that two nodes publish them."""
        number, received = info['publication_sequence_number'], info['received_timestamp']
        if number is None and self._numbered:
            self._numbered = False
            self.get_logger().warning(UNNUMBERED)
        # The time of arrival: two commands that arrived far apart may both have waited.
        waited = max(time.time_ns() - received, 0) * 1e-9 if received else 0.0
        if self._sources.another(number, now - waited) and self._flying():
            who = self._report.problems.commanders.publishers()
            gate = self._bridge.gate
            self._stream.submit(lambda: gate.permit(gate.permission.contest(who)))

    def _flying(self) -> bool:
        """Return whether the vehicle flies the commands."""
        return self._bridge.gate.permission.phase is Phase.ACTIVE

    def _on_planner_state(self, message: String) -> None:
        self._stream.submit(lambda: self._bridge.ground_station.take_state(
            message.data, time.monotonic()))

    def _on_distance(self, message: Range, _: int) -> None:
        self._stream.submit(lambda: self._bridge.ground_station.take_distance(
            message.header.frame_id, message.range, time.monotonic()))

    def _take_odom(self, state: OdometryState, arrival: int) -> None:
        # Never in the future, if the clock was set.
        now = time.monotonic() - max((self._even_clock.now() - arrival) * 1e-9, 0.0)
        self._odom_frame = state.frame
        self._report.take_odometry(state, now)
        self._new_odom.append((state, stamp_age(state.stamp, arrival), now))

    def _hand_over_odom(self) -> None:
        """Pass the odometry that waits to the setpoint thread; answer the services."""
        self._answer_calls()
        self._own.poll()
        taken, self._new_odom = self._new_odom, []
        if taken and not self._stream.submit(lambda: self._use_odom(taken)):
            self.diagnostics.reject('odom not taken', TOO_MANY)

    async def _serve(self, name: str, request: Any, response: Any) -> Any:
        """Answer a service once the autopilot shows the result."""
        requests, rivals = self._bridge.requests, self._report.problems.commanders.conflict()
        ask: dict[str, Callable[[float], Request]] = {
            'arm': lambda now: requests.arm(request.data, now),
            'offboard': lambda now: requests.offboard(request.data, now, rivals),
            'takeoff': lambda now: requests.takeoff(self._settings.values['takeoff_height'], now),
            'land': requests.land}
        call = _Call()
        self._calls.append(call)
        if not self._stream.submit(lambda: call.begin(ask[name]), call.refuse):
            call.refuse(ENDED)
        self._answer_calls()
        response.success, response.message = await call.answer
        self.get_logger().info(f'{name}: {response.message}')
        return response

    def _answer_calls(self, otherwise: Outcome | None = None) -> None:
        """Answer the calls that have an outcome; answer the others with ``otherwise`` if given."""
        for call in self._calls:
            if (outcome := call.result() or otherwise) is not None:
                call.answer.set_result(outcome)
        self._calls = [call for call in self._calls if not call.answer.done()]

    # The setpoint thread: it publishes and logs by the publisher thread, without locks of rclpy.

    def _use_odom(self, taken: Sequence[tuple[OdometryState, float, float]]) -> None:
        """Pass states with their ages, s, and arrival times, s, to the gate and the autopilot."""
        for state, age, now in taken:
            refusals = [self._bridge.gate.take_motion(
                ODOM, MotionReport.from_odometry(state), age, now)]
            if self._settings.values['forward_odometry']:
                refusals.append(self._bridge.forward(state, now - age, now))
            for refused in filter(None, refusals):
                self._report.refused(f'odom {refused}', f'stamp {age:.3f} s old')

    def _on_cycle(self, cycle: Cycle, now: float) -> None:
        self._bridge.gate.limits = self._settings.current
        if (signing := self._bridge.link.signing) is not None:
            signing.set_clock(time.time(), now)
        self._report.on_cycle(cycle, now)


def _open_link(values: Mapping[str, Any]) -> Link:
    """Return the link to the autopilot that the parameters name; ValueError or OSError if none."""
    signing = (Signing.from_file(values['signing_key_file'], time.time())
               if values['signing_key_file'] else None)
    return Link(open_transport(values['connection']), autopilot=values['autopilot'],
                signing=signing, target_system=values['target_system'],
                source_system=values['source_system'], announce_as_gcs=values['announce_as_gcs'])


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    never_block_output()  # this process sends the setpoints
    avoid_shared_memory(os.environ)
    return run(MavlinkBridge, args)


if __name__ == '__main__':
    sys.exit(main())
