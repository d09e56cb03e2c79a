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

"""All checks, in one form for a running system and for a bag."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from flock_follower.bags.bag import Bag, BagError, deserialize, open_bag
from flock_follower.bags.schedule import Gaps, MAX_GAP
from flock_follower.checks.collector import Collector, POSES
from flock_follower.checks.findings import Finding, without_consequences
from flock_follower.checks.flight_settings import check_settings
from flock_follower.checks.observations import Observations, OwnMotion, TopicEnd, TopicSeen
from flock_follower.checks.own_motion import check_own_motion
from flock_follower.checks.pictures import check_pictures
from flock_follower.checks.single_camera import select_camera
from flock_follower.checks.system import check_diagnostics, check_machine
from flock_follower.checks.topics import check_nodes, check_topics
from flock_follower.messages import NANOSECONDS
from flock_follower.messages.poses import POSE_TYPES
from flock_follower.messages.state_writer import ODOMETRY
from flock_follower.messages.topic_names import (
    COMPRESSED_IMAGES,
    full_name,
    images_by_type,
    names_there,
    RAW_IMAGES,
    topics_of_camera,
    TYPES,
)
from flock_follower.odometry.reader import OdometrySource, read_odometry, SourceParams
from flock_follower.parameters.spec import filled
from flock_follower.perception.markers import load
from flock_follower.system.files import resource

#: s: of a longer bag only the beginning is checked.
MAX_DURATION: Final = 300.0
DIAGNOSTICS: Final = '/diagnostics'
_IMAGES: Final = (RAW_IMAGES, COMPRESSED_IMAGES)
#: The topics to take, and their types.
TOPIC_TYPES: Final = {**{name: TYPES[name] for name in (*_IMAGES, 'odom', 'camera_info')},
                      DIAGNOSTICS: 'diagnostic_msgs/msg/DiagnosticArray'}


def judge_all(seen: Observations) -> list[Finding]:
    """
    Return the findings of every check, in the order in which they should be fixed.

    Findings that only result from another finding are left out.
    """
    if seen.live and not seen.nodes:
        return [check_nodes(seen)]
    return without_consequences(finding for check in (
        check_topics, check_pictures, check_own_motion, check_settings, check_machine,
        check_diagnostics)
        for finding in check(seen))


class RecordedSystem:
    """
    Takes the messages of a bag one by one, in order, and judges them.

    :param values: the parameters with which the bag is to be used, by node.
    :param camera: name of the camera to check if there are several; '': the first.
    :param remaps: names of topics in the bag, by our names, if they differ.
    :param own: the odometry, if the caller reads it anyway; None: it is read here.
    :raises ValueError: for a camera that does not exist, or a neighbors file that is wrong.
    :raises OSError: if the neighbors file cannot be read.
    """

    def __init__(self, bag: Bag, values: Mapping[str, dict[str, Any]], camera: str = '',
                 namespace: str = '', remaps: Mapping[str, str] | None = None,
                 own: OwnMotion | None = None) -> None:
        chosen, perception = select_camera(values['relative_pose'], camera)
        names = names_there(namespace, {
            **topics_of_camera(chosen.image, chosen.camera_info), **(remaps or {})})
        images_by_type(names, {name: topic.msgtype for name, topic in bag.topics.items()})
        self._own_motion = None if own else OwnMotion(
            OdometrySource(filled(SourceParams(), perception, 'odom_')))
        self.seen = Observations(
            live=False, source=str(bag.path), duration=bag.duration_ns / NANOSECONDS,
            namespace=namespace, names=names, incomplete=bag.incomplete,
            own=own or self._own_motion,
            parameters={**values, 'relative_pose': perception,
                        'planner': select_camera(values['planner'], camera)[1]},
            unreadable=dict(bag.skipped), topics={
                name: TopicSeen([TopicEnd('', topic.msgtype)])
                for name, topic in bag.topics.items() if topic.count})
        self._neighbors = load(perception['neighbors_file'] or resource('config/neighbors.yaml'))
        self._collector = Collector(self.seen, min(self.seen.duration, MAX_DURATION))
        self._gaps = Gaps()
        self._start_ns = bag.start_ns
        if bag.set_back_ns > MAX_GAP * NANOSECONDS:
            self.seen.set_back = bag.set_back_ns / NANOSECONDS
        names[DIAGNOSTICS] = DIAGNOSTICS
        self.topics = {names[name]: name for name, msgtype in TOPIC_TYPES.items()
                       if names[name] in self.seen.topics
                       and bag.topics[names[name]].msgtype == msgtype
                       and (name not in _IMAGES or name == self.seen.image_name)}
        """Our names of the topics to take, by their full names."""
        self.topics |= {full: POSES for n in self._neighbors.neighbors
                        if n.source is not None and n.source.topic
                        for full in [full_name(n.source.topic, namespace)]
                        if full in self.seen.topics
                        and bag.topics[full].msgtype in POSE_TYPES and full not in self.topics}

    def is_long_enough(self, time_ns: int) -> bool:
        """Return whether the check is complete at a time, ns: later messages are ignored."""
        return time_ns - self._start_ns - self._gaps.skipped_ns >= MAX_DURATION * NANOSECONDS

    def take(self, topic: str, msgtype: str, time_ns: int, data: bytes, message: Any = None
             ) -> Any:
        """
        Take a message; ignore messages of other topics, and messages after the checked time.

        Return the fields of the message if they were read. If the bytes are no message of the
        type, the bag is reported as incomplete.

        :param message: the fields, if they were read before.
        """
        name = self.topics.get(topic)
        if step := self._gaps.take(time_ns):
            self.seen.gaps.append((
                (time_ns - self._start_ns) / NANOSECONDS - step, step,
                any(self.seen.topic(each).arrivals for each in (self.seen.image_name, 'odom'))))
        if name is None or self.is_long_enough(time_ns):
            return message
        try:
            if message is None:
                message = read_odometry(data) if msgtype == ODOMETRY else deserialize(
                    data, msgtype)
        except ValueError as problem:
            self.seen.incomplete = self.seen.incomplete or f'{topic}: {problem}'
            return None
        if name == 'odom' and self._own_motion is not None:
            self._own_motion.take(message, time_ns)
        self._collector.take(name, topic, message, time_ns / NANOSECONDS)
        return message

    def findings(self) -> list[Finding]:
        """Return the findings of all messages taken."""
        self._collector.finish(self._neighbors)
        return judge_all(self.seen)


def check_bag(path: Path, values: Mapping[str, dict[str, Any]], camera: str = '',
              namespace: str = '', remaps: Mapping[str, str] | None = None
              ) -> tuple[Observations, list[Finding]]:
    """
    Return the observations in a bag and the findings; the arguments are those of RecordedSystem.

    :raises BagError: if the bag cannot be read at all.
    """
    with open_bag(path) as bag:
        system = RecordedSystem(bag, values, camera, namespace, remaps)
        # To its end the bag counts its messages: fewer than announced are reported.
        try:
            for message in bag.messages(list(system.topics)):
                system.take(*message)
                if system.is_long_enough(message.stamp_ns):
                    break
        except BagError as problem:
            system.seen.incomplete = system.seen.incomplete or str(problem)
    return system.seen, system.findings()
