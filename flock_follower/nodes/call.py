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
Call a service on a machine without the ``ros2`` command.

``call planner/engage true`` calls a SetBool, ``call mavlink_bridge/takeoff`` a Trigger.

The command waits for the service, at most ``--timeout``, calls the service once, and prints the
answer; the exit code is 0 if the call succeeded. A refused request is never repeated, because a
pilot may have taken over meanwhile.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
import difflib
import sys
import time

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from flock_follower.mavlink.commands import (
    CONFIRM_TIMEOUT,
    REASON_WAIT,
    SLOWEST_CLIMB,
    STREAM_TIMEOUT,
    TAKEOFF_DELAY,
)
from flock_follower.mavlink.parameter_table import MAVLINK_BRIDGE
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.service_calls import make_request, service_type

POLL_PERIOD = 0.1  # s between looks for the service
MARGIN = 5.0  # s beyond what a service takes at the longest, for a busy machine
#: The longest that a service but take-off takes: stream, confirmation and the reason of a refusal.
LONGEST = STREAM_TIMEOUT + CONFIRM_TIMEOUT + REASON_WAIT
#: The services of our nodes, in no namespace.
OUR_SERVICES = ('/planner/engage', *(f'/mavlink_bridge/{name}' for name in (
    'arm', 'offboard', 'takeoff', 'land')), '/replay/pause')
_HEIGHT = next(spec.range.high for spec in MAVLINK_BRIDGE if spec.name == 'takeoff_height')


def patience(service: str) -> float:
    """
    Return how long to wait for the answer of a service, s: longer than the service needs.

    A take-off waits for the climb; on ArduPilot it first waits for the offboard mode.
    """
    climb = TAKEOFF_DELAY + _HEIGHT / SLOWEST_CLIMB if service.endswith('takeoff') else 0.0
    return LONGEST + climb + MARGIN


def proposal(service: str, there: Iterable[str]) -> str:
    """Return the text "did you mean ...?", or ''; ``there`` has the full names of all services."""
    last = service.rpartition('/')[2]
    known = {*there, *OUR_SERVICES}
    meant = sorted(name for name in known if name.rpartition('/')[2] == last and name != service)
    meant = meant or difflib.get_close_matches(service, known - {service}, n=1)
    return f'; did you mean {" or ".join(name.lstrip("/") for name in meant)}?' if meant else ''


class Caller(Node):
    """Calls one service, once."""

    def __init__(self, service: str, value: bool | None, timeout: float) -> None:
        super().__init__('caller', start_parameter_services=False)
        self._service, self._timeout = self.resolve_service_name(service), timeout
        self._kind, self._request = service_type(value), make_request(value)
        self._client = self.create_client(self._kind, service)

    def spin(self) -> int:
        """Call, print the answer, and return the exit code."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        try:
            success, answer = self._call(executor)
        except (ExternalShutdownException, KeyboardInterrupt):
            return 130
        finally:
            executor.shutdown(timeout_sec=0.5)
        print(f'{"" if success else "error: "}{self._service}: {answer}',
              file=sys.stdout if success else sys.stderr)
        return 0 if success else 1

    def _call(self, executor: SingleThreadedExecutor) -> tuple[bool, str]:
        """Wait for the service, call it once, and return its answer or the failure."""
        deadline = time.monotonic() + self._timeout
        while not self._client.service_is_ready():
            if time.monotonic() >= deadline:
                there = [name for name, kinds in self.get_service_names_and_types()
                         if f'std_srvs/srv/{self._kind.__name__}' in kinds]
                return False, (f'no such service of type {self._kind.__name__} within '
                               f'{self._timeout:g} s{proposal(self._service, there)}')
            executor.spin_once(timeout_sec=POLL_PERIOD)
        future = self._client.call_async(self._request)
        deadline = time.monotonic() + patience(self._service)
        while not future.done():
            if time.monotonic() >= deadline or not self._client.service_is_ready():
                return False, 'no answer: the result is unknown'
            executor.spin_once(timeout_sec=POLL_PERIOD)
        return future.result().success, future.result().message


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
