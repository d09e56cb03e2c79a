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

"""A topic that only one node may publish: finds its publishers and their parameter files."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import Final

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.subscription import Subscription

from flock_follower.nodes.support.diagnostics import ERROR, Problem
from flock_follower.nodes.support.inputs import best_effort
from flock_follower.parameters.sections import listed_files, PARAMETER_FILES

SEVERAL: Final[str] = 'only one may publish'
#: DDS lists a node that was killed until its lease ends.
KILLED: Final[str] = 'a killed one is listed for up to 20 s'


class SolePublisher:
    """
    Finds several publishers of a topic.

    Only while there are several publishers, ``/diagnostics`` is subscribed, where each of our
    nodes reports its parameter files. The executor's thread calls the methods.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._files: defaultdict[str, list[str]] = defaultdict(list)
        self._reports: Subscription | None = None

    def conflict(self) -> str:
        """Return the publishers of the topic if there are several, or ''."""
        names = self._names()
        if len(names) < 2:
            if self._reports is not None:
                self._node.destroy_subscription(self._reports)
                self._reports = None
                self._files.clear()
            return ''
        if self._reports is None:
            self._reports = self._node.create_subscription(
                DiagnosticArray, '/diagnostics', self._take, best_effort(50))
        return f'{len(names)} publishers: {self.publishers()}; {SEVERAL} ({KILLED})'

    def problem(self, _: float) -> Problem | None:
        """Return the conflict as an error."""
        conflict = self.conflict()
        return (ERROR, conflict) if conflict else None

    def publishers(self) -> str:
        """Return the nodes that publish, each once, and the topic."""
        names = (f'{name}{self._details(name, count)}'
                 for name, count in sorted(Counter(self._names()).items()))
        return f'{", ".join(names)} on {self._topic}'

    def _names(self) -> list[str]:
        """Return the full name of the node of each publisher."""
        return ['(no name yet)' if 'UNKNOWN' in end.node_name else
                f'{end.node_namespace.rstrip("/")}/{end.node_name}'
                for end in self._node.get_publishers_info_by_topic(self._topic)]

    def _details(self, name: str, count: int) -> str:
        files = self._files.get(name, [])
        return (f' ({count} times)' if count > 1 else '') + (
            f' {listed_files(files)}' if files else '')

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            known = self._files[f'/{status.name}']
            known += [pair.value for pair in status.values
                      if pair.key == PARAMETER_FILES and pair.value not in known]
