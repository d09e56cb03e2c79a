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
The black box: records the topics that ``evaluate`` needs, within a limit of disk space.

The node publishes only its diagnostics, and no node waits for it. The node takes messages twenty
times per second, with best effort (latched topics reliably), decodes only the images that it
compresses, and runs at low priority. A separate thread writes the messages to the disk within a
second, see ``bags.recording``. Topics are recorded under our names, without namespace and remaps,
so ``evaluate``, ``check`` and ``replay`` need no options for a recording.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
import os
from pathlib import Path
import sys
import threading
import time
from typing import Any, Final

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile
import yaml

from flock_follower.bags.bag import deserialize, serialize
from flock_follower.bags.mcap_file import definition, RecordedTopic, TakenMessage, type_hash
from flock_follower.bags.message_types import empty
from flock_follower.bags.parameter_table import BLACK_BOX as SPECS
from flock_follower.bags.parameter_table import recordings_folder
from flock_follower.bags.recording import FlightRecording
from flock_follower.messages import MOTION_TOPIC
from flock_follower.messages.topic_names import COMPRESSED, full_name, IMAGE, INFO, OURS, TYPES
from flock_follower.nodes.support.conversions import message_class
from flock_follower.nodes.support.diagnostics import ERROR, Problem, STEADY
from flock_follower.nodes.support.exit_deadline import no_exit_deadline
from flock_follower.nodes.support.image_middleware import (
    avoid_shared_memory_for_images,
    receive_buffer_max,
)
from flock_follower.nodes.support.inputs import best_effort
from flock_follower.nodes.support.output import never_block_output
from flock_follower.nodes.support.process import run, spin
from flock_follower.nodes.support.remote_parameters import RemoteParameters
from flock_follower.nodes.support.runtime import FlockNode, LONGEST_WAIT, Waiting
from flock_follower.parameters.cameras import cameras
from flock_follower.parameters.files import FLOWN
from flock_follower.perception.encoding import encode_jpeg
from flock_follower.perception.images import decode_image
from flock_follower.system.files import resource

TAKE_PERIOD = 0.05  # s between looks for what has arrived
WRITE_PERIOD = 0.3  # s between writes: still less than a second if one takes long
ASK_PERIOD = 1.0  # s between looks for nodes whose parameters are not known
RETRY_PERIOD = 5.0  # s until recording is tried again after a failure
WAITING_MAX = 64_000_000  # bytes that wait for a slow disk; what comes beyond them is dropped
NICENESS = 10
JPEG_QUALITY = 90  # of images compressed here
PARAMETER_EVENTS = '/parameter_events'
LATCHED = ('planner/state', 'mavlink_bridge/state', 'mavlink_bridge/armed_at', '/rosout')
#: Topics that are recorded besides the images and their calibration.
RECORDED: Final = {
    **{name: TYPES[name] for name in (
        'odom', 'ranges', 'neighbors', 'neighbors/frames', 'command/trajectory', 'planner/state',
        'mavlink_bridge/state', 'mavlink/odom', 'truth/odom', 'truth/neighbors')},
    'neighbors/heard': TYPES['neighbors'],
    MOTION_TOPIC: TYPES['odom'],
    'neighbors/acceleration': 'geometry_msgs/msg/AccelWithCovarianceStamped',
    'mavlink_bridge/armed_at': 'geometry_msgs/msg/PointStamped',
    'mavlink/battery': 'sensor_msgs/msg/BatteryState',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
    '/rosout': 'rcl_interfaces/msg/Log',
    PARAMETER_EVENTS: 'rcl_interfaces/msg/ParameterEvent',
}
# All that arrives at 1000 Hz while the disk or the processor is busy for a second.
QOS = best_effort(1000)
LATCHED_QOS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
IMAGE_QOS = best_effort(10)


class BlackBox(FlockNode):
    """Receives messages, and writes them in a separate thread."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('black_box', **kwargs)
        values = self.declare(SPECS, dict).values
        self._folder = recordings_folder(
            values, os.environ.get('ROS_HOME', ''), self.get_namespace())
        self._limits = values['disk_used'], values['disk_free']
        self._recording: FlightRecording | None = None
        # One thread takes, one writes, and the executor's notes: none needs a lock.
        self._notes: dict[str, str] = {}
        self._last: dict[RecordedTopic, int] = {}
        self._taken: deque[TakenMessage] = deque()
        self._bytes_taken = self._bytes_written = 0
        self._fault, self._retry = '', 0.0
        self._ending = threading.Event()
        #: Topic, handle and class of a subscription, and the conversion of its messages.
        self._inputs: list[tuple[RecordedTopic, Any, Any, Callable[[bytes], bytes]]] = []
        for name, msgtype in RECORDED.items():
            self._subscribe(name, msgtype, LATCHED_QOS if name in LATCHED else QOS)
        transport = values['image_transport']
        for camera in cameras(values):
            self._subscribe(camera.camera_info, INFO, QOS)
            if values['record_images'] != 'none':
                raw = transport == 'raw'
                self._subscribe(camera.images(transport), IMAGE if raw else COMPRESSED, IMAGE_QOS,
                                camera.images('compressed'), _compressed if raw else bytes)
        # rosbags takes tenths of a second for each type the first time: now, not in flight.
        for msgtype in {topic.msgtype for topic, *_ in self._inputs}:
            definition(msgtype)
            type_hash(msgtype)
        for msgtype in (IMAGE, COMPRESSED, RECORDED[PARAMETER_EVENTS]):
            deserialize(serialize(empty(msgtype), msgtype), msgtype)
        names = [full_name(name, self.get_namespace()) for name in OURS]
        self._nodes = {name: RemoteParameters(self, name, self._note) for name in names}
        self._unasked = set(names)  # or of changed parameters
        self.create_timer(ASK_PERIOD, self._ask, clock=STEADY)
        self.diagnostics.checks.append(self._problem)
        self.get_logger().info(f'recording to {self._folder}')

    def record(self) -> int:
        """Record until asked to end, finish the recording, and return the exit code."""
        threads = [threading.Thread(target=self._take_on), threading.Thread(target=self._write_on)]
        for thread in threads:
            thread.start()
        try:
            spin(self)
        finally:
            with no_exit_deadline():  # to finish it takes as long as the disk takes
                self._ending.set()
                for thread in threads:
                    thread.join()
        return 0

    def _subscribe(self, name: str, msgtype: str, qos: QoSProfile, recorded: str = '',
                   change: Callable[[bytes], bytes] = bytes) -> None:
        """Subscribe; record under another name, and changed to a compressed image, if given."""
        kind = message_class(msgtype)
        handle = self.create_subscription(
            kind, name, lambda _: None, qos, callback_group=Waiting(), raw=True).handle
        topic = RecordedTopic(
            f'/{(recorded or name).strip("/")}', COMPRESSED if recorded else msgtype,
            qos is LATCHED_QOS, self.resolve_topic_name(name))
        self._inputs.append((topic, handle, kind, change))

    def _ask(self) -> None:
        """Request the parameters of the running nodes whose parameters are not known."""
        for name in list(self._unasked):
            if self._nodes[name].ask():
                self._unasked.discard(name)

    def _note(self, _: dict[str, Any]) -> None:
        """Write the parameters of the flight and the neighbors as files for ``evaluate``."""
        flown = {}
        for name, node in zip(OURS, self._nodes.values()):
            if node.values is None:
                continue
            own = {key: value for key, value in node.values.items() if value is not None}
            if own.get('neighbors_file') or name == 'relative_pose':
                file = f'neighbors_of_{name}.yaml'
                with suppress(OSError, ValueError):  # its node reports that, if it must
                    path = Path(own.get('neighbors_file') or resource('config/neighbors.yaml'))
                    self._notes[file] = path.read_text(encoding='utf-8')
                    own['neighbors_file'] = file
            flown[name] = {'ros__parameters': own}
        text = yaml.safe_dump(flown, default_flow_style=False, allow_unicode=True)
        self._notes[FLOWN] = f'# The parameters flown, as the nodes had them last.\n{text}'

    def _take_on(self) -> None:
        """
        Receive messages until shutdown.

        This method runs in a separate thread, because Fast DDS can block a publisher in the
        executor for a second after another process was killed.
        """
        while not self._ending.wait(TAKE_PERIOD):
            try:
                self._take()
            except Exception as error:
                self.diagnostics.internal_error('on taking', error)

    def _take(self) -> None:
        """Take the messages that have arrived."""
        if not self.get_clock().now().nanoseconds:
            return  # without simulated time they wait
        for topic, handle, kind, change in self._inputs:
            while (received := handle.take_message(kind, True)) is not None:
                data, info = received
                try:
                    data = change(data)
                except ValueError as error:
                    self.diagnostics.reject(f'invalid {topic.source}', str(error))
                    continue
                if topic.name == PARAMETER_EVENTS:
                    name = deserialize(data, topic.msgtype).node
                    self._unasked |= {name} & self._nodes.keys()
                if self._bytes_taken - self._bytes_written + len(data) > WAITING_MAX:
                    self.diagnostics.reject('disk too slow')
                    continue
                self._bytes_taken += len(data)
                stamp, last = self.arrival(info), self._last.get(topic, 0)
                if stamp < last < stamp + LONGEST_WAIT:  # else the clock was set
                    stamp = last  # simulated time comes in steps
                self._last[topic] = stamp
                self._taken.append(TakenMessage(topic, stamp, data))

    def _write_on(self) -> None:
        """Write messages until shutdown, and finish the recording."""
        while not self._ending.wait(WRITE_PERIOD):
            self._write()
        self._retry = 0.0
        self._write()
        if self._recording is not None:
            try:
                self._recording.close()
            except OSError as error:
                print(f'error: {self._folder}: {error.strerror}; it is kept, marked incomplete',
                      file=sys.stderr)

    def _write(self) -> None:
        """Write the messages taken to the disk."""
        taken = [self._taken.popleft() for _ in range(len(self._taken))]
        self._bytes_written += sum(len(message.data) for message in taken)
        now = time.monotonic()
        try:
            if now < self._retry:
                raise OSError(0, self._fault)
            if self._recording is None:
                self._recording = FlightRecording(self._folder, *self._limits)
            while self._notes:
                name, text = self._notes.popitem()
                try:
                    self._recording.note(name, text)
                except OSError:
                    self._notes.setdefault(name, text)  # unless there is a newer one
                    raise
            self._recording.write(taken, now)
            self._fault = ''
            self.diagnostics.rate('written').tick(now)
            self.diagnostics.values['recording'] = self._recording.path
        except OSError as error:
            if now >= self._retry:
                self._fault, self._retry = error.strerror or str(error), now + RETRY_PERIOD
            self.diagnostics.counters['not recorded'] += len(taken)
        except Exception as error:  # of one batch; the next one may do better
            self.diagnostics.internal_error('on writing', error)

    def _problem(self, now: float) -> Problem | None:
        return (ERROR, f'not recording to {self._folder}: {self._fault}') if self._fault else None


def _compressed(data: bytes) -> bytes:
    """Return a serialized image as a serialized compressed one; ValueError if it is corrupt."""
    image = deserialize(data, IMAGE)
    compressed = empty(COMPRESSED)
    compressed.header, compressed.format = image.header, 'jpeg'
    compressed.data = np.frombuffer(encode_jpeg(decode_image(image), JPEG_QUALITY), np.uint8)
    return serialize(compressed, COMPRESSED)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    os.nice(NICENESS)
    avoid_shared_memory_for_images(os.environ, receive_buffer_max())
    never_block_output()
    return run(BlackBox, args, BlackBox.record)


if __name__ == '__main__':
    sys.exit(main())
