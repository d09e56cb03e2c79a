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

"""The command that calls a service: once, and as long as the service takes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.task import Future

from flock_follower.mavlink.commands import SLOWEST_CLIMB, TAKEOFF_DELAY
from flock_follower.nodes import call


class Client:
    """A service that appears after some looks, and answers, or dies when it is called."""

    def __init__(self, looks: int, success: bool | None) -> None:
        self.looks, self.success, self.asked = looks, success, []

    def service_is_ready(self) -> bool:
        self.looks -= 1
        return self.looks < 0 and not (self.asked and self.success is None)

    def call_async(self, request: Any) -> Future:
        self.asked.append(request.data)
        future = Future()
        if self.success is not None:
            future.set_result(SimpleNamespace(success=self.success, message='because'))
        return future


@pytest.mark.parametrize(('looks', 'success', 'code', 'said', 'asked'), [
    (1, True, 0, '/offboard: because', 1), (0, False, 1, 'error: /offboard: because', 1),
    (10**9, True, 1, 'error: /offboard: no such service of type SetBool within 0.2 s; '
     'did you mean mavlink_bridge/offboard?', 0),
    (0, None, 1, 'error: /offboard: no answer: the result is unknown', 1)])
def test_a_request_is_made_once_and_its_answer_shown(
        monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], looks: int,
        success: bool | None, code: int, said: str, asked: int) -> None:
    client = Client(looks, success)
    monkeypatch.setattr(Node, 'create_client', lambda *_: client)
    assert call.main(['offboard', 'true', '--timeout', '0.2']) == code
    assert ''.join(capsys.readouterr()).strip() == said
    assert client.asked == [True] * asked


@pytest.mark.parametrize(('service', 'there', 'meant'), [
    ('/engage', [], 'planner/engage'), ('/land', [], 'mavlink_bridge/land'),
    ('/planner/engage', ['/drone1/planner/engage'], 'drone1/planner/engage'),
    ('/planer/engag', [], 'planner/engage'), ('/planner/engage', [], ''),
    ('/something/else', [], '')])
def test_a_service_named_without_its_node_gets_a_proposal(
        service: str, there: list[str], meant: str) -> None:
    assert call.proposal(service, there) == (f'; did you mean {meant}?' if meant else '')


def test_it_waits_longer_than_any_service_takes() -> None:
    assert call.patience('/mavlink_bridge/takeoff') > TAKEOFF_DELAY + 30.0 / SLOWEST_CLIMB + 7.0
    assert 8.0 < call.patience('/mavlink_bridge/offboard') < 20.0
