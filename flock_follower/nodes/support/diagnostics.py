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
The diagnostics of a node: rates, latencies, and a counter per reason of rejection.

Published at 1 Hz on ``/diagnostics`` (REP-107) by a steady timer, so that a node reports even if
its clock or its inputs have stopped.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
import os
import time
import traceback
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import qos_check_compatible, QoSCompatibility, QoSProfile

from flock_follower.system.fast_dds import opened_segment_names, undelivered

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
LOG_PERIOD = 5.0  # s between two log lines of the same reason
ERROR_SHOWN = 5.0  # s for which the status shows an internal error
WINDOW = 5.0  # s over which rates are means
LATENCIES = 1000  # durations of which percentiles are shown
SILENCE = 2.0  # s without a message of a required topic that is reported
#: The clock of timers that setting the system clock must not stop.
STEADY: Final = Clock(clock_type=ClockType.STEADY_TIME)
Problem = tuple[bytes, str]


def internal_error(error: Exception, where: str = '') -> str:
    """Return the text of an unexpected exception: its type and message."""
    return f'internal error{where and f" {where}"}: {type(error).__name__}: {error}'


class Rate:
    """The rate of events within the last WINDOW, and their number."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()
        self.count = 0

    def tick(self, now: float) -> None:
        """Record an event at ``now``, s on a monotonic clock."""
        self.count += 1
        self._times.append(now)
        while now - self._times[0] > WINDOW:
            self._times.popleft()

    def hertz(self, now: float) -> float:
        """Return the mean rate, Hz, over the window before ``now``."""
        recent = [t for t in self._times if now - t <= WINDOW]
        if len(recent) < 2 or now - recent[-1] > WINDOW / 2:
            return 0.0
        return (len(recent) - 1) / max(recent[-1] - recent[0], 1e-9)


def percentiles(name: str, durations: Collection[float]) -> dict[str, str]:
    """Return ``{NAME_p50_ms: ..., NAME_p95_ms: ..., NAME_p99_ms: ...}`` of durations, s."""
    points = np.percentile([*durations], [50, 95, 99]) if durations else ()
    return {f'{name}_p{p}_ms': f'{1e3 * v:.1f}' for p, v in zip((50, 95, 99), points)}


class Input:
    """
    One subscribed topic; finds the reason why no message arrives.

    :param required: whether silence is a fault. :param sporadic: whether silence is no fault
        while there is a publisher.
    """

    def __init__(self, node: Node, topic: str, type_name: str, qos: QoSProfile, required: bool,
                 sporadic: bool) -> None:
        self._node, self._type_name, self._qos = node, type_name, qos
        self._required, self._sporadic = required, sporadic
        self._since = time.monotonic()
        self.topic = node.resolve_topic_name(topic)
        self.rate = Rate()

    def arrived(self) -> None:
        """Record the arrival of a message."""
        self._since = time.monotonic()
        self.rate.tick(self._since)

    def problem(self, now: float) -> Problem | None:
        """Return why a required topic has been silent for longer than SILENCE, or None."""
        silent = now - self._since
        reason = self._reason() if self._required and silent > SILENCE else ''
        if not reason:
            return None
        return ERROR, f'no {self.topic} for {silent:.0f} s: {reason}'

    def _reason(self) -> str:
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        if not publishers:
            return 'no publisher'
        other_types = {p.topic_type for p in publishers} - {self._type_name}
        if other_types:
            return f'published as {", ".join(sorted(other_types))}, wanted {self._type_name}'
        for publisher in publishers:
            verdict, why = qos_check_compatible(publisher.qos_profile, self._qos)
            if verdict == QoSCompatibility.ERROR:
                return f'QoS mismatch with {publisher.node_name}: {why}'
        if self._sporadic:
            return ''
        fault = undelivered(opened_segment_names(), os.getuid())
        return f'{len(publishers)} publisher(s), ' + (fault or 'none sending')


class Diagnostics:
    """
    The diagnostics of one node.

    ``counters`` are the rejections by reason; the node sets ``values``. At each publication
    ``checks`` return a problem ``(level, message)`` or None, and ``sources`` return more values,
    both at a monotonic time, s. An exception in one of these functions is reported as an internal
    error, and the others are still called. The status shows the worst problem; every problem is
    also logged, at most once per 5 s.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.values: dict[str, Any] = {}
        self.sources: list[Callable[[float], Mapping[str, Any]]] = []
        self.counters: Counter[str] = Counter()
        self.rates: dict[str, Rate] = {}
        self.latencies: dict[str, deque[float]] = {}
        self.checks: list[Callable[[float], Problem | None]] = []
        self._logged: dict[str, float] = {}
        self._internal: dict[str, tuple[float, str]] = {}
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        node.create_timer(1.0, self.publish, clock=STEADY)

    def watch(self, topic: str, msg_type: Any, qos: QoSProfile, required: bool,
              sporadic: bool) -> Input:
        """Return an :class:`Input` whose silence is reported in the status."""
        type_name = f'{msg_type.__module__.split(".")[0]}/msg/{msg_type.__name__}'
        watched = Input(self._node, topic, type_name, qos, required, sporadic)
        self.checks.append(watched.problem)
        self.rates[f'{topic}_hz'] = watched.rate
        return watched

    def rate(self, name: str) -> Rate:
        """Return the rate shown as ``NAME_hz``."""
        return self.rates.setdefault(f'{name}_hz', Rate())

    def latency(self, name: str) -> deque[float]:
        """Return the newest durations, s, that are shown as ``NAME_p50_ms`` and so on."""
        return self.latencies.setdefault(name, deque(maxlen=LATENCIES))

    def reject(self, reason: str, detail: str = '') -> None:
        """Count a dropped input under a short reason; log it at most once per 5 s."""
        self.counters[reason] += 1
        self.log(WARN, f'{reason}: {detail}' if detail else reason, key=reason)

    def internal_error(self, where: str, error: Exception) -> None:
        """Count an unexpected exception; report and log its type, message and place."""
        reason = f'internal error {where}'
        message = internal_error(error, where)
        if places := traceback.extract_tb(error.__traceback__):
            message += f' ({places[-1].name}, line {places[-1].lineno})'
        self.counters[reason] += 1
        self._internal[reason] = time.monotonic(), message
        self.log(ERROR, message, key=_without_details(message))

    def log(self, level: bytes, message: str, key: str | None = None) -> None:
        """Log a message unless one with the same key was logged within the last 5 s."""
        now = time.monotonic()
        key = key or message
        if now - self._logged.get(key, -LOG_PERIOD) < LOG_PERIOD:
            return
        self._logged[key] = now
        logger = self._node.get_logger()
        # rclpy allows one severity per call site.
        if level == ERROR:
            logger.error(message)
        else:
            logger.warning(message)

    def _call(self, function: Callable[[float], Any], now: float) -> Any:
        """Return the result of a check or a source; report its exception, and return None."""
        try:
            return function(now)
        except Exception as error:
            self.internal_error(f'in {getattr(function, "__name__", function)}', error)
            return None

    def problems(self, now: float) -> list[Problem]:
        """Return every current problem, the worst first."""
        found = [self._call(check, now) for check in self.checks]
        found += [(ERROR, message) for last, message in self._internal.values()
                  if now - last < ERROR_SHOWN]
        return sorted(filter(None, found), key=lambda problem: problem[0], reverse=True)

    def shown(self, now: float) -> dict[str, Any]:
        """Return all values at a monotonic time, s."""
        values = dict(self.values)
        for source in self.sources:
            values |= self._call(source, now) or {}
        for name, durations in self.latencies.items():
            values |= percentiles(name, durations)
        values |= {name: f'{rate.hertz(now):.2f}' for name, rate in self.rates.items()}
        return values | {f'rejected: {reason}': n for reason, n in self.counters.items()}

    def publish(self) -> None:
        """Publish the status now (called at 1 Hz)."""
        now = time.monotonic()
        problems = self.problems(now)
        for level, message in problems:
            self.log(level, message, key=_without_details(message))
        status = DiagnosticStatus(
            name=self._node.get_fully_qualified_name().lstrip('/'),
            level=problems[0][0] if problems else OK,
            message='; '.join(message for _, message in problems) or 'running')
        status.values = [KeyValue(key=key, value=str(value))
                         for key, value in self.shown(now).items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def _without_details(message: str) -> str:
    """Return the part of a problem's message that stays the same while it lasts."""
    return message.split(':')[0].rstrip('0123456789. s')
