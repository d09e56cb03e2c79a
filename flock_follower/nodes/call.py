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

Repeats a refused call until it succeeds or ``--timeout`` has passed; exit code 0 on success.
"""

from __future__ import annotations

import argparse
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from flock_follower.nodes.runtime import run

PAUSE = 0.2  # s between a refusal and the next try


class Caller(Node):
    """Calls one service until it says yes."""

    def __init__(self, service: str, value: bool | None, timeout: float) -> None:
        super().__init__('caller', start_parameter_services=False)
        self._service = service
        kind = Trigger if value is None else SetBool
        self._request = Trigger.Request() if value is None else SetBool.Request(data=value)
        self._deadline = time.monotonic() + timeout
        self._client = self.create_client(kind, service)

    def spin(self) -> int:
        """Call until it succeeds or the deadline passes; return the exit code."""
        try:
            return self._call()
        except ExternalShutdownException:
            return 130

    def _call(self) -> int:
        answer = f'no such service within the time given: {self._client.srv_name}'
        while rclpy.ok() and (left := self._deadline - time.monotonic()) > 0:
            if not self._client.wait_for_service(timeout_sec=min(left, 0.2)):
                continue
            future = self._client.call_async(self._request)
            rclpy.spin_until_future_complete(self, future, timeout_sec=max(left, 0.0))
            response = future.result() if future.done() else None
            answer = response.message if response else 'no answer'
            if response and response.success:
                print(f'{self._service}: {answer}')
                return 0
            time.sleep(PAUSE)
        print(f'error: {self._service}: {answer}', file=sys.stderr)
        return 1


def main(args: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(prog='call', description='Call a SetBool or Trigger service.')
    parser.add_argument('service', help='such as planner/engage')
    parser.add_argument('value', nargs='?', choices=['true', 'false'],
                        help='of a SetBool; none calls a Trigger')
    parser.add_argument('--timeout', type=float, default=5.0, help='seconds (default 5)')
    options, ros_args = parser.parse_known_args(args)
    value = None if options.value is None else options.value == 'true'
    return run(lambda: Caller(options.service, value, options.timeout),
               [sys.argv[0], *ros_args], spin=Caller.spin)


if __name__ == '__main__':
    sys.exit(main())
