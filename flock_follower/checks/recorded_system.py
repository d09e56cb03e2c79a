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

"""What a bag holds of a system, read as the node that listens reads what it hears."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from flock_follower.bags.bag import Bag, BagError, deserialize, open_bag
from flock_follower.checks.collector import Collector
from flock_follower.checks.observations import Observations, TopicEnd, TopicSeen
from flock_follower.checks.topic_names import (
    COMPRESSED_IMAGES,
    images_by_type,
    names_there,
    RAW_IMAGES,
    TYPES,
)
from flock_follower.messages import NANOSECONDS, stamp_to_nanoseconds
from flock_follower.perception.markers import NeighborConfig

#: Of a longer bag only the beginning is looked at, s.
LONGEST: Final = 300.0
DIAGNOSTICS: Final = '/diagnostics'


def observe_bag(path: Path, parameters: dict[str, dict[str, Any]], config: NeighborConfig,
                namespace: str = '', remaps: Mapping[str, str] | None = None) -> Observations:
    """
    Return what a bag holds.

    :param parameters: with which it is to be used, by node.
    :param config: whose markers to look for.
    :raises BagError: where the bag cannot be read at all.
    """
    with open_bag(path) as bag:
        names = names_there(namespace, remaps or {})
        images_by_type(names, {name: topic.msgtype for name, topic in bag.topics.items()})
        seen = Observations(
            live=False, source=str(path), duration=bag.duration_ns / NANOSECONDS,
            namespace=namespace, names=names, parameters=parameters, incomplete=bag.incomplete,
            unreadable=dict(bag.skipped), topics={
                name: TopicSeen([TopicEnd('', topic.msgtype, latched=topic.latched)])
                for name, topic in bag.topics.items() if topic.count})
        collector = Collector(seen, min(seen.duration, LONGEST))
        _collect(bag, seen, collector)
        collector.finish(config)
    return seen


def _collect(bag: Bag, seen: Observations, collector: Collector) -> None:
    wanted = {full: name for name, full in seen.names.items()
              if full in bag.topics and bag.topics[full].msgtype == TYPES[name]
              and bag.topics[full].count}
    if (told := bag.topics.get(DIAGNOSTICS)) is not None and told.count:
        wanted[DIAGNOSTICS] = 'diagnostics'
    if not wanted:
        return
    image = seen.image_name
    stop = bag.start_ns + round(LONGEST * NANOSECONDS)
    whole = bag.end_ns < stop
    try:
        for topic, msgtype, time, data in bag.messages(
                list(wanted), stop_ns=None if whole else stop):
            _take(collector, wanted[topic], image, topic, msgtype, time / NANOSECONDS, data)
    except BagError as problem:
        seen.incomplete = seen.incomplete or str(problem)


def _take(collector: Collector, name: str, image: str, topic: str, msgtype: str, time: float,
          data: bytes) -> None:
    if name in (RAW_IMAGES, COMPRESSED_IMAGES) and name != image:
        return
    message = deserialize(data, msgtype)
    header = getattr(message, 'header', None)
    stamp = 0.0 if header is None else stamp_to_nanoseconds(header.stamp) / NANOSECONDS
    collector.heard(topic, time, stamp)
    collector.take(name, message, time)
