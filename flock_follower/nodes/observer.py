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
Listen for some seconds to every topic that a follower needs: the observations for ``check``.

The observer publishes nothing, sets no parameter, and reads the parameters of our nodes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from functools import partial
import os
from pathlib import Path
import signal
import time
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from flock_follower.checks.collector import Collector, POSES
from flock_follower.checks.dead_segments import dead_segments
from flock_follower.checks.observations import Machine, Observations, TopicEnd, TopicSeen
from flock_follower.checks.processor import Load, LOAD_PERIOD, LoadMeter
from flock_follower.checks.reach import find_reach, Reach
from flock_follower.checks.single_camera import select_camera
from flock_follower.messages import NANOSECONDS, stamp_to_nanoseconds
from flock_follower.messages.poses import POSE_TYPES
from flock_follower.messages.state_writer import ODOMETRY
from flock_follower.messages.topic_names import (
    COMPRESSED,
    COMPRESSED_IMAGES,
    full_name,
    IMAGE,
    INFO,
    names_there,
    OURS,
    RAW_IMAGES,
    topics_of_camera,
    TYPES,
)
from flock_follower.nodes.support.conversions import message_class
from flock_follower.nodes.support.diagnostics import STEADY
from flock_follower.nodes.support.inputs import best_effort, StaticTransforms
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.remote_parameters import RemoteParameters
from flock_follower.nodes.support.runtime import READERS
from flock_follower.nodes.support.shared_memory import shared_memory_size
from flock_follower.odometry.reader import read_odometry
from flock_follower.parameters.neighbors_file import NeighborConfig
from flock_follower.parameters.spec import CAMERAS
from flock_follower.perception.markers import load
from flock_follower.system.files import resource

DISCOVERY = 2.0  # s for the discovery of other nodes
POLL_PERIOD = 0.25  # s between two searches for new topics
#: Topics that are decoded; of the others only the rate is measured.
READ = (RAW_IMAGES, COMPRESSED_IMAGES, 'camera_info', 'odom')
#: The desk's simulator by its names: its load is ours, as in ``fly``.
SIMULATOR: Final = ('simulator', 'simulator_node')
COUNTED = ('neighbors/frames', 'neighbors', 'command/trajectory', 'mavlink/odom')
#: Our names of the topics that relative_pose subscribes to, by their types.
BY_TYPE = {IMAGE: RAW_IMAGES, COMPRESSED: COMPRESSED_IMAGES, INFO: 'camera_info', ODOMETRY: 'odom'}


class ObservedFrames(StaticTransforms):
    """The frames of ``/tf_static`` for a node that no callback may end."""

    def _subscribe(self, node: Node, kind: Any, qos: QoSProfile) -> None:
        node.create_subscription(kind, '/tf_static', self.take_valid, qos)

    def take_valid(self, message: Any) -> None:
        """Take the valid transforms of a TFMessage."""
        with suppress(ValueError):
            self.take(message)


class Observer(Node):
    """
    Listens, and fills observations.

    :param remaps: of our topics; topics without a remap have their names from relative_pose, if it
        runs.
    :param camera: the camera to observe if there are several; '': the first.
    """

    def __init__(self, seconds: float, namespace: str, remaps: dict[str, str],
                 camera: str) -> None:
        super().__init__('check_observer', start_parameter_services=False, enable_rosout=False)
        self._seconds, self._remaps, self._camera = seconds, remaps, camera
        self.seen = Observations(namespace=namespace, names=names_there(namespace, remaps))
        self._collector = Collector(self.seen, seconds)
        self._static = ObservedFrames(self)
        self.seen.static = self._static.frames
        self._simulated: float | None = None
        self._begin = time.monotonic() + DISCOVERY  # before, /clock may not be found
        self._subscribed: set[str] = set()
        self._remote: dict[str, RemoteParameters] = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._collector.diagnostics, 10)
        self.create_timer(POLL_PERIOD, self._look, clock=STEADY)

    def observe(self) -> Observations:
        """
        Listen, and return the observations.

        :raises ValueError: for a camera that does not exist.
        """
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        ours = [os.getpid(), *(process for process, *_ in find_processes((*OURS, *SIMULATOR)))]
        meter, end = LoadMeter(lambda: ours), self._begin + self._seconds
        try:
            while rclpy.ok() and (now := time.monotonic()) < end:
                meter.sample(now)
                executor.spin_once(timeout_sec=min(end - now, LOAD_PERIOD))
        finally:
            executor.shutdown(timeout_sec=0.5)
        if not rclpy.ok():
            raise ExternalShutdownException
        self.seen.duration = time.monotonic() - self._begin
        self.seen.machine = _machine(meter.worst())
        self._look_at_graph()
        self._collector.finish(self._neighbors())
        return self.seen

    def _neighbors(self) -> NeighborConfig:
        own = self.seen.value('relative_pose', 'neighbors_file', '')
        return load(own or resource('config/neighbors.yaml'))

    def _look(self) -> None:
        """Request the parameters of new nodes, and subscribe to new topics."""
        nodes = self._nodes()
        for node in OURS:
            full = full_name(node, self.seen.namespace)
            if node in self.seen.parameters or full not in nodes:
                continue
            if node not in self._remote:
                self._remote[node] = RemoteParameters(
                    self, full, partial(self._take_values, node))
            self._remote[node].ask()
            if node == 'relative_pose':
                self._names_of(full)
        published = dict(self.get_topic_names_and_types())
        for name in (*READ, *COUNTED):
            topic = self.seen.names[name]
            if topic not in self._subscribed and TYPES[name] in published.get(topic, ()):
                self._subscribed.add(topic)
                kind = message_class(TYPES[name])
                self.create_subscription(kind, topic, partial(self._take, name, topic),
                                         best_effort(50), raw=kind in READERS or name in COUNTED)
        self._look_for_poses(published)
        if '/clock' not in self._subscribed and self.count_publishers('/clock'):
            self._subscribed.add('/clock')
            self.create_subscription(Clock, '/clock', self._take_clock, best_effort(50))

    def _look_for_poses(self, published: Mapping[str, list[str]]) -> None:
        """Subscribe to the poses of other detectors, once the parameters have come."""
        if 'relative_pose' not in self.seen.parameters:
            return
        try:
            neighbors = self._neighbors().neighbors
        except (OSError, ValueError):  # raised again, and reported, at the end
            return
        for source in (n.source for n in neighbors if n.source is not None):
            topic = full_name(source.topic, self.seen.namespace) if source.topic else ''
            msgtype = next((each for each in POSE_TYPES if each in published.get(topic, ())), '')
            if msgtype and topic not in self._subscribed:
                self._subscribed.add(topic)
                self.create_subscription(message_class(msgtype), topic, partial(
                    self._take, POSES, topic), best_effort(50))

    def _names_of(self, relative_pose: str) -> None:
        """Read the names of our topics from the subscriptions of relative_pose."""
        namespace, _, name = relative_pose.rpartition('/')
        for topic, types in self.get_subscriber_names_and_types_by_node(name, namespace or '/'):
            ours = BY_TYPE.get(types[0])
            if ours is not None and ours not in self._remaps:
                self.seen.names[ours] = topic

    def _take_values(self, node: str, values: dict[str, Any]) -> None:
        """Keep the parameters of a node; with several cameras, those of the observed camera."""
        if CAMERAS in values:
            camera, values = select_camera(values, self._camera)
            topics = topics_of_camera(camera.image, camera.camera_info) if camera.name else {}
            self.seen.names.update({
                ours: full_name(topic, self.seen.namespace)
                for ours, topic in topics.items() if ours not in self._remaps})
        self.seen.parameters[node] = values

    def _nodes(self) -> list[str]:
        return sorted(f'{namespace.rstrip("/")}/{name}'
                      for name, namespace in self.get_node_names_and_namespaces()
                      if name != self.get_name())

    def _take_clock(self, message: Clock) -> None:
        self._simulated = stamp_to_nanoseconds(message.clock) / NANOSECONDS

    def _take(self, name: str, topic: str, message: Any, info: Any) -> None:
        if time.monotonic() < self._begin:
            return
        # The time of reception, not that of the callback: decoding an image takes a while.
        arrival = (self._simulated if self._simulated is not None
                   else (info['received_timestamp'] or time.time_ns()) / NANOSECONDS)
        if name in COUNTED or self.seen.names.get(name, topic) != topic:  # of another camera
            message = None
        elif isinstance(message, bytes):
            try:
                message = read_odometry(message)
            except ValueError:  # its arrival counts, without a stamp
                message = None
        self._collector.take(name, topic, message, arrival)

    def _look_at_graph(self) -> None:
        seen = self.seen
        seen.nodes = self._nodes()
        for topic, _ in self.get_topic_names_and_types():
            known = seen.topics.setdefault(topic, TopicSeen())
            known.publishers = [
                TopicEnd(f'{info.node_namespace.rstrip("/")}/{info.node_name}', info.topic_type)
                for info in self.get_publishers_info_by_topic(topic)
                if info.node_name != self.get_name()]
            if not known.publishers:
                del seen.topics[topic]


def find_processes(names: Collection[str] = OURS) -> Iterator[tuple[int, str, dict[str, str]]]:
    """Yield id, name and environment of our nodes on this computer, but not of other users'."""
    for folder in Path('/proc').glob('[0-9]*'):
        with suppress(OSError):  # ended meanwhile, or of another user
            words = _words(folder / 'cmdline')
            for node in names:
                if any(word.rsplit('/', 1)[-1].rsplit('.', 1)[-1] == node for word in words[:3]):
                    yield int(folder.name), node, dict(
                        entry.split('=', 1) for entry in _words(folder / 'environ')
                        if '=' in entry)


def _words(path: Path) -> list[str]:
    return path.read_bytes().decode(errors='replace').split('\0')


def _machine(load: Load | None) -> Machine:
    free = None
    if Path('/dev/shm').exists():
        room = os.statvfs('/dev/shm')
        free = room.f_bavail * room.f_frsize / 1e6
    return Machine(
        load, free, shared_memory_size(), os.environ.get('ROS_DOMAIN_ID', '0'), _find_reach(),
        len(dead_segments()))


def _find_reach() -> list[tuple[str, Reach | None]]:
    """Return which computers reach our nodes here, or ``check`` if none of our nodes is seen."""
    domain = os.environ.get('ROS_DOMAIN_ID', '0')
    ours = [(node, process) for process, node, environment in find_processes()
            if environment.get('ROS_DOMAIN_ID', '0') == domain]
    return [(node, find_reach(process, int(domain)))
            for node, process in ours or [('check', os.getpid())]]


def observe(seconds: float, namespace: str, remaps: dict[str, str], camera: str
            ) -> Observations:
    """
    Listen for some seconds, and return the observations; the arguments are those of `Observer`.

    :raises ValueError: for a camera that does not exist. :raises KeyboardInterrupt: on Ctrl-C.
    """
    seen: list[Observations] = []
    code = run(lambda: Observer(seconds, namespace, remaps, camera), ['check'],
               lambda node: seen.append(node.observe()))
    signal.setitimer(signal.ITIMER_REAL, 0.0)  # the deadline of a node's exit: judging follows
    if code:
        raise SystemExit(code)
    if not seen:
        raise KeyboardInterrupt
    return seen[0]
