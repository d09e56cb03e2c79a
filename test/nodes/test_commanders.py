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

"""Who commands, as the bridge is told it: names of the graph, which may come late."""

from __future__ import annotations

from typing import Any

import pytest

from flock_follower.nodes.support import commanders
from flock_follower.nodes.support.commanders import Commanders, LOOKS
from flock_follower.nodes.support.diagnostics import UNNAMED

TOPIC = '/command/trajectory'


class Graph:
    """What Commanders asks of a node and of the graph."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.names = ['/planner', '/other']
        self.told: list[str] = []
        self.logged: list[str] = []
        self.looks = False
        monkeypatch.setattr(commanders, 'publishers', lambda node, topic: self.names)
        self.commanders = Commanders(
            self, 'command/trajectory',  # type: ignore[arg-type]
            lambda level, text: self.logged.append(text), self.told.append)

    def create_timer(self, period: float, callback: Any, clock: Any) -> Graph:
        self.look = callback
        return self

    def reset(self) -> None:
        self.looks = True

    def cancel(self) -> None:
        self.looks = False

    def resolve_topic_name(self, topic: str) -> str:
        return f'/{topic}'

    def hear(self, number: int | None, now: float) -> None:
        self.commanders.heard(
            {'publication_sequence_number': number, 'received_timestamp': 0}, now)

    def both(self) -> None:
        self.hear(7, 1.0)
        self.hear(1, 1.05)


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    return Graph(monkeypatch)


def test_two_that_command_are_named_each_once(graph):
    graph.hear(7, 1.0)
    assert graph.told == []
    graph.names = ['/planner', '/other', '/planner']
    graph.hear(1, 1.05)
    assert graph.told == [f'/other, /planner (2 times) on {TOPIC}'] and not graph.looks


def test_who_has_no_name_yet_is_told_again_with_it(graph):
    graph.names = ['/planner', UNNAMED]
    graph.both()
    assert graph.told == [f'{UNNAMED}, /planner on {TOPIC}'] and graph.looks
    graph.look()
    assert len(graph.told) == 1 and graph.looks
    graph.names = ['/planner', '/other']
    graph.look()
    assert graph.told[1:] == [f'/other, /planner on {TOPIC}'] and not graph.looks


@pytest.mark.parametrize('names', [['/planner'], ['/planner', UNNAMED]])
def test_who_goes_or_stays_without_a_name_is_not_told_again(graph, names):
    graph.names = ['/planner', UNNAMED]
    graph.both()
    graph.names = names
    for _ in range(LOOKS):
        assert graph.looks
        graph.look()
        if len(names) == 1:
            break
    assert not graph.looks and len(graph.told) == 1


def test_the_graph_is_not_asked_at_every_message_of_a_flood(graph):
    for k in range(100):
        graph.hear(100 + k, 1.0 + 2e-4 * k)
        graph.hear(1 + k, 1.0 + 2e-4 * k + 1e-4)
    assert len(graph.told) == 1


def test_a_middleware_that_numbers_no_messages_is_told_once(graph):
    for k in range(3):
        graph.hear(None, 0.1 * k)
    assert graph.told == [] and len(graph.logged) == 1 and 'does not brake' in graph.logged[0]
