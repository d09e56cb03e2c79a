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

"""The observations in a bag: the checks judge them as those of a running system."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from flock_follower.bags.bag import Bag, BagError, deserialize, open_bag
from flock_follower.checks.collector import Collector
from flock_follower.checks.every_check import judge_all
from flock_follower.checks.findings import Finding
from flock_follower.checks.observations import Observations, OwnMotion, TopicEnd, TopicSeen
from flock_follower.checks.topic_names import (
    COMPRESSED_IMAGES,
    images_by_type,
    names_there,
    RAW_IMAGES,
    topics_of_camera,
    TYPES,
)
from flock_follower.files import resource
from flock_follower.messages import NANOSECONDS, ODOMETRY
from flock_follower.odometry.cdr import read_odometry
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.parameters.cameras_table import alone
from flock_follower.parameters.spec import filled
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import load

#: s: of a longer bag only the beginning is checked, and the diagnostics of the last LAST ns.
LONGEST: Final = 300.0
LAST: Final = 60_000_000_000
DIAGNOSTICS: Final = '/diagnostics'
_IMAGES: Final = (RAW_IMAGES, COMPRESSED_IMAGES)
#: Of the other topics only the messages are counted.
READ: Final = (*_IMAGES, 'odom', 'camera_info', 'mavlink/odom', DIAGNOSTICS)
_AFTER_STAMP: Final = 12  # bytes: CDR's header, and the stamp


class RecordedSystem:
    """
    Takes the messages of a bag one by one, in order, and judges them.

    :param values: the parameters with which the bag is to be used, by node.
    :param camera: the one of several to check; '': the first.
    :param remaps: names of topics in the bag, by ours, if they differ.
    :param own: filled by the caller, who reads the odometry anyway; None: it is read here.
    :raises ValueError: for a camera that does not exist, or a neighbours file that is wrong.
    :raises OSError: if the neighbours file cannot be read.
    """

    def __init__(self, bag: Bag, values: Mapping[str, dict[str, Any]], camera: str = '',
                 namespace: str = '', remaps: Mapping[str, str] | None = None,
                 own: OwnMotion | None = None) -> None:
        chosen, perception = alone(values['relative_pose'], camera)
        names = names_there(namespace, {
            **topics_of_camera(chosen.image, chosen.camera_info), **(remaps or {})})
        images_by_type(names, {name: topic.msgtype for name, topic in bag.topics.items()})
        self._reads = own is None
        self._own = own or OwnMotion(OdometrySource(filled(SourceParams(), perception, 'odom_')))
        self.seen = Observations(
            live=False, source=str(bag.path), duration=bag.duration_ns / NANOSECONDS,
            namespace=namespace, names=names, incomplete=bag.incomplete, own=self._own,
            parameters={**values, 'relative_pose': perception,
                        'planner': alone(values['planner'], camera)[1]},
            unreadable=dict(bag.skipped), topics={
                name: TopicSeen([TopicEnd('', topic.msgtype, latched=topic.latched)])
                for name, topic in bag.topics.items() if topic.count})
        self._neighbors = load(perception['neighbors_file'] or resource('config/neighbors.yaml'))
        self._collector = Collector(self.seen, min(self.seen.duration, LONGEST))
        self._calibration = b''
        self.stop_ns = bag.start_ns + round(LONGEST * NANOSECONDS)
        """What comes later is not checked."""
        self.topics = {full: name for name, full in names.items()
                       if full in self.seen.topics and bag.topics[full].msgtype == TYPES[name]
                       and (name not in _IMAGES or name == self.seen.image_name)}
        """Our names of the topics to take, by their full names."""
        if DIAGNOSTICS in self.seen.topics:
            self.topics[DIAGNOSTICS] = DIAGNOSTICS

    def take(self, topic: str, msgtype: str, time_ns: int, data: bytes
             ) -> tuple[Any, GrayImage | None]:
        """
        Take a message; one of another topic, or one that comes too late, is ignored.

        Return its fields if they were read, and the pixels of an image if decoded. If the bytes
        are no message of the type, the bag is reported as incomplete.
        """
        name = self.topics.get(topic)
        if name is None or time_ns >= self.stop_ns:
            return None, None
        message: Any = None
        repeated = name == 'camera_info' and data[_AFTER_STAMP:] == self._calibration
        if name in READ and not repeated:
            try:
                message = read_odometry(data) if msgtype == ODOMETRY else (
                    deserialize(data, msgtype))
            except ValueError as problem:
                if name == 'odom' and self._reads:
                    self._own.lost, self._own.last_error = self._own.lost + 1, str(problem)
                self.seen.incomplete = self.seen.incomplete or f'{topic}: {problem}'
                return None, None
        if name == 'camera_info':
            self._calibration = data[_AFTER_STAMP:]
        elif name == 'odom' and self._reads:
            self._own.take(message, time_ns)
        return message, self._collector.take(name, topic, message, time_ns / NANOSECONDS)

    def findings(self) -> list[Finding]:
        """Return the findings in all messages that were taken."""
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
        whole = bag.end_ns < system.stop_ns
        try:
            if system.topics:
                for message in bag.messages(
                        list(system.topics), stop_ns=None if whole else system.stop_ns):
                    system.take(*message)
            if not whole and DIAGNOSTICS in system.topics:  # those of the end count
                system.stop_ns = bag.end_ns + 1
                for message in bag.messages([DIAGNOSTICS], bag.end_ns - LAST, system.stop_ns):
                    system.take(*message)
        except BagError as problem:
            system.seen.incomplete = system.seen.incomplete or str(problem)
    return system.seen, system.findings()
