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
The node of the command ``follow``: keys and reports in, service calls and a live line out.

``nodes.flight_steps`` decides which call is due. The node subscribes ``/diagnostics``,
``mavlink_bridge/state``, ``planner/distance`` and ``mavlink/battery``, and calls the services of
``planner`` and ``mavlink_bridge``. SIGINT, SIGTERM, SIGHUP and a closed terminal brake and hand
over: the node handles the signals itself, so that ROS runs until the services have answered.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import math
import os
import select
import signal
import sys
import termios
import time
import tty
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Range
from std_msgs.msg import String

from flock_follower.bags.live_line import LiveLine
from flock_follower.nodes.call import patience
from flock_follower.nodes.flight_steps import (
    DISCOVERY,
    Flight,
    INTERRUPTED,
    loopback,
    Reports,
    SERVICES,
)
from flock_follower.nodes.support.diagnostics import internal_error
from flock_follower.nodes.support.inputs import best_effort, LATCHED_QOS
from flock_follower.nodes.support.output import never_block_output
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.remote_parameters import RemoteParameters
from flock_follower.nodes.support.service_calls import make_request, service_type
from flock_follower.signals import ending

POLL_PERIOD = 0.05  # s between looks at keys and answers


class Pilot(Node):
    """
    Flies by keys.

    :param confirm: False: no keys (``--yes``), for an autopilot on this machine only.
    :param ready: False if ``check`` forbids a flight: then the node only lands or hands over.
    """

    def __init__(self, namespace: str, confirm: bool, ready: bool) -> None:
        super().__init__('follow', namespace=namespace, start_parameter_services=False)
        self._reports, self._flight = Reports(), Flight(time.monotonic(), confirm, ready)
        self._confirm = confirm
        self._signals: list[int] = []
        self._keyboard = True
        self._line = LiveLine()
        self._calls: dict[str, tuple[Any, float]] = {}
        self._callers = {step: self.create_client(service_type(value), service)
                         for step, (service, value) in SERVICES.items()}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._take, 50)
        self.create_subscription(String, 'mavlink_bridge/state', self._take_state, LATCHED_QOS)
        self.create_subscription(Range, 'planner/distance', self._take_distance, best_effort())
        self.create_subscription(
            BatteryState, 'mavlink/battery', self._take_battery, best_effort())

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            space, _, node = f'/{status.name}'.rpartition('/')
            if space == self.get_namespace().rstrip('/'):
                self._reports.nodes[node] = time.monotonic(), {
                    pair.key: pair.value for pair in status.values}

    def _take_state(self, message: String) -> None:
        self._reports.bridge = message.data

    def _take_distance(self, message: Range) -> None:
        self._reports.distance = (
            time.monotonic(), f'{message.header.frame_id} {message.range:.2f} m')

    def _take_battery(self, message: BatteryState) -> None:
        known = math.isfinite(message.percentage)
        self._reports.battery = f'battery {100.0 * message.percentage:.0f} %' if known else ''

    def spin(self) -> int:
        """Fly, and return the exit code."""
        for number in ending():
            # No more than that: the interrupted code may hold a lock that a call needs.
            signal.signal(number, lambda number, _: self._signals.append(number))
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        if not self._confirm and (refused := self._real_vehicle(executor)):
            print(f'error: {refused}', file=sys.stderr)
            return 1
        with _single_keys():
            while self._flight.code is None:
                try:
                    executor.spin_once(timeout_sec=POLL_PERIOD)
                    self._turn(time.monotonic())
                except Exception as error:  # a second one ends the command
                    self._flight.lines.append(internal_error(error))
                    self._request(self._flight.end(1, self._reports))
        return self._flight.code

    def _real_vehicle(self, executor: SingleThreadedExecutor) -> str:
        """Return the reason if the bridge's ``connection`` may lead to a real autopilot, or ''."""
        bridge, asked = RemoteParameters(self, 'mavlink_bridge'), False
        end = time.monotonic() + DISCOVERY
        while bridge.values is None and not self._signals:
            if time.monotonic() > end:
                return 'missing: mavlink_bridge, whose connection --yes must know'
            executor.spin_once(timeout_sec=POLL_PERIOD)
            asked = asked or bridge.ask()
        connection = str((bridge.values or {}).get('connection', 'unknown'))
        return '' if loopback(connection) else (
            f'--yes: connection = {connection!r} of mavlink_bridge: must be a loopback address, '
            'such as udpin:127.0.0.1:14540 of a simulator')

    def _turn(self, now: float) -> None:
        received, self._signals = self._signals, []
        for number in received:  # a logout sends several: only Ctrl-C, pressed again, insists
            self._request(self._flight.end(
                INTERRUPTED, self._reports, insist=number == signal.SIGINT))
        if self._keyboard:
            self._take_keys()
        self._take_answers(now)
        self._request(self._flight.step(self._reports, now))
        self._show(now)

    def _take_keys(self) -> None:
        """Take keys; a closed terminal brakes and hands over."""
        try:
            if not select.select([0], [], [], 0.0)[0]:
                return
            keys = os.read(0, 64)
        except OSError:
            keys = b''
        for key in keys.decode('ascii', 'replace'):
            self._request(self._flight.press(key, self._reports))
        self._keyboard = bool(keys)
        if not keys and self._confirm:  # --yes needs no keyboard
            self._flight.lines.append('the terminal is closed')
            self._request(self._flight.end(INTERRUPTED, self._reports, insist=False))

    def _request(self, steps: list[str]) -> None:
        for step in steps:
            service, value = SERVICES[step]
            request = make_request(value)
            self._calls[step] = (self._callers[step].call_async(request),
                                 time.monotonic() + patience(service))

    def _take_answers(self, now: float) -> None:
        for step, (future, end) in list(self._calls.items()):
            if future.done():
                success, message = future.result().success, future.result().message
            elif now > end or not self._callers[step].service_is_ready():
                success, message = False, f'{step}: no answer of {SERVICES[step][0]}'
            else:
                continue
            del self._calls[step]
            self._request(self._flight.answer(step, success, message, self._reports, now))

    def _show(self, now: float) -> None:
        """Print; ignore errors of the terminal, which must not prevent the handover."""
        with contextlib.suppress(OSError):
            for line in self._flight.lines:
                self._line.print_above(line)
            self._flight.lines.clear()
            if self._line.due(now):
                self._line.show(self._reports.line(now))


@contextlib.contextmanager
def _single_keys() -> Iterator[None]:
    """Set the terminal to deliver each key at once, without Enter."""
    if not os.isatty(0):
        yield
        return
    before = termios.tcgetattr(0)
    tty.setcbreak(0)
    try:
        yield
    finally:
        with contextlib.suppress(termios.error):  # it is closed
            termios.tcsetattr(0, termios.TCSANOW, before)


def fly(namespace: str, confirm: bool = True, ready: bool = True) -> int:
    """Run the node in a namespace, and return the exit code."""
    never_block_output()  # a stopped terminal must not prevent the handing over
    return run(lambda: Pilot(namespace, confirm, ready), ['follow'], Pilot.spin)
