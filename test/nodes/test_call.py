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

from collections.abc import Callable, Iterator
import subprocess
import sys
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from flock_desk.runs.processes import wait_until
from flock_follower.mavlink.commands import SLOWEST_CLIMB, TAKEOFF_DELAY
from flock_follower.nodes.call import patience


class Server:
    """A node with services that count how often they are asked, and the command as a process."""

    def __init__(self) -> None:
        self.node = Node('server')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.asked: list[Any] = []
        self.processes: list[subprocess.Popen[str]] = []

    def serve(self, kind: Any, name: str, success: bool = True, message: str = 'done') -> None:
        def answer(request: Any, response: Any) -> Any:
            self.asked.append(request)
            response.success, response.message = success, message
            return response
        self.service = self.node.create_service(kind, name, answer)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, '-m', 'flock_follower.nodes.call', *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.processes.append(process)
        return process

    def until(self, condition: Callable[[], bool], what: str) -> None:
        def look() -> bool:
            self.executor.spin_once(timeout_sec=0.02)
            return condition()
        wait_until(look, 30.0, what)

    def call(self, *arguments: str) -> tuple[int, str, str]:
        process = self.start(*arguments)
        self.until(lambda: process.poll() is not None, 'the command to end')
        out, error = process.communicate()
        assert 'Traceback' not in error
        return process.returncode, out, error

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.communicate()
        self.executor.shutdown()
        self.node.destroy_node()


@pytest.fixture
def server(ros: None) -> Iterator[Server]:
    assert rclpy.ok()
    made = Server()
    yield made
    made.close()


def test_a_request_is_made_once_and_its_answer_shown(server: Server) -> None:
    server.serve(SetBool, 'bridge/offboard', success=False, message='the pilot has taken over')
    assert server.call('bridge/offboard', 'true') == (
        1, '', 'error: bridge/offboard: the pilot has taken over\n')
    assert [request.data for request in server.asked] == [True]
    code, _, error = server.call('bridge/offboard')
    assert code == 1 and 'is a std_srvs/srv/SetBool: call bridge/offboard true|false' in error
    assert len(server.asked) == 1


def test_a_service_that_comes_late_is_waited_for(server: Server) -> None:
    process = server.start('late', 'false', '--timeout', '25')
    names = server.node.get_node_names
    server.until(lambda: 'caller' in names(), 'the command to run')
    server.serve(SetBool, 'late')
    server.until(lambda: process.poll() is not None, 'an answer')
    assert process.returncode == 0 and [r.data for r in server.asked] == [False]
    assert process.communicate()[0] == 'late: done\n'


def test_a_service_that_does_not_exist_is_told_after_the_timeout(server: Server) -> None:
    assert server.call('nowhere', '--timeout', '0.5') == (
        1, '', 'error: nowhere: no such service within 0.5 s: /nowhere\n')


def test_a_service_that_dies_while_it_is_asked_is_told_at_once(server: Server) -> None:
    def vanish(request: Any, response: Any) -> Any:
        server.asked.append(request)
        server.node.destroy_service(server.service)
        return response
    server.service = server.node.create_service(Trigger, 'takeoff', vanish)
    process = server.start('takeoff')

    def ended() -> bool:
        try:
            server.executor.spin_once(timeout_sec=0.02)
        except Exception:  # rclpy cannot send the answer of a service that is gone
            assert server.asked
        return process.poll() is not None
    wait_until(ended, 30.0, 'the command to end')
    assert process.returncode == 1 and 'went away' in process.communicate()[1]
    assert len(server.asked) == 1


def test_it_waits_longer_than_any_service_takes() -> None:
    assert patience('/mavlink_bridge/takeoff') > TAKEOFF_DELAY + 30.0 / SLOWEST_CLIMB + 7.0
    assert 8.0 < patience('/mavlink_bridge/offboard') < 20.0
