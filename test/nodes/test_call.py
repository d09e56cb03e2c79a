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

from collections.abc import Iterator
from contextlib import suppress
import threading
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import SetBool, Trigger

from flock_follower.mavlink.commands import SLOWEST_CLIMB, TAKEOFF_DELAY
from flock_follower.nodes.call import main, patience


class Server:
    """A node with a service that counts its requests; it spins in a thread."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('server', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.asked: list[Any] = []
        self.thread = threading.Thread(target=self._spin)
        self.thread.start()

    def _spin(self) -> None:
        while self.context.ok():
            with suppress(Exception):  # rclpy cannot send the answer of a service that is gone
                self.executor.spin_once(timeout_sec=0.02)

    def serve(self, kind: Any, name: str, success: bool = True, message: str = 'done',
              vanish: bool = False) -> None:
        def answer(request: Any, response: Any) -> Any:
            self.asked.append(request)
            if vanish:
                self.node.destroy_service(service)
            response.success, response.message = success, message
            return response
        service = self.node.create_service(kind, name, answer)

    def close(self) -> None:
        self.context.try_shutdown()
        self.thread.join()
        self.executor.shutdown()
        self.node.destroy_node()


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def test_a_request_is_made_once_and_its_answer_shown(
        server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['late', 'false', '--timeout', '0.1']) == 1
    assert capsys.readouterr().err == (
        'error: /late: no such service of type SetBool within 0.1 s\n')
    threading.Timer(0.3, server.serve, (SetBool, 'late')).start()
    assert main(['late', 'false', '--timeout', '25']) == 0
    assert capsys.readouterr() == ('/late: done\n', '')
    server.serve(SetBool, 'offboard', success=False, message='the pilot has taken over')
    assert main(['offboard', 'true']) == 1
    assert capsys.readouterr().err == 'error: /offboard: the pilot has taken over\n'
    assert main(['offboard', '--timeout', '0.3']) == 1
    assert 'no such service of type Trigger' in capsys.readouterr().err
    assert [request.data for request in server.asked] == [False, True]
    server.serve(Trigger, 'takeoff', vanish=True)
    assert main(['takeoff']) == 1
    assert 'the result is unknown' in capsys.readouterr().err and len(server.asked) == 3


def test_it_waits_longer_than_any_service_takes() -> None:
    assert patience('/mavlink_bridge/takeoff') > TAKEOFF_DELAY + 30.0 / SLOWEST_CLIMB + 7.0
    assert 8.0 < patience('/mavlink_bridge/offboard') < 20.0
