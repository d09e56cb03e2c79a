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
Call a service for machines without the ``ros2`` command.

``call planner/engage true`` calls a SetBool, ``call mavlink_bridge/takeoff`` a Trigger.

Waits for the service to exist, at most ``--timeout``, calls it once, and shows its answer; exit
code 0 if it succeeded. A refused request is never repeated: between two of them a pilot may
have taken over.
"""

from __future__ import annotations

import argparse
from contextlib import suppress
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node, NodeNameNonExistentError
from std_srvs.srv import SetBool, Trigger

from flock_follower.mavlink.commands import (
    CONFIRM_TIMEOUT,
    REASON_WAIT,
    SLOWEST_CLIMB,
    STREAM_TIMEOUT,
    TAKEOFF_DELAY,
)
from flock_follower.nodes.support.runtime import run
from flock_follower.parameters.mavlink_bridge_table import SPECS

POLL_PERIOD = 0.1  # s between looks for the service
NOTICE = 2.0  # s without an answer after which the command says that it waits
MARGIN = 5.0  # s beyond what a service takes at the longest, for a busy machine
#: The longest that a service but take-off takes: stream, confirmation and the reason of a refusal.
LONGEST = STREAM_TIMEOUT + CONFIRM_TIMEOUT + REASON_WAIT
_HEIGHT = next(spec.range.high for spec in SPECS if spec.name == 'takeoff_height')
_TYPES = {'std_srvs/srv/SetBool': '{} true|false', 'std_srvs/srv/Trigger': '{}'}


def patience(service: str) -> float:
    """
    Return how long to wait for the answer of a service, s: longer than the service itself does.

    A take-off waits for the offboard mode first on ArduPilot, then for the climb.
    """
    climb = TAKEOFF_DELAY + _HEIGHT / SLOWEST_CLIMB if service.endswith('takeoff') else 0.0
    return LONGEST + climb + MARGIN


class Caller(Node):
    """Calls one service, once."""

    def __init__(self, service: str, value: bool | None, timeout: float) -> None:
        super().__init__('caller', start_parameter_services=False)
        self._service = service
        self._timeout = timeout
        kind = Trigger if value is None else SetBool
        self._type = f'std_srvs/srv/{kind.__name__}'
        self._request = Trigger.Request() if value is None else SetBool.Request(data=value)
        self._client = self.create_client(kind, service)
        self._name = self.resolve_service_name(service)

    def spin(self) -> int:
        """Call, print the answer, and return the exit code."""
        try:
            problem = self._wait_for_service() or self._call()
        except ExternalShutdownException:
            problem = 'interrupted'
        if not problem:
            return 0
        if not rclpy.ok():
            return 130
        print(f'error: {self._service}: {problem}', file=sys.stderr)
        return 1

    def _wait_for_service(self) -> str:
        """Wait until the service exists; return the problem, or ''."""
        deadline = time.monotonic() + self._timeout
        while rclpy.ok():
            types = self._types()
            if types and self._type not in types:
                return f'is a {", ".join(types)}: {self._how_to_call(types[0])}'
            if types and self._client.service_is_ready():
                return ''
            if time.monotonic() >= deadline:
                return f'no such service within {self._timeout:g} s: {self._name}'
            rclpy.spin_once(self, timeout_sec=POLL_PERIOD)
        return 'interrupted'

    def _types(self) -> list[str]:
        """Return the types of the service by its servers: the graph counts a client's, too."""
        types: list[str] = []
        for name, namespace in self.get_node_names_and_namespaces():
            with suppress(NodeNameNonExistentError):  # it ended meanwhile
                served = self.get_service_names_and_types_by_node(name, namespace)
                types += dict(served).get(self._name, [])
        return types

    def _how_to_call(self, kind: str) -> str:
        if kind in _TYPES:
            return f'call {_TYPES[kind].format(self._service)}'
        return (f'this command calls only SetBool and Trigger; '
                f'ros2 service call {self._name} {kind}')

    def _call(self) -> str:
        """Call once; print the answer if it is yes, else return the problem."""
        future = self._client.call_async(self._request)
        longest = patience(self._name)
        began = time.monotonic()
        noticed = False
        while rclpy.ok() and not future.done() and time.monotonic() < began + longest:
            rclpy.spin_until_future_complete(self, future, timeout_sec=POLL_PERIOD)
            if not future.done() and not self._client.service_is_ready():
                return 'the service went away without an answer: the result is unknown'
            if not noticed and not future.done() and time.monotonic() > began + NOTICE:
                noticed = True
                print(f'{self._service}: waiting for the answer, at most {longest:.0f} s',
                      file=sys.stderr, flush=True)
        if not rclpy.ok():
            return 'interrupted'
        if not future.done():
            return f'no answer within {longest:.0f} s: the result is unknown'
        if not future.result().success:
            return str(future.result().message)
        print(f'{self._service}: {future.result().message}')
        return ''


def main(args: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog='call', description='Call a SetBool or Trigger service once, and show its answer.')
    parser.add_argument('service', help='such as planner/engage')
    parser.add_argument('value', nargs='?', choices=['true', 'false'],
                        help='of a SetBool; none calls a Trigger')
    parser.add_argument('--timeout', type=float, default=5.0,
                        help='seconds to wait for the service to exist (default 5)')
    options, ros_args = parser.parse_known_args(args)
    value = None if options.value is None else options.value == 'true'
    return run(lambda: Caller(options.service, value, options.timeout),
               ros_args, spin=Caller.spin)


if __name__ == '__main__':
    sys.exit(main())
