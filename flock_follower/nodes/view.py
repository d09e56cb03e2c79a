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
The view node: a live page of the flight for a browser, http://127.0.0.1:8090.

The node only reads topics, unless ``control:=true``. It reads the names of topics, and the
mounting of the camera, from the parameters of relative_pose. Without an open page the node takes,
once per second, the few messages that the history on the page needs. With an open page it also
takes odometry, neighbors, commands, and images of the (first) camera, and draws at 10 Hz.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
import os
import secrets
import socket
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from sensor_msgs.msg import BatteryState, CameraInfo, CompressedImage, Image, Range
from std_msgs.msg import String
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_follower.geometry import Transform
from flock_follower.messages import MOTION_TOPIC, NANOSECONDS, OdometryState, stamp_to_nanoseconds
from flock_follower.messages.bridge_state import TOPIC as BRIDGE_TOPIC
from flock_follower.messages.command_reader import from_trajectory
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import ODOMETRY
from flock_follower.messages.topic_names import (
    COMPRESSED,
    COMPRESSED_IMAGES,
    IMAGE,
    INFO,
    RAW_IMAGES,
)
from flock_follower.nodes.support.diagnostics import STEADY
from flock_follower.nodes.support.image_middleware import (
    avoid_shared_memory_for_images,
    receive_buffer_max,
)
from flock_follower.nodes.support.inputs import best_effort, LATCHED_QOS, StaticTransforms
from flock_follower.nodes.support.output import never_block_output
from flock_follower.nodes.support.process import run, spin
from flock_follower.nodes.support.remote_parameters import RemoteParameters
from flock_follower.nodes.support.runtime import deserialize, FlockNode, READERS, Waiting
from flock_follower.nodes.support.service_calls import make_request, service_type
from flock_follower.odometry.buffer import OdometryBuffer, OdometrySample
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.parameters.cameras import cameras, CameraValues
from flock_follower.parameters.spec import CAMERAS, filled
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import compute_in_one_thread, decode_image
from flock_follower.perception.tracker import camera_mounting
from flock_follower.view.access import Access, is_loopback, TOKEN_BYTES
from flock_follower.view.flight import NodeReport, pose, ShownBattery, ShownFlight
from flock_follower.view.parameter_table import VIEW
from flock_follower.view.picture import draw_picture

SPECS = VIEW
PERIOD = 0.1  # s between two turns with an open page
IDLE_PERIOD = 1.0  # s between two turns without
NICENESS = 10  # what flies goes first
ASK_PERIOD = 2.0  # s between two requests for the parameters of relative_pose
ANSWER_TIMEOUT = 20.0  # s for the answer of a service: a landing is confirmed before
LARGEST = 65536  # bytes of a message that is not an image
#: What each button calls, and the value; None: it takes none.
CALLS = {'brake': ('planner/engage', False), 'land': ('mavlink_bridge/land', None)}
PERCEPTION = 'relative_pose'
#: Our names of the topics that relative_pose subscribes to, by their types.
BY_TYPE = {IMAGE: RAW_IMAGES, COMPRESSED: COMPRESSED_IMAGES, INFO: 'camera_info', ODOMETRY: 'odom'}


class View(FlockNode):
    """
    Takes messages in the executor's thread, and gives pages to the server's.

    :raises ValueError: for a bad parameter. :raises OSError: if the address is not free.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('view', **kwargs)
        from flock_follower.view.server import PageServer  # the only module that needs aiohttp
        values = self.declare(SPECS, dict).values
        self._flight, self._odometry = ShownFlight(), OdometryBuffer()
        self._epoch: int | None = None
        """The stamp, ns, from which the times of odometry count."""
        self._distances: list[Range] = []
        self._pending: tuple[bytes, Any] | None = None
        """The image of the last turn, and its class: its estimates have come meanwhile."""
        self._calibration = b''
        self._model: CameraModel | None = None
        self._perception = RemoteParameters(self, PERCEPTION, self._take_parameters)
        self._ask_at = 0.0  # s: when relative_pose may be asked again
        self._static = StaticTransforms(self)
        self._configure(CameraValues(''), 'raw', SourceParams())
        self._buttons: deque[str] = deque(maxlen=4)
        self._calls: list[tuple[str, Any, float]] = []
        """Each pressed button, the future of its answer, and the time until which it waits."""
        self._callers = {
            button: self.create_client(service_type(value), service)
            for button, (service, value) in CALLS.items()} if values['control'] else {}
        take = self._flight
        self._always = [
            self._listen(DiagnosticArray, '/diagnostics', self._take_diagnostics, best_effort(50)),
            self._listen(String, 'planner/state', lambda m: take.take_state(m.data), LATCHED_QOS),
            self._listen(String, BRIDGE_TOPIC,
                         lambda m: take.take_bridge(m.data, time.monotonic()), LATCHED_QOS),
            self._listen(Range, 'planner/distance', self._distances.append, best_effort(20)),
            self._listen(BatteryState, 'mavlink/battery', lambda m: take.take_battery(ShownBattery(
                time.monotonic(), m.percentage, m.voltage)), best_effort())]
        self._open: list[Subscription] = []
        """The subscriptions that only an open page needs."""
        self._wake = self.create_guard_condition(self._on_wake)
        self._timer = self.create_timer(IDLE_PERIOD, self._turn, clock=STEADY)
        self._server = PageServer(
            _access(values), values['port'], self._wake.trigger, self._press, {
                'name': self.get_namespace().strip('/') or 'follower',
                'computer': socket.gethostname()})
        self._server.start()
        # Not in the log, which is published and recorded: its readers would have the token.
        for url in self._server.access.urls(self._server.port):
            print(f'view: {url}', flush=True)

    def serve(self) -> None:
        """Serve until shutdown."""
        try:
            spin(self)
        finally:
            self._server.stop()

    def _press(self, button: str) -> None:
        """Pass a button from the server's thread to the executor's."""
        self._buttons.append(button)
        self._wake.trigger()

    # The executor's thread.

    def _listen(self, kind: Any, topic: str, take: Callable[[Any], None],
                qos: QoSProfile) -> Subscription:
        """Subscribe; the messages wait until :meth:`_receive` takes them."""
        def deliver(data: bytes) -> None:
            if len(data) > LARGEST:
                self.diagnostics.reject(f'too large {topic}')
                return
            read = READERS.get(kind)
            try:
                take(deserialize(kind, data) if read is None else read(data))
            except ValueError as error:
                self.diagnostics.reject(f'invalid {topic}', str(error))

        def keep(data: bytes) -> None:  # an image is decoded in the next turn
            self._pending = data, kind
            self._flight.note('image', time.monotonic())

        return self.create_subscription(
            kind, topic, keep if kind in (Image, CompressedImage) else deliver, qos,
            callback_group=Waiting(), raw=True)

    def _receive(self, subscriptions: Iterable[Subscription]) -> None:
        """Take the messages that wait."""
        for each in subscriptions:
            while (received := each.handle.take_message(each.msg_type, True)) is not None:
                each.callback(received[0])

    def _on_wake(self) -> None:
        """Run one cycle at once, after a page was opened or closed, or a button was pressed."""
        try:
            self._turn()
        except Exception as error:
            self._caught('on waking', error)

    def _turn(self) -> None:
        """Take the messages that wait, and send them to the open pages."""
        watched, now = self._server.pages > 0, time.monotonic()
        new = watched and not self._open
        if watched != bool(self._open):
            self._watch(watched)
        self._receive(self._always)
        self._take_distances(now)
        while self._buttons:
            self._call(self._buttons.popleft(), now)
        self._take_answers(now)
        if not watched:
            return
        if now >= self._ask_at and (new or self._perception.values is None):
            self._ask_at = now + ASK_PERIOD
            self._perception.ask()
        image, self._pending = self._pending, None
        self._receive(tuple(self._open))
        if image is not None:
            self._send_picture(*image)
        if self._server.greets:
            self._server.send_history(self._flight.history(now))
        self._server.send_state(self._flight.page(time.monotonic()))

    def _watch(self, watched: bool) -> None:
        """Subscribe to the topics that only an open page needs, or unsubscribe."""
        for subscription in self._open:
            self.destroy_subscription(subscription)
        self._open, self._pending = [], None
        if watched:
            flight, names = self._flight, self._names()
            self._open = [self._listen(kind, topic, take, best_effort(depth))
                          for topic, kind, take, depth in (
                (names['odom'], Odometry, self._take_odometry, 50),
                (MOTION_TOPIC, Odometry, lambda m: self._use(from_odometry(m)), 5),
                ('neighbors', Odometry, lambda m: flight.take_neighbor(
                    from_odometry(m), time.monotonic()), 20),
                ('neighbors/heard', Odometry, lambda m: flight.take_neighbor(
                    from_odometry(m), time.monotonic(), seen=False), 20),
                ('command/trajectory', MultiDOFJointTrajectory, lambda m: flight.take_command(
                    from_trajectory(m, m.header.frame_id), time.monotonic()), 1),
                (names['camera_info'], CameraInfo, self._take_calibration, 1),
                (names[RAW_IMAGES], CompressedImage if names['compressed'] else Image,
                 lambda _: None, 1))]
        self._timer.timer_period_ns = round((PERIOD if watched else IDLE_PERIOD) * NANOSECONDS)
        self._timer.reset()

    def _names(self) -> dict[str, str]:
        """Return the names of the topics of relative_pose; our default names without this node."""
        names = {'odom': 'odom', 'camera_info': self._camera.camera_info,
                 RAW_IMAGES: self._camera.images(self._transport),
                 'compressed': 'yes' if self._transport == 'compressed' else ''}
        space = self.get_namespace()
        if (PERCEPTION, space) in self.get_node_names_and_namespaces():
            found = {BY_TYPE[types[0]]: topic for topic, types
                     in self.get_subscriber_names_and_types_by_node(PERCEPTION, space)
                     if types[0] in BY_TYPE and (types[0] == ODOMETRY or not self._camera.name)
                     and not topic.endswith(MOTION_TOPIC)}
            for ours, compressed in ((RAW_IMAGES, ''), (COMPRESSED_IMAGES, 'yes')):
                if ours in found:
                    names |= {RAW_IMAGES: found.pop(ours), 'compressed': compressed}
            names |= found
        return names

    def _take_parameters(self, values: dict[str, Any]) -> None:
        """Take the parameters of relative_pose; begin anew with them."""
        try:
            known = values.get(CAMERAS) is not None
            self._configure(cameras(values)[0] if known else CameraValues(''),
                            values.get('image_transport', 'raw'),
                            filled(SourceParams(), values, 'odom_'))
        except (KeyError, ValueError) as error:
            self.diagnostics.reject('parameters of relative_pose', str(error))
        if self._open:
            self._watch(True)

    def _configure(self, camera: CameraValues, transport: str, source: SourceParams) -> None:
        self._camera, self._transport = camera, transport
        self._source = OdometrySource(source, self._static.frames)
        self._mounting = camera_mounting(camera.position, camera.rpy)
        self._calibration, self._model = b'', None

    def _take_calibration(self, message: CameraInfo) -> None:
        message.header = type(message.header)()
        calibration = repr(message).encode()
        if calibration != self._calibration:
            self._calibration, self._model = calibration, None
            self._model = CameraModel.from_info(message, self._camera.rectified)

    def _send_picture(self, data: bytes, kind: Any) -> None:
        """Draw the estimates at an image's stamp into the image."""
        try:
            message = deserialize(kind, data)
            stamp = stamp_to_nanoseconds(message.header.stamp)
            self._server.send_image(draw_picture(
                decode_image(message), self._model, self._place(stamp),
                self._flight.picture_scene(stamp)))
        except ValueError as error:
            self.diagnostics.reject('invalid image', str(error))

    def _place(self, stamp: int) -> Transform | None:
        """Return ``T_odom_camera`` at the stamp of an image, ns; None if it is unknown."""
        if self._epoch is None:
            return None
        sample = self._odometry.at(
            (stamp - self._epoch) / NANOSECONDS + self._camera.time_offset)
        return pose(sample) @ self._mounting if isinstance(sample, OdometrySample) else None

    def _take_odometry(self, message: Odometry) -> None:
        state = self._source.take(message, self.get_clock().now().nanoseconds)
        self._source.new_events()  # relative_pose reports them
        if state is not None:
            self._use(state)

    def _use(self, state: OdometryState) -> None:
        """Take the ego state."""
        if not self._flight.take_odometry(state, time.monotonic()):
            return
        self._epoch = self._epoch or state.stamp
        self._odometry.add(OdometrySample.from_state(
            state, (state.stamp - self._epoch) / NANOSECONDS))

    def _take_distances(self, now: float) -> None:
        """Set the times of the new distances by their stamps; the last one is of now."""
        stamps = [stamp_to_nanoseconds(message.header.stamp) for message in self._distances]
        for stamp, message in zip(stamps, self._distances):
            before = (stamps[-1] - stamp) / NANOSECONDS
            self._flight.take_distance(message.header.frame_id, message.range,
                                       now - min(max(before, 0.0), 2.0 * IDLE_PERIOD))
        self._distances.clear()

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            space, _, node = f'/{status.name}'.rpartition('/')
            if space == self.get_namespace().rstrip('/'):
                self._flight.take_report(node, NodeReport(
                    time.monotonic(), int.from_bytes(status.level, 'little'), status.message,
                    {pair.key: pair.value for pair in status.values}))

    def _call(self, button: str, now: float) -> None:
        """Call the service of a button at each press, because the last answer may be lost."""
        value = CALLS[button][1]
        self.get_logger().info(f'{button}: pressed on the page')
        self._calls.append((
            button, self._callers[button].call_async(make_request(value)), now + ANSWER_TIMEOUT))

    def _take_answers(self, now: float) -> None:
        """Pass on answers to buttons."""
        calls, self._calls = self._calls, []
        for button, future, end in calls:
            if future.done():
                response = future.result()
                self._server.send_answer(button, response.success, response.message)
            elif now > end or not self._callers[button].service_is_ready():
                self._server.send_answer(button, False, f'no answer of {CALLS[button][0]}')
            else:
                self._calls.append((button, future, end))


def _access(values: dict[str, Any]) -> Access:
    """Return who may access the page, with a new token for this run if one is needed."""
    host, control = values['host'], values['control']
    needed = control or not is_loopback(host)
    names: set[str] = set()
    with suppress(OSError):
        name = socket.gethostname()
        names = {name, f'{name}.local'}
    return Access(host, control, secrets.token_urlsafe(TOKEN_BYTES) if needed else '',
                  frozenset(names))


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    os.nice(NICENESS)
    avoid_shared_memory_for_images(os.environ, receive_buffer_max())
    never_block_output()
    compute_in_one_thread()
    try:
        return run(View, args, View.serve)
    except ImportError as error:
        print(f'error: view needs {error.name}: apt install python3-aiohttp, or pip install '
              'aiohttp', file=sys.stderr)
        return 1


if __name__ == '__main__':
    sys.exit(main())
